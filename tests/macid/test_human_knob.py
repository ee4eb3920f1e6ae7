"""What the LCF does to people (macid.human.knob)."""

import jax.numpy as jnp
import numpy as np
import pytest

from macid.cli import main
from macid.files import UsageError
from macid.human import knob
from macid.human.measure import Options, has_lcf, knob_lines, measure
from macid.human.stage import Body
from macid.layout import clearance
from macid.pedestrians.learned import goal_command


def test_touching_is_a_share_of_the_time_in_which_somebody_is_there():
    near, far = [[0.0, 0.0], [0.4, 0.0]], [[0.0, 0.0], [1.0, 0.0]]
    assert knob.touch_share(np.array([near, far, far, far]), 0.2) == 0.25
    gone = np.array([near, [[np.nan, np.nan], [0.4, 0.0]]])
    assert knob.touch_share(gone, 0.2) == pytest.approx(2 / 3)  # one of three
    assert knob.touch_share(np.array([near]), 0.19) == 0.0


def test_a_sidestep_is_the_farthest_from_the_line_of_the_start():
    walks = np.array([[[1.0, -5], [2.0, 5]], [[1.3, 0], [1.9, 0]], [[0.9, 5], [np.nan, np.nan]]])
    assert knob.sidesteps(walks) == pytest.approx([0.3, 0.1])


@pytest.mark.parametrize("where", knob.WHERE)
def test_crowds_have_room_and_pairs_meet(where):
    rng, body = np.random.default_rng(1), Body(0.2, 2.0)
    crowd = knob.crowd_cast(where, body, rng, lambda number: np.full(number, 1.3))
    apart = np.linalg.norm(crowd.place[:, None] - crowd.place, axis=-1)
    assert len(crowd.place) == knob.CROWD and apart[~np.eye(knob.CROWD, dtype=bool)].min() >= 0.4
    pair = knob.pair_cast(where, rng)
    assert abs(np.diff(pair.place[:, 0])[0]) < 0.4  # on a collision course
    assert (np.sign(pair.goal[:, 1]) == -np.sign(pair.place[:, 1])).all()
    if where == "corridor":
        walls = knob.two_ways_layout().boxes
        assert min(clearance(each, walls).min() for each in (crowd.place, crowd.goal, pair.place)) >= 0.2


def test_only_models_that_learned_lcfs_have_a_knob(tmp_path, monkeypatch):
    assert has_lcf("macid-0") and not has_lcf("ipo-0") and not has_lcf("orca")
    monkeypatch.chdir(tmp_path)
    assert main(["human", "measure", "--pedestrian", "orca", "--only", "knob"]) == 2
    with pytest.raises(UsageError, match="'ipo' has no LCF that does anything"):
        measure("ipo", None, Options(only="knob", seeds=1))
    assert knob_lines({}) == []


@pytest.mark.slow
def test_people_whose_lcf_makes_them_step_aside_give_way_by_it():
    def aside(state, boxes, goals, lcf):
        """At 1.3 m/s to the goal, but to the right before the other one by (2 + LCF)."""
        before = jnp.abs(state.position[..., 1]) < 2.0
        velocity = jnp.stack([jnp.full(lcf.shape, 1.3), jnp.where(before, -0.15 * (2.0 + lcf), 0.0)], axis=-1)
        return goal_command(velocity, state, goals, 0.1)

    found = knob.knob(aside, 0.1, Body(0.2, 2.0), [0, 1])
    assert found["way_rank"]["open"] == [1.0, 1.0]
    assert all(0.0 <= value <= 1.0 for row in found["way"]["open"] for value in row)
    assert len(found["touch"]["corridor"]) == 2 and len(found["touch"]["corridor"][0]) == len(knob.LCFS)
