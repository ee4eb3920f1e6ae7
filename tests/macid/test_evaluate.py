import dataclasses
import functools
import json
import warnings

import jax.numpy as jnp
import numpy as np
import pytest

from macid import cli, metrics, watch
from macid.crowd import Crowd, CrowdConfig
from macid.evaluate import evaluate_level, format_table, measure_knob
from macid.layout import load_level
from macid.pedestrians import MODELS, make_controller
from macid.scene import PersonConfig

COLUMNS = ("SR10", "CP", "PE", "arrived", "dv", "dw", "stalled")
NEAR = CrowdConfig(number=7, duration=6.0, period=0.1, goal_distance=(2.0, 7.0))


def test_a_row_is_its_episodes_metrics():
    row = evaluate_level("social-force", 1, episodes=2, seed=5, config=NEAR)
    layout = load_level(1)
    crowd = Crowd(layout, CrowdConfig(25, 0.1, 6.0, goal_distance=(2.0, 7.0)), nworld=2)
    end, _ = crowd.rollout(crowd.reset(np.random.default_rng((5, 1))), make_controller("social-force", 0.1))
    arrived, collisions = ~np.asarray(end.walking), np.asarray(end.collisions)
    each = [metrics.success_rate(arrived[i], collisions[i]) for i in range(2)]
    assert 0 < row["arrived"] == pytest.approx(100 * arrived.mean())
    assert (row["SR10"], row["SR10_std"]) == pytest.approx((np.mean(each), np.std(each)))
    assert row["CP"] == pytest.approx(collisions.mean())
    assert 0 < row["PE"] <= 100
    assert (row["pedestrian"], row["level"], row["people"], row["episodes"]) == ("social-force", 1, 25, 2)
    assert (row["config"]["number"], row["config"]["period"], row["seed"]) == (25, 0.1, 5)
    assert json.loads(json.dumps(row, allow_nan=False))["config"]["person"] == PersonConfig().__dict__


def test_without_arrivals_path_efficiency_is_left_open():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        row = evaluate_level("social-force", 1, episodes=2, config=CrowdConfig(duration=0.2, period=0.1))
    assert row["PE"] is row["PE_std"] is None
    assert row["arrived"] == row["SR10"] == 0
    json.dumps(row, allow_nan=False)
    assert format_table([row]).splitlines()[1].split() == [
        *["social-force", "Lv.1", "25", "(-2.00,", "2.00)", "0.0", "+-", "0.0"],
        *f"{row['CP']:.1f} +- {row['CP_std']:.1f}".split(),
        "-",
        *["0.0", "+-", "0.0"],
        *[part for name in ("dv", "dw", "stalled") for part in (f"{row[name]:.1f}", "+-", f"{row[name + '_std']:.1f}")],
    ]


def test_the_table_lines_up():
    row = {"pedestrian": "orca", "level": 4, "people": 200, "config": {"lcf": (-2.0, 2.0)}}
    row |= {name: 100.0 for name in COLUMNS} | {f"{name}_std": 12.34 for name in COLUMNS}
    lines = format_table([row, row | {"PE": None, "PE_std": None}]).splitlines()
    assert len({len(line) for line in lines}) == 1
    assert all(name in lines[0] for name in ("model", "level", "people", *COLUMNS))
    assert lines[1].count("100.0 +- 12.3") == len(COLUMNS)


@dataclasses.dataclass(frozen=True)
class Mad:
    """A model whose people command what is no velocity where `value` is not finite; in the `worlds` first ones."""

    period: float
    value: float = np.nan
    worlds: int = 1

    def __call__(self, state, boxes, goals, lcf):
        command = make_controller("social-force", self.period)(state, boxes, goals, lcf)
        mad = jnp.arange(len(command)) < self.worlds
        return command.at[:, 3, 0].set(jnp.where(mad, self.value, command[:, 3, 0]))


@pytest.mark.parametrize("engine", ["native", pytest.param("mjx", marks=pytest.mark.slow)])
def test_an_episode_in_which_physics_failed_is_not_scored(monkeypatch, engine, tmp_path, capsys):
    short = dataclasses.replace(NEAR, duration=1.0)
    sane = evaluate_level("social-force", 1, episodes=3, seed=5, config=short, engine=engine)
    assert sane["faults"] == []
    monkeypatch.setitem(MODELS, "mad", Mad)
    row = evaluate_level("mad", 1, episodes=3, seed=5, config=short, engine=engine)
    assert [fault["episode"] for fault in row["faults"]] == [0]
    crowd = Crowd(load_level(1), dataclasses.replace(short, number=25), nworld=3, engine=engine)
    end, _ = crowd.rollout(crowd.reset(np.random.default_rng((5, 1))), make_controller("social-force", 0.1))
    others = (np.asarray(end.sped).sum(axis=1) / np.asarray(end.time).sum(axis=1))[1:]
    assert row["dv"] == pytest.approx(others.mean(), rel=1e-5) and row["dv"] != pytest.approx(sane["dv"], rel=1e-5)
    json.dumps(row, allow_nan=False)
    told = format_table([sane, row]).splitlines()
    assert told[-1].startswith("not scored, as physics failed: episode 0 of mad on Lv.1: ") and len(told) == 4
    monkeypatch.setitem(MODELS, "mad", functools.partial(Mad, worlds=3))
    told = "nothing to score: physics failed in all episodes of 'mad' on Lv.1. Episode 0: "
    with pytest.raises(ValueError, match=told):
        evaluate_level("mad", 1, episodes=3, config=short, engine=engine)
    if engine == "native":
        with pytest.raises(ValueError, match="Physics failed in the episode of seed 3: .* Choose another --seed"):
            watch.record("mad", 1, short, seed=3)
        out = tmp_path / "rows.json"
        command = ["evaluate", "--pedestrian", "mad", "--levels", "1", "--episodes", "1", "--period", "0.1"]
        assert cli.main([*command, "--out", str(out)]) == 2 and not out.exists()
        assert "nothing to score" in capsys.readouterr().err


def test_a_knob_is_of_the_rows_that_each_section_gives_alone():
    config = CrowdConfig(number=7, duration=3.0, period=0.1)
    found = measure_knob("macid-0", "crossroads", episodes=1, mixed=2, seed=4, config=config)
    assert len(found["sections"]) == 6 and (found["sections"][0][0], found["sections"][-1][1]) == (-2.0, 2.0)
    for index in (0, 5):
        one = dataclasses.replace(config, lcf=found["sections"][index])
        row = evaluate_level("macid-0", "crossroads", episodes=1, seed=4, config=one)
        assert (found["CP"][index], found["SR10"][index]) == (row["CP"], row["SR10"])
    assert sum(found["own_people"]) == 2 * 30  # everybody of the mixed crowds is in one section
    mixed = evaluate_level("macid-0", "crossroads", episodes=2, seed=4, config=dataclasses.replace(config, lcf=(-2, 2)))
    own = np.array([0.0 if cp is None else cp for cp in found["own_CP"]])
    assert own @ found["own_people"] / 60 == pytest.approx(mixed["CP"])
    assert found["CP_rank"] == pytest.approx(metrics.rank_correlation(found["CP"]))
    json.dumps(found, allow_nan=False)


def test_who_knows_no_lcf_has_no_knob():
    with pytest.raises(ValueError, match="not trained with LCFs"):
        measure_knob("ipo", 1)
