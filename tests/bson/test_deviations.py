"""The pages' tables of what the paper gives and what is done here instead: their figures are those of the code."""

import pathlib
import re

import pytest

from bson.task import TaskConfig
from macid.layout import load_level
from macid.learning.config import preset
from macid.pedestrians.orca import ORCA

ROOT = pathlib.Path(__file__).parents[2]


def rows(package):
    """{(whom, what): (the paper's cell, ours)} of a package's page."""
    page = (ROOT / package / "README.md").read_text()
    text, found, whom = page.split("### What the paper gives")[1].split("\n## ")[0], {}, None
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| of "):
            whom = cells[0]
        elif len(cells) == 4 and whom:
            found[whom, cells[0]] = tuple(cells[1:3])
    return found


def numbers(cell):
    return [
        float(text.replace(",", "")) for text in re.findall(r"(?<![\w.])\d[\d,]*(?:\.\d+)?(?:e-\d+)?(?![\w])", cell)
    ]


def test_pedestrians():
    table, paper, fast = rows("macid"), preset("paper"), preset("fast")

    def row(what):
        return tuple(numbers(cell) for cell in table["of pedestrians", what])

    rates = [(one.ppo.learning_rate, one.ppo.final_learning_rate) for one in (paper, fast)]
    assert row("learning rate") == ([rates[0][0]], [*rates[1]]) and rates[0][0] == rates[0][1]
    people = load_level(paper.level).pedestrians
    assert row("an update follows") == (
        [paper.rollout, paper.nworld, people],
        [fast.rollout, fast.nworld, fast.episode],
    )
    assert row("batch, epochs") == ([paper.ppo.batch, paper.ppo.epochs], [fast.ppo.batch, fast.ppo.epochs])
    assert row("lambda of GAE") == ([paper.ppo.lam], [fast.ppo.lam])
    assert row("rewards in values and GAE")[1] == [fast.ppo.reward_scale] and paper.ppo.reward_scale == 1
    assert row("gradients")[1] == [fast.ppo.max_gradient_norm] and paper.ppo.max_gradient_norm is None
    assert (paper.ppo.standardize, fast.ppo.standardize) == (False, True)
    assert (paper.ppo.targets, fast.ppo.targets) == ("episode", "lambda")
    assert (paper.ppo.arrival, fast.ppo.arrival) == ("end", "mean")
    assert (paper.inputs, fast.inputs) == ("observation", "features")
    assert row("budget")[0] == [paper.agent_steps / 1e6, paper.agent_steps / (people * paper.rollout)]
    orca = ORCA()
    assert row("ORCA (not in the paper)")[1] == [
        orca.obstacle_horizon, orca.margin, orca.max_obstacles, orca.preferred_speed,
    ]  # fmt: skip


def test_robots():
    pytest.importorskip("stable_baselines3")
    from bson.learning.presets import PRESETS

    table, paper, fast = rows("bson"), PRESETS["paper"], PRESETS["fast"]

    def row(what):
        return tuple(numbers(cell) for cell in table["of robots", what])

    ppo, ours = paper["ppo"], fast["ppo"]
    assert row("PPO: learning rate") == ([ppo.learning_rate], [ours.learning_rate, ours.final_learning_rate])
    assert row("PPO: gamma") == ([ppo.gamma], [ours.gamma])
    assert row("PPO: batch, epochs") == ([ppo.batch, ppo.epochs], [ours.batch, ours.epochs])
    for algo in ("sac", "tac", "bc"):
        assert row("SAC, TAC, BC: networks") == ([*paper[algo].hidden], [*fast[algo].hidden])
    for algo in ("sac", "tac"):
        assert row("SAC, TAC: weight of the entropy") == ([paper[algo].alpha], [fast[algo].alpha])
        assert row("SAC, TAC: steps for an update") == ([paper[algo].steps_per_update], [fast[algo].steps_per_update])
        assert (paper[algo].joint, fast[algo].joint) == (True, False)
    assert row("BC: demonstrations, learning rate")[1][-1] == fast["bc"].final_learning_rate
    assert TaskConfig().pedestrian_period == row("people decide every")[1][0] == 0.1
    assert TaskConfig().robot.max_speed == row("top speed")[1][0]
