import re

import pytest
from markupsafe import Markup

from bson.agents import load_agent
from bson.episodes.tracks import make_track
from bson.evaluation.play import results, run_episodes
from bson.evaluation.suites import Cell, load_suite
from bson.reporting import report
from bson.reporting.heatmap import Scale, Tile, cell_maps
from bson.reporting.page import numbers
from bson.reporting.report import grade_settings, make_report
from bson.task import TaskConfig

SMALL = TaskConfig(num_pedestrians=3, map_size=20.0, goal_distance=(6.0, 12.0), horizon=40)
AXES = {"obstacles": ("open", "maze"), "people": ("few", "many"), "temper": ("wild", "meek")}


@pytest.fixture(scope="module")
def episodes():
    return run_episodes(load_agent("goal"), SMALL, make_track("local", "lidar2d"), range(8))


@pytest.fixture
def no_pictures(monkeypatch):
    """Figures are not rendered, which takes most of a page's time."""
    monkeypatch.setattr(report, "image", lambda figure, caption: Markup("<figure>{}</figure>").format(caption))


def _cells(number):
    """Two grades on each of the first `number` axes."""
    cells = [()]
    for axis in list(AXES)[:number]:
        cells = [(*grades, (axis, grade)) for grades in cells for grade in AXES[axis]]
    return [Cell(grades, SMALL) for grades in cells]


def _content(cells, episodes, **more):
    """results.json of `episodes` dealt out to the cells in turn."""
    return results("goal", "made", cells, [episodes[place :: len(cells)] for place in range(len(cells))], **more)


def _report(content, cells, episodes):
    return make_report(content, [e for place in range(len(cells)) for e in episodes[place :: len(cells)]])


@pytest.mark.parametrize(("axes", "heat_maps", "dot_plots"), [(3, 6, 0), (2, 3, 0), (1, 0, 3), (0, 0, 0)])
def test_the_cells_are_drawn_as_their_axes_ask(episodes, check_page, no_pictures, axes, heat_maps, dot_plots):
    cells = _cells(axes)
    content = _content(cells, episodes, command="bson evaluate --agent 'a b.py'")
    page = _report(content, cells, episodes)
    check_page(page)
    assert page.count('<table class="heat">') == heat_maps and page.count('class="panel dots"') == dot_plots
    assert ("From the worst to the best" in page) == (axes > 0)
    assert "bson evaluate --agent &#39;a b.py&#39;" in page
    for cell in content["cells"] if axes else ():
        low, high = cell["intervals"]["SNS"]
        assert f"[{low:.1f}, {high:.1f}]" in page and all(grade in page for grade in cell["grades"].values())


def test_the_table_of_cells_goes_from_the_worst_to_the_best(episodes, no_pictures):
    cells = _cells(2)
    content = _content(cells, episodes)
    page = _report(content, cells, episodes)
    table = page.split("From the worst to the best")[1].split("</table>")[0]
    found = re.findall(
        r'nowrap">(\w+)</td><td class="left nowrap">(\w+)</td><td>2</td><td class="nowrap"><b>([-.\d]+)', table
    )
    ranked = sorted(content["cells"], key=lambda cell: cell["summary"]["SNS"])
    assert [", ".join(row[:2]) for row in found] == [cell["name"] for cell in ranked]
    assert [float(row[2]) for row in found] == pytest.approx([cell["summary"]["SNS"] for cell in ranked], abs=0.051)


def test_a_page_shows_ways_and_distributions(episodes, check_page):
    content = _content(_cells(0), episodes)
    page = make_report(content, episodes)
    check_page(page)
    # Eight episodes: eight ways; and where three or more met people, whom they met.
    assert page.count("data:image/png;base64,") in (16, 17)
    for row in content["episodes"]:
        assert f"seed {row['seed']}: SNS {row['SNS']:.1f}, " in page


def test_every_tile_of_a_heat_map_stands_in_its_row_and_column():
    tiles = [
        Tile({"people": row, "temper": column}, 10.0 * i + j, 0.0, 99.0)
        for i, row in enumerate(("few", "many", "crowd"))
        for j, column in enumerate(("wild", "meek"))
    ]
    text = cell_maps(tiles[::-1], Scale(0.0, 100.0), "SNS", digits=0)
    rows = re.findall(r"<tr><th>(\w+)</th>(.*?)</tr>", text)
    assert [(name, re.findall(r"<b>(\d+)</b>", row)) for name, row in rows] == [
        ("crowd", ["21", "20"]),
        ("many", ["11", "10"]),
        ("few", ["1", "0"]),
    ]


def test_a_cell_without_a_sound_episode_and_faults_are_told(episodes, check_page, no_pictures):
    cells = _cells(1)
    fault = {"seed": 77, "cell": "maze", "time": 1.5, "what": "qvel <not finite>"}
    content = results("goal", "made", cells, [episodes[:3], []]) | {"faults": [fault]}
    page = make_report(content, episodes[:3])
    check_page(page)
    assert "1 episode ended in a fault" in page and "qvel &lt;not finite&gt;" in page and "1.50 s" in page
    assert page.count("<b>&ndash;</b>") >= 3
    assert "<h2>Faults</h2>" not in _report(_content(cells, episodes), cells, episodes)


def test_a_scale_has_its_ends_and_turns_over_with_what_is_better():
    linear, log = Scale(-50.0, 50.0), Scale(0.0, 999.0, "down", True)
    assert [linear.place(value) for value in (-80.0, -50.0, 0.0, 50.0, 80.0)] == [0.0, 0.0, 0.5, 1.0, 1.0]
    assert log.place(0.0) == 0.0 and log.place(999.0) == 1.0 and log.place(9.0) == pytest.approx(1 / 3)
    for scale in (linear, log):
        assert [scale.place(scale.at(place)) for place in (0.0, 0.3, 1.0)] == pytest.approx([0.0, 0.3, 1.0])
    for value in (-50.0, -20.0, 3.0, 50.0):
        assert linear.colours(value) == Scale(-50.0, 50.0, "down").colours(-value)
    assert len({linear.colours(value) for value in (-50.0, -25.0, 0.0, 25.0, 50.0)}) == 5


def test_grades_are_told_by_what_they_set():
    def settings(name):
        suite = load_suite(name)
        return grade_settings(results("goal", name, suite.cells, [[] for _ in suite.cells[1:]] + [EPISODE])["cells"])

    EPISODE = run_episodes(load_agent("stop"), SMALL.replace(horizon=1), make_track("local", "lidar2d"), [0])
    standard = settings("standard")
    assert standard["obstacles"] == {
        "open": {"obstacle_density": 0.0},
        "half": {"obstacle_density": 0.5},
        "maze": {"obstacle_density": 1.0},
    }
    assert standard["people"]["dense"] == {"pedestrian_density": 1.0}
    assert standard["temper"]["cooperative"] == {"lcf": (0.67, 2.0)}
    assert settings("scenarios")["scenario"]["doorway"]["map"] == "doorway"


def test_numbers_of_one_row_have_the_same_decimals():
    assert numbers(97.53, 96.2, 98.0) == ["97.5", "96.2", "98.0"]
    assert numbers(321.6, 0.07, 413) == ["322", "0", "413"]
    assert numbers(0.0001, -0.0001, 0.9) == ["0.000", "0.000", "0.900"]
    assert numbers(0, 0.0) == ["0", "0"]
    assert numbers(1.5, -2.0, 0.0, signed=True) == ["+1.50", "-2.00", "0.00"]
    assert numbers(1e9, 1e-9)[0] == "1000000000"
    assert numbers(1.0, 99.96, digits=1) == ["1.0", "100.0"]
