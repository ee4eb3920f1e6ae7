import dataclasses

import numpy as np
import pytest

from bson.agents.ways import Ways
from bson.evaluation.suites import held_out, load_suite, suite_names
from bson.planners import Grid
from bson.task import TaskConfig, spawn
from macid import assets

DIGESTS = {
    "paper": "d29ce0019b09",
    "paper-slow": "0440c9d01af9",
    "scenarios": "7f1177ebb47f",
    "smoke": "d93d60ae24f8",
    "standard": "86bb56a5ca8e",
    "street": "64ddfa79a4af",
    "dense": "328d29d46450",
}


def test_the_shipped_suites_are_frozen():
    """Whoever changes one of these breaks the comparison with all results so far: make a suite of another name."""
    assert {name: load_suite(name).digest for name in suite_names()} == DIGESTS


def test_suites_are_as_the_paper_says_and_apart():
    paper = load_suite("paper")
    assert len(set(paper.seeds)) == 100
    (cell,) = paper.cells
    assert cell.name == "all" and paper.axes == {}
    assert (cell.config.people, cell.config.obstacle_density, cell.config.lcf) == (24, 0.0, (-2.0, 2.0))
    assert not set(paper.seeds) & set(load_suite("smoke").seeds)
    assert {"paper", "smoke"} <= set(suite_names())
    assert paper.drawn(3) == list(paper.seeds[:3])
    assert not set(paper.drawn(seed=1)) & set(paper.seeds)
    with pytest.raises(ValueError, match="paper.*smoke"):
        load_suite("papers")
    with pytest.raises(ValueError, match="1 to 100"):
        paper.drawn(101)


def test_paper_slow_is_paper_with_a_slower_robot():
    paper, slow = load_suite("paper"), load_suite("paper-slow")
    (usual,), (cell,) = paper.cells, slow.cells
    assert slow.seeds == paper.seeds and cell.config.replace(robot="jackal") == usual.config
    assert (cell.config.robot.max_speed, cell.config.robot.max_yaw_rate) == (1.2, 1.0)


def test_standard_has_every_combination_of_three_criteria():
    standard = load_suite("standard")
    assert len(standard.cells) == 27 == len({cell.name for cell in standard.cells})
    assert {axis: len(grades) for axis, grades in standard.axes.items()} == {"obstacles": 3, "people": 3, "temper": 3}
    dense = next(cell for cell in standard.cells if cell.name == "maze, dense, adversarial").config
    assert (dense.obstacle_density, dense.people, dense.lcf) == (1.0, 200, (-2.0, -0.67))


@pytest.mark.parametrize(("name", "cells"), [("scenarios", 7), ("street", 4), ("dense", 2)])
def test_every_cell_has_room_for_all_its_episodes(name, cells):
    suite = load_suite(name)
    assert len(suite.cells) == cells
    for cell in suite.cells:
        for seed in suite.seeds:
            drawn = spawn(cell.config, np.random.default_rng(seed))
            assert len(drawn.people) == cell.config.people > 0


def test_streets_have_people_as_they_are():
    street = load_suite("street")
    assert len(street.cells) * len(street.seeds) == 100
    for cell in street.cells:
        drawn = [spawn(cell.config, np.random.default_rng(seed)) for seed in street.seeds[:8]]
        speeds = np.concatenate([each.traits.preferred_speed for each in drawn])
        assert speeds.mean() == pytest.approx(1.34, abs=0.08) and speeds.std() == pytest.approx(0.33, abs=0.06)
        together = [np.bincount(each.traits.group)[each.traits.group] > 1 for each in drawn]
        assert 0.44 <= np.mean(together) <= 0.76
        assert all((each.traits.radius == np.float32(0.2)).all() for each in drawn)


def test_courtyards_stand_in_the_straight_way_and_the_way_round_them_is_short():
    dense = load_suite("dense")
    assert (len(dense.cells), len(dense.seeds), dense.cells[0].config.lcf) == (2, 45, (-2.0, 2.0))
    for cell in dense.cells:
        blocked, ratio = [], []
        for seed in dense.seeds:
            drawn = spawn(cell.config, np.random.default_rng(seed))
            start, goal = drawn.robot[:2], drawn.goal
            grid = Grid.from_layout(drawn.layout, 0.25).inflated(0.4)
            line = start + np.linspace(0, 1, 200)[:, None] * (goal - start)
            blocked.append(not all(grid.free(point) for point in line))
            ratio.append(Ways(grid, goal).ahead(start)[2] / np.hypot(*(goal - start)))
        assert np.mean(blocked) > 0.8 and 1.02 < np.mean(ratio) < 1.25


def test_a_digest_follows_all_that_makes_the_episodes(tmp_path):
    paper, scenarios = load_suite("paper"), load_suite("scenarios")
    digests = {load_suite(name).digest for name in suite_names()}
    assert len(digests) == len(suite_names()) and paper.digest == load_suite("paper").digest
    assert dataclasses.replace(paper, seeds=paper.seeds[:-1]).digest != paper.digest
    text = assets.path("maps", "frontal.toml").read_text()
    found = []
    for wall in ("10.0", "9.0"):
        (tmp_path / "frontal.toml").write_text(text.replace("[[-10.0", f"[[-{wall}"))
        cell = dataclasses.replace(scenarios.cells[0], config=TaskConfig(map=str(tmp_path / "frontal.toml")))
        found.append(dataclasses.replace(scenarios, cells=(cell,)).digest)
    assert found[0] != found[1]


SECRET, OTHER = "correct horse battery", "wrong horse, battery"


def test_held_out_seeds_follow_from_the_passphrase_alone():
    suite, standard = held_out(SECRET), load_suite("standard")
    assert load_suite("held-out", SECRET) == suite and held_out(OTHER).digest != suite.digest
    assert suite.cells == standard.cells and suite.of_cells() == [list(seeds) for seeds in suite.apart]
    assert [len(seeds) for seeds in suite.of_cells()] == [len(standard.seeds)] * 27
    assert suite.of_cells(2) == [list(seeds[:2]) for seeds in suite.apart]
    everything = [seed for name in (SECRET, OTHER) for seeds in held_out(name).of_cells() for seed in seeds]
    assert len(set(everything)) == 2 * 270 and all(0 <= seed < 2**63 for seed in everything)
    # frozen, as those of the other suites are: whoever changes the rule changes the exam of every round so far
    assert suite.digest == "f8eae731d4b0"


def test_held_out_seeds_are_in_no_set_of_another_suite():
    """--seed S moves a suite's seeds by whole strides: the place within a stride tells them apart."""
    stride = load_suite("paper").drawn(seed=1)[0] - load_suite("paper").drawn()[0]
    others = {seed % stride for name in suite_names() for seed in load_suite(name).seeds}
    held = {seed % stride for seeds in held_out(SECRET).of_cells() for seed in seeds}
    assert not others & held and max(others) < stride / 2 <= min(held)


def test_held_out_without_a_good_passphrase_is_refused():
    with pytest.raises(ValueError, match="held-out.*passphrase.*--passphrase-file.*BSON_PASSPHRASE"):
        load_suite("held-out")
    for bad in ("", "too short", "x" * 1001, "two lines of text\nof which one"):
        with pytest.raises(ValueError, match="16 to 1000 characters") as caught:
            held_out(bad)
        assert bad not in str(caught.value) or not bad
    with pytest.raises(ValueError, match="'held-out' alone.*'paper'"):
        load_suite("paper", SECRET)
    with pytest.raises(ValueError, match="leave --seed out, not 3"):
        held_out(SECRET).of_cells(seed=3)
    with pytest.raises(ValueError, match="1 to 10 episodes"):
        held_out(SECRET).of_cells(11)
