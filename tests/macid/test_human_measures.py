import numpy as np
import pytest

from macid.human import measures
from macid.human.measures import STRIDE, Box


def straight(start, velocity, samples=30, period=STRIDE):
    """One person's walk (T, 2)."""
    return np.asarray(start) + np.outer(np.arange(samples) * period, velocity)


def walks(*people):
    return np.stack(people, axis=1)


def test_two_discs_head_on_meet_when_they_touch():
    apart, closing = np.array([5.0, 0.0]), np.array([-2.0, 0.0])
    assert measures.time_to_collision(apart, closing) == pytest.approx((5.0 - 0.4) / 2.0)
    assert measures.time_to_collision(apart, -closing) == np.inf
    assert measures.time_to_collision(np.array([5.0, 0.41]), closing) == np.inf
    assert measures.time_to_collision(np.array([0.3, 0.0]), closing) == np.inf  # they overlap


def test_a_glancing_collision_is_where_the_centres_distance_says():
    rng = np.random.default_rng(0)
    apart, velocity = rng.uniform(-4, 4, (500, 2)), rng.uniform(-2, 2, (500, 2))
    times = measures.time_to_collision(apart, velocity)
    meets = np.isfinite(times)
    then = apart[meets] + velocity[meets] * times[meets, None]
    assert meets.sum() > 20
    assert np.linalg.norm(then, axis=-1) == pytest.approx(measures.CENTRES)


def test_constant_speed_has_no_acceleration_and_a_straight_way_is_straight():
    person = measures.people(walks(straight((0, 0), (1.2, 0.5)), straight((3, 3), (0.0, 0.1))), STRIDE)
    assert person.speed == pytest.approx([1.3, 0.1])
    assert person.within == pytest.approx(0.0, abs=1e-9) and person.smoothness == pytest.approx(0.0, abs=1e-9)
    assert person.straightness == pytest.approx(1.0)
    assert person.walks.tolist() == [True, False]


def test_speeding_up_evenly_is_that_acceleration():
    times = np.arange(30) * 0.1
    walk = np.stack([0.25 * times**2, np.zeros(30)], axis=-1)  # 0.5 m/s2
    person = measures.people(walk[:, None], 0.1)
    assert person.smoothness == pytest.approx(0.5)
    assert np.isnan(measures.people(walk[:6, None], 0.1).speed)  # seen for less than three strides


def test_a_half_circle_is_as_straight_as_its_diameter():
    angle = np.linspace(0, np.pi, 200)
    person = measures.people(np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None], STRIDE)
    assert person.straightness == pytest.approx(2 / np.pi, rel=1e-3)


def test_who_walks_side_by_side_are_companions_and_who_pass_are_not():
    side = straight((0, 0), (1.2, 0)), straight((0, 0.7), (1.2, 0))
    passing, behind = straight((30, 0.3), (-1.2, 0)), straight((-4, 0), (1.2, 0))
    known = measures.companions(walks(*side, passing, behind), STRIDE)
    assert np.argwhere(known).tolist() == [[0, 1], [1, 0]]


def random_walks(rng, people, samples=150):
    """People who cross a square at random and see nobody."""
    position = np.full((samples, people, 2), np.nan)
    for who in range(people):
        begin, angle = rng.integers(0, samples - 25), rng.uniform(0, 2 * np.pi)
        ahead = np.array([np.cos(angle), np.sin(angle)])
        middle = rng.uniform(-4, 4, 2)
        position[begin : begin + 25, who] = middle + np.outer(np.arange(-12, 13) * STRIDE * 1.3, ahead)
    return position


def test_who_see_nobody_anticipate_nothing_and_who_see_do():
    position = random_walks(np.random.default_rng(1), 300)
    velocity = measures.velocities(position, STRIDE)
    nobody = np.zeros((300, 300), bool)
    blind = measures.meetings(position, velocity, nobody)
    assert np.abs(blind.anticipation()) == pytest.approx(0.0, abs=0.25)
    assert blind.anticipation()[1] < 0.5
    # The same people, of whom those who were about to meet within 1.2 s turned round in time.
    keep = np.ones(position.shape[:2], bool)
    for at in range(len(position)):
        times = measures.time_to_collision(
            position[at][None] - position[at][:, None], velocity[at][None] - velocity[at][:, None]
        )
        keep[at] &= ~(np.nan_to_num(times, nan=np.inf) < 1.2).any(axis=1)
    seeing = measures.meetings(np.where(keep[..., None], position, np.nan), velocity, nobody)
    assert seeing.anticipation()[0] > 2.0 or np.isinf(seeing.anticipation()[0])


def test_meetings_count_strangers_only_and_time_of_everybody():
    position = walks(straight((0, 0), (1.0, 0), 5), straight((4, 0), (-1.0, 0), 5), straight((0, 9), (1.0, 0), 5))
    velocity = measures.velocities(position, STRIDE)
    strangers, friends = np.zeros((3, 3), bool), np.zeros((3, 3), bool)
    friends[0, 1] = friends[1, 0] = True
    found = measures.meetings(position, velocity, strangers)
    # Apart 4.0, 3.2, 2.4, 1.6, 0.8 m: touching after 1.8, 1.4, 1.0, 0.6, 0.2 s.
    assert found.time == 15 and found.soon_share == pytest.approx(10 / 15)
    assert measures.meetings(position, velocity, friends).soon == 0
    assert found.close_shares == pytest.approx([0.0, 0.0])
    twice = measures.Meetings.added([found, found])
    assert twice.time == 30 and twice.soon_share == found.soon_share


def test_a_lattice_has_its_density_and_a_marching_crowd_its_speed():
    x, y = np.meshgrid(np.arange(0.25, 2.0, 0.5), np.arange(-20.0, 20.0, 0.5))
    start = np.stack([x.ravel(), y.ravel()], axis=-1)
    position = start + np.arange(40)[:, None, None] * 0.1 * np.array([0.0, -0.8])
    density, speed = measures.densities(position, 0.1, Box((0.0, 2.0), (-1.0, 1.0)))
    assert density.mean() == pytest.approx(4.0) and speed == pytest.approx(0.8)
    assert np.isnan(measures.binned(density, speed)).all()  # beyond the diagram
    assert measures.binned(density / 2, speed)[3] == pytest.approx(0.8)


def test_pedpys_classic_density_and_flow_are_ours():
    pedpy = pytest.importorskip("pedpy")
    import pandas

    rng = np.random.default_rng(2)
    start = np.stack([rng.uniform(0, 2, 60), rng.uniform(2, 30, 60)], axis=-1)
    position = start + np.arange(200)[:, None, None] * 0.1 * np.array([0.0, -1.1])
    frame, who = np.indices(position.shape[:2])
    table = pandas.DataFrame(
        {"id": who.ravel(), "frame": frame.ravel(), "x": position[..., 0].ravel(), "y": position[..., 1].ravel()}
    )
    theirs = pedpy.TrajectoryData(table, frame_rate=10.0)
    area = pedpy.MeasurementArea([(0, -1), (2, -1), (2, 1), (0, 1)])
    classic = pedpy.compute_classic_density(traj_data=theirs, measurement_area=area)["density"].to_numpy()
    density, _ = measures.densities(position, 0.1, Box((0.0, 2.0), (-1.0, 1.0)))
    assert density == pytest.approx(classic[classic > 0], abs=0.26)  # who stands on the edge
    line = pedpy.MeasurementLine([(-1, 0), (3, 0)])
    crossing = pedpy.compute_n_t(traj_data=theirs, measurement_line=line)[0]
    count = crossing["cumulative_pedestrians"].max()
    times = measures.crossing_times(position, 0.1, 0.0)
    assert len(times) == count


def test_a_timed_crossing_has_its_flow():
    position = walks(*(straight((0, 1.0 + 0.5 * number), (0.0, -1.0), 400, 0.1) for number in range(40)))
    times = measures.crossing_times(position, 0.1, 0.0)
    assert times == pytest.approx(1.0 + 0.5 * np.arange(40))
    assert measures.flow(times, 1.5, 40, 60.0) == pytest.approx(2.0 / 1.5)
    assert measures.flow(times[:2], 1.5, 40, 60.0) == pytest.approx(2 / 60 / 1.5)  # a jam
    assert measures.flow(times[:10], 1.5, 40, 11.0) == pytest.approx((10 - 1 - 4) / (11.0 - 3.0) / 1.5)
    assert measures.flow(times[:0], 1.5, 40, 60.0) == 0.0
    assert len(measures.crossing_times(position, 0.1, 0.0, way=1)) == 0


def test_perfect_lanes_give_one_and_shuffled_ones_chance():
    rng = np.random.default_rng(3)
    x = np.repeat([0.5, 1.5, 2.5, 3.5], 8)
    position = np.stack([x, rng.uniform(-4, 4, 32)], axis=-1)[None]
    lanes = np.repeat([1.0, -1.0, 1.0, -1.0], 8)
    assert measures.lane_order(position, lanes) == 1.0
    shuffled = [measures.lane_order(position, rng.choice([-1.0, 1.0], 32)) for _ in range(400)]
    assert np.mean(shuffled) == pytest.approx(1 / 8, abs=0.02)
    assert np.isnan(measures.lane_order(position[:, :1], lanes[:1]))


def test_errors_are_distances_and_who_has_arrived_stands_there():
    real = walks(straight((0, 0), (1.0, 0), 11), straight((0, 5), (1.0, 0), 11))
    assert measures.displacement_errors(real, real) == (0.0, 0.0)
    assert measures.displacement_errors(real + np.array([3.0, 4.0]), real) == pytest.approx((5.0, 5.0))
    early = real.copy()
    early[6:, 0] = np.nan
    ade, fde = measures.displacement_errors(early, real)
    assert fde == pytest.approx((5 * STRIDE) / 2) and ade == pytest.approx(STRIDE * (1 + 2 + 3 + 4 + 5) / 11 / 2)


def test_wasserstein_is_how_far_values_moved():
    speeds = np.random.default_rng(4).normal(1.2, 0.3, 200)
    assert measures.wasserstein(speeds, speeds) == 0.0
    assert measures.wasserstein(speeds + 0.1, np.append(speeds, np.nan)) == pytest.approx(0.1)
    assert np.isnan(measures.wasserstein(speeds, np.array([np.nan])))
