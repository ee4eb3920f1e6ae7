"""tools/reproduce_table3.py, but for the trainings."""

import dataclasses
import functools
import importlib.util
import json
import pathlib

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from bson.agents import learned
from bson.evaluation.suites import load_suite
from bson.features import FEATURES
from bson.learning.presets import PRESETS
from macid.learning.curves import plain
from macid.policy import write_network

_FILE = pathlib.Path(__file__).parents[2] / "tools" / "reproduce_table3.py"
_SPEC = importlib.util.spec_from_file_location("reproduce_table3", _FILE)
table3 = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(table3)


def episode(sns, **more):
    return {"SNS": sns, "RC": 1.0, "Coll": 0.0, "SP": 1.0, "PE": 0.5, "success": 1.0, **more}


def write_robot(folder, seed, validation, steps=1000, config=None):
    layers = [(np.full((FEATURES, 2), 0.01 * seed, np.float32), np.zeros(2, np.float32))]
    recipe = {"seed": seed, "output": "clip", "steps_done": steps, "validation": {"SNS": validation}}
    recipe |= plain(config) if config else {}
    folder.mkdir(parents=True)
    write_network(folder / "policy", layers, recipe)
    return folder / "policy.npz"


def test_seeds_are_averaged_episode_by_episode():
    (first, second) = table3.averaged([[episode(80.0, Coll=2.0), episode(60.0)], [episode(90.0), episode(0.0)]])
    assert (first["SNS"], first["Coll"], second["SNS"], second["RC"]) == (85.0, 1.0, 30.0, 1.0)


def test_a_row_has_the_means_and_the_seeds_beside_the_papers():
    scores = {"a": [episode(80.0), episode(60.0)], "b": [episode(90.0), episode(70.0)], "goal": [episode(50.0)] * 2}
    noted = []
    lines = table3._table3({"tac": ["a", "b"], "goal": ["goal"]}, scores.get, lambda *what: noted.append(what))
    assert lines[2].startswith("| tac (2 seeds) | 75.0 [65.0, 85.0] | 1.000 | 0.0 [0.0, 0.0] | 1.000 | 0.500 |")
    assert "| 70.0, 80.0 |" in lines[3] and "| 65.14 |" in lines[4]
    assert lines[5].startswith("| goal | 50.0 [50.0, 50.0]") and len(lines) == 6
    assert noted == [("tac", ["a", "b"], [scores["a"], scores["b"]])]


def test_the_robot_that_validated_best_is_shipped_whatever_it_scores(tmp_path):
    files = [write_robot(tmp_path / f"ppo-{seed}", seed, validation) for seed, validation in ((1, 80.0), (2, 95.0))]
    suite = load_suite("paper")
    table3.ship("ppo", files, [[episode(99.0)] * 3, [episode(70.0), episode(90.0)]], suite, tmp_path)
    recipe = json.loads((tmp_path / "ppo.json").read_text())
    assert recipe["seed"] == 2 and recipe["scores"]["SNS"]["mean"] == 80.0
    assert recipe["scores"]["suite"] == "paper" and recipe["scores"]["digest"] == suite.digest
    assert [(each["seed"], each["SNS"]) for each in recipe["seeds"]] == [(1, 99.0), (2, 80.0)]
    shipped, trained = (learned.load(str(path))() for path in (tmp_path / "ppo.npz", files[1]))
    x = np.ones((1, FEATURES), np.float32)
    assert (shipped.act(x) == trained.act(x)).all()


def test_bc_learns_from_the_ppo_of_its_seed_and_crowd(tmp_path):
    config = table3.wanted("bc", "orca", 2, 1000, tmp_path)
    assert config.hyperparameters.expert == str(tmp_path / "ppo-orca-2" / "policy.npz")
    assert config.task == {"pedestrian_model": "orca"} and config.steps == 200
    assert table3.wanted("ppo", "macid", 0, 1000, tmp_path).task == {}


def test_a_robot_of_the_papers_preset_has_its_hyperparameters(tmp_path):
    config = table3.wanted("ppo-paper", "macid", 1, 1000, tmp_path)
    assert config.name == "ppo-paper" and config.hyperparameters == PRESETS["paper"]["ppo"]
    assert table3.wanted("ppo", "macid", 1, 1000, tmp_path).hyperparameters == PRESETS["fast"]["ppo"]


def test_the_papers_size_is_the_papers_with_one_update_a_step(tmp_path):
    for algo in ("sac", "tac", "bc"):
        chosen = table3.wanted(algo, "macid", 0, 1000, tmp_path, "paper").hyperparameters
        assert chosen.hidden == (1024, 1024)
        assert algo == "bc" or (chosen.steps_per_update, chosen.alpha, chosen.joint) == (1, 0.2, True)
    assert table3.wanted("tac", "macid", 0, 1000, tmp_path, "paper").hyperparameters.q == 1.2
    assert table3.wanted("bc", "macid", 0, 1000, tmp_path, "paper").hyperparameters.expert.endswith("ppo-0/policy.npz")


@pytest.mark.slow
def test_a_tiny_table_at_the_papers_size(tmp_path, monkeypatch, capsys):
    small = {name: dataclasses.replace(each, hidden=(8,)) for name, each in table3.SIZES["paper"].items()}
    small |= {name: dataclasses.replace(small[name], learning_starts=32) for name in ("sac", "tac")}
    monkeypatch.setitem(table3.SIZES, "paper", small)
    monkeypatch.setattr(table3, "TrainConfig", functools.partial(table3.TrainConfig, validate_episodes=1))
    words = ["--size", "paper", "--algos", "sac", "bc", "--seeds", "1", "--steps", "320", "--episodes", "1"]
    monkeypatch.setattr("sys.argv", ["reproduce_table3", "--out", str(tmp_path), *words, "--tables", "table3"])
    assert table3.main() == 0
    rows = [line.split() for line in (tmp_path / "table3.md").read_text().splitlines()]
    assert {row[1] for row in rows if len(row) > 1} >= {"sac", "bc"}


def test_who_is_trained_is_not_trained_again(tmp_path, monkeypatch):
    trained = []
    monkeypatch.setattr(table3, "train_with_bar", lambda config, *_, **__: trained.append(config.seed))
    wanted = [table3.wanted("ppo", "macid", seed, 1000, tmp_path) for seed in range(5)]
    file = write_robot(tmp_path / "ppo-1", 1, 90.0, config=wanted[1])
    write_robot(tmp_path / "ppo-2", 2, 90.0, steps=999, config=wanted[2])
    write_robot(tmp_path / "ppo-3", 3, 90.0, 2000, table3.wanted("ppo", "macid", 3, 2000, tmp_path))
    assert table3.robot(wanted[1], tmp_path) == file and trained == []
    for seed in (2, 3, 4):  # cut short; of another length; not begun
        table3.robot(wanted[seed], tmp_path)
    assert trained == [2, 3, 4]


def test_an_episode_of_failed_physics_is_left_out_for_all_seeds():
    together = table3.averaged([[episode(80.0), None], [episode(60.0), episode(0.0)]])
    assert together == [episode(70.0), None]
    assert table3.cells(together, ("SNS",)) == "70.0 [70.0, 70.0]"


def test_the_carry_over_table_has_each_crowd_their_mean_and_the_street():
    met = {(crowd, seed): 10.0 * index + seed for index, crowd in enumerate(table3.COLUMNS) for seed in (0, 2)}

    def score(file, column):
        return [episode(met[column, file]), None] * (2 if column == "street" else 1)

    lines = table3._carried({"orca": [0, 2], "goal": [0]}, score, "SNS")
    crowds = ["social-force-progress", "orca", "ipo", "macid", "macid-human", "macid-touch"]
    assert lines[0].split(" | ")[1:] == [*crowds, "mean", "street |"]
    told = [float(cell.split()[0]) for cell in lines[2].split(" | ")[1:]]
    assert told == [1.0, 11.0, 21.0, 31.0, 41.0, 51.0, 26.0, 61.0]
    assert lines[3].split(" | ")[1] == "0.0, 2.0" and lines[3].split(" | ")[-2:] == ["25.0, 27.0", "60.0, 62.0 |"]
    assert lines[4].split(" | ")[-2].startswith("25.0 ") and len(lines) == 5
    few = table3._carried({"goal": [0]}, score, "Coll", ["street", "macid"])
    assert few[0] == "| Coll: trained among | macid | street |" and few[1].count("|---") == 3
    assert few[2].count(" | ") == 2


def test_only_people_who_learned_as_others_than_the_papers_are_so_in_training_and_in_the_table(tmp_path):
    street = load_suite("street").cells[0].config
    for crowd in table3.CROWDS:
        setting = table3.wanted("ppo", crowd, 0, 1000, tmp_path).setting
        (suite, changes), paper = table3.tested_on(crowd), load_suite("paper").cells[0].config
        assert suite == "paper" and setting.pedestrian_model == crowd
        assert paper.replace(**changes) == dataclasses.replace(setting, lcf=paper.lcf, num_pedestrians=24)
        alike = [getattr(setting, name) == getattr(street, name) for name in ("person_radius", "companions")]
        assert alike == [crowd == "macid-human"] * 2
    assert table3.tested_on("street") == ("street", {})


def test_a_suite_of_several_cells_is_scored_cell_by_cell_and_kept(tmp_path, monkeypatch):
    """What is kept is not played again; the episodes are those of `run_episodes` on each cell."""
    suite, rows = load_suite("street"), tmp_path / "rows"
    rows.mkdir()
    suite = dataclasses.replace(suite, cells=suite.cells[::3])
    changes = {"horizon": 3, "pedestrian_model": "standing"}
    measured = table3.scored(rows, "stop", suite, suite.drawn(2), **changes)
    wanted = [
        table3.measure(played)["PE"]
        for cell in suite.cells
        for played in table3.run_episodes(
            table3.load_agent("stop"),
            cell.config.replace(**changes),
            table3.make_track("local", "lidar2d"),
            [16000, 16001],
        )
    ]
    assert [row["PE"] for row in measured] == wanted and len(list(rows.iterdir())) == 2
    monkeypatch.setattr(table3, "run_episodes", None)
    assert table3.scored(rows, "stop", suite, suite.drawn(2), **changes) == measured


@pytest.mark.parametrize(
    "words",
    [
        ["--device", "abacus"],
        ["--seeds", "0"],
        ["--steps", "inf"],
        ["--ship", "x", "--episodes", "3"],
        ["--ship", "x", "--tables", "lcf"],
    ],
)
def test_a_wrong_request_is_told(words, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["reproduce_table3", "--out", str(tmp_path), *words])
    assert table3.main() == 2
    assert words[0] in capsys.readouterr().err
