"""The pages: their tables and cards are those of the shipped results, their links and commands lead somewhere."""

import importlib.util
import json
import pathlib
import re
import shlex
import subprocess
import sys

import make_pages as pages
import numpy as np
import pytest
import reproduce_tables as tables

from bson import cli as bson_cli
from bson.evaluation.suites import load_suite
from macid import assets
from macid import cli as macid_cli
from macid.layout import LEVELS, OTHER_LEVELS
from macid.learning.config import preset
from macid.policy import load_policy, policy_names

ROOT = pathlib.Path(__file__).parents[2]
ALL = (
    *("README.md", "assets/README.md", "bson/README.md", "macid/README.md", "tests/README.md", "tools/CHANGELOG.md"),
    *("assets/agents/README.md", "assets/policies/README.md", "assets/results/README.md"),
)


def text(page):
    return (ROOT / page).read_text()


def between(page, mark):
    """Lines of a page between its marks of that name."""
    return text(page).split(f"<!-- {mark} -->\n")[1].split(f"\n<!-- /{mark} -->")[0].splitlines()


def rows(lines):
    """Cells of the rows of Markdown tables."""
    return [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in lines if line.startswith("|")]


def numbers(cell):
    return [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?", cell)]


def test_the_first_page_is_one_page_and_its_tables_are_parts_of_the_others():
    lines = text("README.md").splitlines()
    assert len(lines) <= 120
    others = {line for page in ("bson/README.md", "macid/README.md") for line in text(page).splitlines()}
    told = [line for line in lines if line.startswith("|")]
    assert len(told) > 8
    assert set(told) <= others


def test_the_tables_are_made_from_the_shipped_figures():
    """`python tools/make_pages.py` would change nothing."""
    for name, lines in pages.results().items():
        assert (pages.RESULTS / f"{name}.md").read_text().splitlines() == lines, name
    parts = pages.pieces()
    for page in pages.PAGES:
        assert pages.filled(text(page), parts) == text(page), page


def test_the_knobs_table_is_that_of_the_shipped_rows():
    """Rows of `measure_knob`, through tools/reproduce_tables.py, are the table of macid's page to the letter."""
    kept, by_method = pages.shipped("knob"), {}
    for name, of_level in kept.items():
        one = [{"pedestrian": name, **of_level[str(level)]} for level in LEVELS + OTHER_LEVELS]
        by_method.setdefault(load_policy(name).recipe["name"], []).append(one)
    lines = tables.knob_table("CP", by_method, LEVELS + OTHER_LEVELS)
    assert len(lines) == 2 + len(kept) + len(by_method)
    assert {"macid", "macid-tri", "macid-touch", "macid-paper"} == set(by_method)
    assert lines == between("macid/README.md", "knob-CP")


def test_every_shipped_policy_has_a_card():
    card = text("assets/policies/README.md")
    for family, members in pages.families().items():
        found = rows(between("assets/policies/README.md", f"card-{family}"))
        assert [row[0] for row in found[2:-1]] == [f"`{name}`" for name in members]
        assert re.search(rf"^## .*\b{re.escape(family)}\b", card, re.MULTILINE)
    assert sum(len(members) for members in pages.families().values()) == len(policy_names())
    told = text("assets/agents/README.md")
    assert pages.agent_names()
    for name in pages.agent_names():
        assert f"\n## {name}\n" in told
        assert between("assets/agents/README.md", f"card-{name}")


def test_a_cards_command_trains_its_family():
    for family, members in pages.families().items():
        first, *_ = between("assets/policies/README.md", f"card-{family}")
        words = re.match(r"Made by `macid ([^`]+)`", first)[1]
        args = macid_cli.parser().parse_args(words.split())
        given = {} if args.period is None else {"period": args.period}
        config = preset(args.preset, method=args.method, agent_steps=int(args.agent_steps), **given)
        recipe = load_policy(members[0]).recipe
        assert (config.name, config.agent_steps) == (family, recipe["agent_steps"])
        assert (config.ppo.lam, config.ppo.batch) == (recipe["ppo"]["lam"], recipe["ppo"]["batch"])


def test_a_cards_last_row_is_the_tables_row():
    tabled = {row[0]: row[1:] for name in ("table2", "human") for row in rows(between("macid/README.md", name))}
    every = rows(between("macid/README.md", "periods"))
    periods = {row[0].partition(", ")[2] + row[0].partition(",")[0]: row[1:] for row in every}
    for family, members in pages.families().items():
        *_, last = rows(between("assets/policies/README.md", f"card-{family}"))
        period = load_policy(members[0]).recipe["period"]
        method = load_policy(members[0]).recipe["method"]
        row = tabled.get(last[0]) or periods[f"{method} ({len(members)} seeds){period:g} s"]
        assert last[1:] == row, family


def board_of_paper():
    """{agent: its cells} of the leaderboard's first table."""
    lines = between("bson/README.md", "leaderboard")
    return {row[1].strip("`"): row for row in rows(lines[: lines.index("")])}


def test_a_robots_card_and_the_leaderboard_tell_the_same_score():
    board = board_of_paper()
    for name in pages.agent_names():
        (found,) = rows(between("assets/agents/README.md", f"card-{name}"))[2:]
        sns = json.loads((ROOT / "assets/agents" / f"{name}.json").read_text())["scores"]["SNS"]
        np.testing.assert_allclose(numbers(found[1]), [sns["mean"], sns["low"], sns["high"]], atol=0.051)
        if name in board:
            assert found[1] == board[name][3], name


def test_the_leaderboards_rows_are_those_of_the_shipped_episodes():
    board = board_of_paper()
    runs = pages.robot_runs()["paper", ""]
    assert board.keys() - runs.keys() == {"agent", "---", "rrt-star"} and runs.keys() <= board.keys()
    for agent, episodes in runs.items():
        *_, sns, success, coll, sp, pe, rc, space = board[agent]
        assert len(episodes["SNS"]) == 100
        np.testing.assert_allclose(numbers(sns), numbers(pages.interval(episodes["SNS"], digits=4)), atol=0.0501)
        told = {"Coll": coll, "SP": sp, "PE": pe, "RC": rc, "personal_space": space}
        for metric, cell in told.items():
            digits = len(cell.partition(".")[2])
            assert float(cell) == pytest.approx(np.mean(episodes[metric]), abs=0.51 * 10**-digits), (agent, metric)
        assert success == f"{np.mean(episodes['success']):.0%}"


def test_the_results_are_of_todays_suites():
    for run in pages.shipped("robots"):
        if run["suite_digest"]:
            assert run["suite_digest"] == load_suite(run["suite"]).digest
    told = dict(re.findall(r"Suite `(\w+)`, digest `(\w+)`", text("bson/README.md")))
    assert told == {name: load_suite(name).digest for name in ("paper", "standard", "scenarios", "street", "dense")}


def test_table_3_has_the_seeds_of_the_shipped_robots():
    found = rows(between("bson/README.md", "table3"))
    for index, row in enumerate(found):
        if row[0].endswith(" seeds)"):
            name = row[0].partition(" ")[0]
            seeds = json.loads((ROOT / "assets/agents" / f"{name}.json").read_text())["seeds"]
            told = numbers(found[index + 1][1])
            np.testing.assert_allclose(told, [seed["SNS"] for seed in seeds], atol=0.06)
            assert numbers(row[1])[0] == pytest.approx(np.mean(told), abs=0.11)


@pytest.mark.parametrize("page", ALL)
def test_links_lead_somewhere(page):
    for link in re.findall(r"\]\(([^)\s]+)\)", text(page)):
        if not re.match(r"https?:", link):
            path, _, place = link.partition("#")
            file = (ROOT / page).parent / path if path else ROOT / page
            assert file.exists(), link
            if place:
                titles = re.findall(r"^#+ (.*)$", file.read_text(), re.MULTILINE)
                assert place in [re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles], link


def commands():
    """Every command line in the pages' blocks of bash: (page, words)."""
    for page in ALL:
        for block in re.findall(r"```bash\n(.*?)```", text(page), re.DOTALL):
            for line in block.splitlines():
                if words := shlex.split(line, comments=True):
                    yield page, words


def test_every_command_of_the_pages_is_one():
    parsers, seen = {"bson": bson_cli.parser(), "macid": macid_cli.parser()}, set()
    for page, (program, *words) in commands():
        seen.add(program)
        if program in parsers:
            parsers[program].parse_args(words)  # exits where it is none
        elif program == "python":
            tool = (ROOT / words[0]).read_text()
            assert all(f'"{flag}"' in tool for flag in words if flag.startswith("--")), (page, words)
        else:
            assert program in ("source", "pip", "git", "ray") or (ROOT / program).is_file(), (page, program)
    assert {"bson", "macid", "python", "tools/demo.sh"} <= seen


def test_every_block_of_python_is_python():
    blocks = [block for page in ALL for block in re.findall(r"```python\n(.*?)```", text(page), re.DOTALL)]
    assert len(blocks) > 6
    for block in blocks:
        compile(block, "page", "exec")


def test_figures_are_taken_from_rows_and_results_as_they_are_shipped(tmp_path, monkeypatch):
    """What --rows and --runs take is what the tables are made from; other figures stay."""
    folder, before = tmp_path / "results", pages.shipped("knob")
    folder.mkdir()
    for name in ("knob", "rules", "robots"):
        (folder / f"{name}.json").write_bytes((pages.RESULTS / f"{name}.json").read_bytes())
    monkeypatch.setattr(pages, "RESULTS", folder)
    row = {"pedestrian": "assets/policies/macid-0.npz", "level": 1, "episodes": 5, "sections": [[-2, 2]]}
    row |= {figure: [float(n) for n in range(6)] for figure in tables.KNOB}
    (tmp_path / "row.json").write_text(json.dumps(row))
    pages.take_rows(tmp_path)
    after = pages.shipped("knob")
    assert after["macid-0"].pop("1") == {figure: row[figure] for figure in tables.KNOB}
    before["macid-0"].pop("1")
    assert after == before
    assert (folder / "rules.json").read_bytes() == (assets.root() / "results" / "rules.json").read_bytes()


def test_rows_of_models_beside_people_are_joined_whatever_their_number_of_seeds(tmp_path, monkeypatch):
    """--people replaces the rows of the models that were measured; others stay, to the byte."""
    folder, before = tmp_path / "results", pages.shipped("human")
    folder.mkdir()
    (folder / "human.json").write_bytes((pages.RESULTS / "human.json").read_bytes())
    monkeypatch.setattr(pages, "RESULTS", folder)
    row = {"radius": 0.2, "policies": ["ipo-0", "ipo-1"], "values": {"speed": [1.0, 1.2], "E1": [None, 0.5]}}
    (tmp_path / "measured.json").write_text(json.dumps({"ipo, 0.2 m": row, "social-force": row}))
    pages.take_people([tmp_path / "measured.json"])
    after = pages.shipped("human")
    assert after == before | {"ipo, 0.2 m": row, "social-force": row}
    assert next(iter(after)) == "social-force" and [name for name in after if name in before] == list(before)
    assert [line for line in pages.human() if line.startswith("| ipo, 0.2 m (2 seeds) | 1.10, - | -, 0.50, - |")]
    for wrong in ({"nobody": row}, {"ipo": {"radius": 0.35}}, {"ipo": 3}):
        (tmp_path / "measured.json").write_text(json.dumps(wrong))
        with pytest.raises(pages.UsageError, match="nobody|measured.json"):
            pages.take_people([tmp_path / "measured.json"])
    assert pages.shipped("human") == after


@pytest.mark.skipif(not importlib.util.find_spec("pdoc"), reason="needs the extra docs")
def test_the_site_is_built_without_warnings(tmp_path):
    """In a process of its own, since it imports every module."""
    command = [sys.executable, str(ROOT / "tools" / "make_docs.py"), str(tmp_path / "site")]
    run = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert run.returncode == 0, run.stderr
    assert not [line for line in run.stderr.splitlines() if not line.startswith("left out: ")]
    site = tmp_path / "site"
    assert "BSON + MAC-ID on MuJoCo" in (site / "index.html").read_text()
    assert 'id="Lidar2D"' in (site / "bson" / "sensors.html").read_text()
