"""tools/reproduce_tables.py, on rows that are made up, and the figures of macid's page against what is shipped."""

import importlib.util
import json
import pathlib
import shutil
import sys

import numpy as np
import pytest

from macid import assets
from macid.evaluate import TOLERATED
from macid.learning.methods import LEVEL_METHODS
from macid.policy import load_policy, policy_names

ROOT = pathlib.Path(__file__).parents[2]
SPEC = importlib.util.spec_from_file_location("reproduce_tables", ROOT / "tools" / "reproduce_tables.py")
tables = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(tables)


@pytest.fixture
def made_up(tmp_path, monkeypatch):
    """A folder with macid's seeds 0 and 1, and rows in which SR10 is 10 x level, and 2 more for seed 1; who was
    evaluated with which LCFs."""
    asked = []

    def row(pedestrian, level, episodes, config):
        asked.append((pathlib.Path(pedestrian).stem, level, config.lcf))
        seed = 1 if "macid-1" in pedestrian else 0
        figures = dict.fromkeys((*tables.COLUMNS, *tables.WALKING), 1.0)
        return {**figures, "SR10": 10.0 * level + 2 * seed, "CP": -config.lcf[0], "SR": [float(level)] * TOLERATED}

    def knob(pedestrian, level, episodes, mixed, config):
        seed, falling = 1 if "macid-1" in pedestrian else 0, [6.0, 5.0, 4.0, 3.0, 2.0, 1.0]
        if level == "foyer" and seed == 1:
            falling = falling[::-1]
        own = None if level == "crowded" else 3.0
        figures = {"CP": falling, "SR10": [7.0] * 6, "own_CP": [*falling[:5], own]}
        return {"pedestrian": pedestrian, "episodes": episodes, "mixed": mixed, **figures}

    monkeypatch.setattr(tables, "evaluate_level", row)
    monkeypatch.setattr(tables, "measure_knob", knob)
    for name in ("macid-0", "macid-1"):
        for suffix in (".npz", ".json"):
            shutil.copy(assets.path("policies", name + suffix), tmp_path)
    return tmp_path, asked


def run(monkeypatch, folder, *words):
    monkeypatch.setattr(sys, "argv", ["tables", "--policies", str(folder), "--out", str(folder / "out"), *words])
    return tables.main()


def test_tables_have_means_deviations_and_the_papers_figures_and_rows_are_kept(made_up, monkeypatch, capsys):
    folder, asked = made_up
    assert run(monkeypatch, folder, "--no-train") == 0
    lines = (folder / "out" / "table2.md").read_text().splitlines()
    (ours,) = [line for line in lines if line.startswith("| macid (2 seeds)")]
    sd = np.std([10.0, 12.0], ddof=1)
    assert ours.split(" | ")[1] == f"11.0 ± {sd:.1f}" and ours.split(" | ")[4] == f"21.0 ± {sd:.1f}"
    assert lines[lines.index(ours) + 1].startswith("| *paper* | 76.9 | 5.1 | 94.6 | 64.5")
    assert lines[2].startswith("| social-force | 10.0")  # a rule has no seeds
    by_lcf = (folder / "out" / "table1.md").read_text().splitlines()
    assert len([line for line in by_lcf if line.startswith("| (")]) == 6
    assert by_lcf[-2].split(" | ")[1:3] == ["-", "-1.0"]  # CP falls from section to section, SR10 is the same in all
    assert by_lcf[-1].split(" | ")[:3] == ["| of each seed: mean and range", "-", "-1.00 [-1.00, -1.00]"]
    assert len((folder / "out" / "figure2.csv").read_text().splitlines()) == 1 + 5 * 4 * TOLERATED
    assert (folder / "out" / "figure2.png").stat().st_size > 10_000
    sections = [lcf for name, level, lcf in asked if name == "macid-0" and level == 1]
    assert len(sections) == len(set(sections)) == 7  # Table I's six and Table II's (0.67, 1.33)
    before = len(asked)
    assert run(monkeypatch, folder, "--no-train") == 0 and len(asked) == before


def test_the_knob_is_told_of_each_seed_and_level_with_the_range(made_up, monkeypatch, capsys):
    folder, asked = made_up
    assert run(monkeypatch, folder, "--no-train", "--tables", "knob") == 0
    assert not asked and not (folder / "out" / "table2.md").exists()
    cp, sr, own = ((folder / "out" / "knob.md").read_text().strip("\n") + "\n").split("\n\n")
    names, _, first, second, both = cp.splitlines()
    assert [name.strip() for name in names.split(" | ")[1:5]] == ["Lv.1", "Lv.2", "Lv.3", "Lv.4"]
    foyer = names.split(" | ").index("foyer")
    assert first.startswith("| macid-0 | -1.00 |") and first.split(" | ")[foyer] == "-1.00"
    assert second.split(" | ")[foyer] == "1.00" and both.split(" | ")[foyer] == "0.00 [-1.00, 1.00]"
    assert first.rstrip(" |").endswith("6.0 to 1.0")
    assert sr.splitlines()[2].split(" | ")[1] == "-"  # the same in every section
    crowded = own.splitlines()[0].split(" | ").index("crowded")
    assert own.splitlines()[2].split(" | ")[crowded] == "-"  # a section without anybody
    assert own.splitlines()[2].split(" | ")[1] == "-0.90"  # 6 5 4 3 2 3: of the two equal ones each has the mean rank


def test_policies_of_another_recipe_are_left_out_and_the_missing_seeds_trained(made_up, monkeypatch, capsys):
    folder, _ = made_up
    recipe = json.loads((folder / "macid-1.json").read_text())
    (folder / "macid-1.json").write_text(json.dumps({**recipe, "agent_steps": 7000, "level": 1}))
    configs = tables.wanted(30e6)
    found = tables.find_policies(configs, folder)
    assert list(found) == ["macid"] and list(found["macid"]) == [0]
    assert "level is 1, not 2, agent_steps is 7000, not 30000000" in capsys.readouterr().err
    trained = []
    monkeypatch.setattr(tables, "train", lambda config, *args, **kwargs: trained.append((config.name, config.seed)))
    tables.train_missing(configs, found, folder)
    assert [seed for name, seed in trained if name == "macid"] == list(range(1, tables.SEEDS))
    assert [seed for name, seed in trained if name == "ipo-25hz"] == [0, 1, 2]
    at_once = []

    def train(config, out, seeds, **kwargs):
        at_once.append((config.name, config.seed, seeds, config.engine))

    monkeypatch.setattr(tables, "train", train)
    tables.train_missing(configs, {"ipo": {2: "there"}, **found}, folder, engine="mjx")
    assert [each for each in at_once if each[0] in ("macid", "ipo")] == [
        ("ipo", 0, 2, "mjx"), ("ipo", 3, tables.SEEDS - 3, "mjx"), ("macid", 1, tables.SEEDS - 1, "mjx"),
    ]  # fmt: skip


def test_wrong_requests_are_told(made_up, monkeypatch, capsys):
    folder, _ = made_up
    assert run(monkeypatch, folder, "--seeds", "0") == 2 and "at least 1" in capsys.readouterr().err
    assert run(monkeypatch, folder, "--engine", "bullet") == 2 and "Unknown engine 'bullet'" in capsys.readouterr().err
    empty = folder / "empty"
    empty.mkdir()
    assert run(monkeypatch, empty, "--no-train") == 2 and "No policies" in capsys.readouterr().err


def test_the_pages_table_is_of_the_shipped_policies():
    lines = (ROOT / "macid" / "README.md").read_text().splitlines()
    for method in LEVEL_METHODS:
        names = [name for name in policy_names() if name.rpartition("-")[0] == method]
        scores = [load_policy(name).recipe["scores"] for name in names]
        values = [[score[f"Lv.{level}"][c] for level in (1, 2, 3, 4) for c in tables.COLUMNS] for score in scores]
        (line,) = [line for line in lines if line.startswith(f"| {method} ({len(names)} seeds) | ")][:1]
        told = [float(cell.partition(" ")[0]) for cell in line.split(" | ")[1:]]
        np.testing.assert_allclose(told, np.mean(values, axis=0), atol=0.06)
        spread = [float(cell.split()[2]) for cell in line.split(" | ")[1:]]
        np.testing.assert_allclose(spread, np.std(values, axis=0, ddof=1), atol=0.06)
