"""A name is text on every page, whatever stands in it."""

import copy
import html.parser

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bson.agents import load_agent
from bson.episodes.tracks import make_track
from bson.evaluation.play import results, run_episodes
from bson.evaluation.results import Results
from bson.evaluation.suites import Cell
from bson.reporting.compare import compare, format_comparison, make_page
from bson.reporting.heatmap import Scale, Tile, cell_maps
from bson.reporting.leaderboard import BEGIN, END, fill_readme, leaderboard
from bson.reporting.page import image, video
from bson.reporting.report import make_report
from bson.task import TaskConfig
from macid.pages import new_figure

_CONFIG = TaskConfig(num_pedestrians=3, map_size=20.0, goal_distance=(6.0, 12.0), horizon=20)


def hostile(place):
    """A name for `place` that means something else in HTML, in an attribute, in CSS, in a template and in Markdown."""
    return f"<script>alert('{place}')</script>\" onload='x' --> </style>{{{{ 1 }}}} &lt; `|* {place}"


_OF_MAPS = {"section", "header", "b", "small", "span", "i", "u", "em", "div", "table", "tr", "th", "td", "br", "h4"}


class _Read(html.parser.HTMLParser):
    """What a browser sees of a page: its tags, the names of their attributes, and all its text, in attributes too."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.attributes, self.text = set(), set(), []
        self.feed(page)
        self.close()
        self.text = " ".join(self.text)

    def handle_starttag(self, tag, attributes):
        self.tags.add(tag)
        self.attributes |= {name for name, _ in attributes}
        self.text += [value or "" for name, value in attributes if name != "src"]

    def handle_data(self, data):
        self.text.append(data)

    def handle_comment(self, data):
        raise AssertionError(f"A comment: {data}")


def check(page, places):
    """The names of `places` are text on `page`, and none did anything to it."""
    read = _Read(page)
    assert not read.tags & {"script", "a", "iframe", "object", "link"}
    assert not any(name.startswith("on") or name == "href" for name in read.attributes)
    assert page.count("<style>") == page.count("</style>") == page.count("</title>") == 1
    for place in places:
        assert hostile(place) in read.text, place


@pytest.fixture(scope="module")
def episodes():
    return run_episodes(load_agent("goal"), _CONFIG, make_track("local", "lidar2d"), range(4))


@pytest.fixture(scope="module")
def content(episodes):
    """results.json with a hostile name wherever somebody may choose one."""
    grades = (hostile("one"), hostile("other"))
    cells = [Cell(((hostile("axis"), grade), (hostile("second"), "g")), _CONFIG) for grade in grades]
    made = results(
        hostile("agent"),
        hostile("suite"),
        cells,
        [episodes[:2], episodes[2:]],
        suite_digest=hostile("digest"),
        track=["local", hostile("sensor")],
        overrides={hostile("key"): hostile("value")},
        command=hostile("command"),
        versions={hostile("package"): hostile("version")},
    )
    made["faults"] = [{"seed": 9, "cell": made["cells"][0]["name"], "time": 1.0, "what": hostile("fault")}]
    for cell in made["cells"]:
        cell["config"] = cell["config"] | {"pedestrian_model": hostile("pedestrians"), "map": hostile("map")}
    return made | {"config": made["cells"][0]["config"]}


EVERYWHERE = ("agent", "suite", "one", "other", "axis", "second", "digest", "key", "value", "command", "fault")


@pytest.mark.parametrize("axes", [2, 1])
def test_names_are_text_in_a_report(content, episodes, check_page, tmp_path, axes):
    content = copy.deepcopy(content)
    for cell in content["cells"] if axes == 1 else ():
        del cell["grades"][hostile("second")]
    film = tmp_path / "film.webm"
    film.write_bytes(b"\x1a\x45")
    page = make_report(content, episodes, [(film, f"seed 1: {hostile('film')}")])
    check_page(page)
    check(page, [place for place in EVERYWHERE if axes == 2 or place != "second"] + ["film", "pedestrians"])
    check(make_report(content, episodes, no_video=hostile("gl")), ["gl"])


def test_names_are_text_in_a_comparison(content, check_page):
    other = content | {"versions": {hostile("package"): hostile("newer")}, "command": None}
    runs = [Results(content, hostile("source")), Results(other, hostile("elsewhere"))]
    compared = compare(runs)
    page = make_page(compared)
    check_page(page)
    places = set(EVERYWHERE) - {"fault"} | {"source", "elsewhere", "package", "version", "newer"}
    check(page, places)
    assert hostile("agent") in format_comparison(compared)


def test_captions_are_text(tmp_path):
    read = _Read(image(new_figure(figsize=(1, 1)), hostile("caption")))
    assert read.tags == {"figure", "img", "figcaption"}
    assert read.attributes == {"alt", "src"}
    assert read.text.count(hostile("caption")) == 2
    path = tmp_path / f"{hostile('file').replace('/', ' ')}.webm"
    path.write_bytes(b"123")
    page = video(path, hostile("film"))
    read = _Read(page)
    assert "base64,MTIz" in page
    assert read.tags == {"figure", "video", "figcaption"}
    assert hostile("film") in read.text


def test_names_are_text_in_a_leaderboard(content, tmp_path):
    readme = tmp_path / "README.md"
    readme.write_text(f"{BEGIN}\n{END}\n")
    told = leaderboard([Results(content | {"agent": f"{END}{hostile('agent')}"}, "here")])
    for _ in range(2):  # what it wrote is no mark, so that it can be written again
        fill_readme(readme, told)
    assert readme.read_text() == f"{BEGIN}\n{told}\n{END}\n"
    rows = [line for line in told.splitlines() if line.startswith("|")]
    assert len({row.count("|") for row in rows}) == 1
    read = _Read(told)
    assert read.tags == {"code"}
    for place in ("agent", "suite", "digest", "sensor", "value"):
        assert f"alert('{place}')" in read.text.replace("'\"'\"'", "'")  # as a shell quotes it


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.text(st.characters(exclude_categories=("Cc", "Cs", "Zl", "Zp")), min_size=1), min_size=6, max_size=6)
)
def test_whatever_a_grade_is_called_it_is_read_as_it_is(names):
    heading, note, axis, other, *grades = names
    for scale in (Scale(0.0, 1.0), Scale(-1.0, 1.0)):
        for axes in ([axis], [axis, axis + other]):
            tiles = [Tile({each: grade for each in axes}, 0.5, 0.1, 0.9) for grade in grades]
            read = _Read(cell_maps(tiles, scale, heading, note))
            assert read.tags <= _OF_MAPS
            assert all(name in read.text for name in (heading, note, *grades, *(axes if len(axes) > 1 else ())))
