"""Guided and recurrent robots: what they see, their networks, drawn tasks, and how they learn."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bson import guided, recurrent
from bson.agents import learned, load_agent
from bson.agents.contract import Setting, Unsuited
from bson.agents.global_view import Standing
from bson.agents.guide import MARGIN, Guide, MapSight, ScanSight, grown_by
from bson.agents.ways import Ways
from bson.episodes.session import Session
from bson.episodes.tracks import TRACKS, make_track
from bson.evaluation.device_agents import device_agent
from bson.evaluation.suites import load_suite, suite_names
from bson.features import SECTORS
from bson.planners import Grid, path_cost, plan
from bson.task import TaskConfig
from macid.files import UsageError
from macid.layout import maze_layout

OWN = "bson.learning.algorithms:SacConfig"  # as if it was a user's own algorithm
SMALL = {"map_size": 20.0, "num_pedestrians": 4, "goal_distance": (8.0, 14.0)}


def layers_of(rng, shapes, scale=0.5):
    return [
        (
            rng.normal(size=shape).astype(np.float32) * scale / shape[0] ** 0.5,
            rng.normal(size=shape[1]).astype(np.float32),
        )
        for shape in shapes
    ]


def guided_layers(rng):
    encoder = [(guided.OWN + guided.PERSON, guided.HIDDEN), (guided.HIDDEN, 1 + guided.ENCODED)]
    return layers_of(rng, [*encoder, (guided.ATTENDED, 16), (16, 2)])


def pupil_layers(rng, eye):
    return layers_of(rng, [shape for each in recurrent.shapes(eye).values() for shape in each])


def vectors(rng, number):
    """Vectors as guided robots see them, with some people missing."""
    x = rng.normal(size=(number, guided.SIZE)).astype(np.float32)
    people = x[:, guided.OWN + guided.SCANNED :].reshape(number, guided.PEOPLE, guided.PERSON)
    people[..., 0] = np.arange(guided.PEOPLE) < rng.integers(guided.PEOPLE + 1, size=(number, 1))
    people *= people[..., :1]
    return x


# --- the people's network


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_the_order_of_people_has_no_meaning_and_nobody_counts_for_nothing(seed):
    rng = np.random.default_rng(seed)
    encoder, x = guided_layers(rng)[: guided.ENCODER_LAYERS], vectors(rng, 3)
    y = x.copy()
    people = y[:, guided.OWN + guided.SCANNED :].reshape(3, guided.PEOPLE, guided.PERSON)
    people[:] = people[:, rng.permutation(guided.PEOPLE)]
    people[people[..., 0] == 0, 1:] = 7.0  # what stands in the row of nobody
    np.testing.assert_allclose(guided.attended(encoder, y), guided.attended(encoder, x), atol=1e-4)


def test_attention_is_the_same_in_numpy_jax_and_torch():
    import gymnasium
    import torch

    from bson.learning.algorithms import linear_layers
    from bson.learning.attention import PeopleAttention

    x = vectors(np.random.default_rng(0), 5)
    torch.manual_seed(0)
    eyes = PeopleAttention(gymnasium.spaces.Box(-10.0, 10.0, (guided.SIZE,), np.float32))
    found = guided.attended(linear_layers(eyes), x)
    np.testing.assert_allclose(found, eyes(torch.from_numpy(x)).detach().numpy(), atol=1e-5)
    np.testing.assert_allclose(found, jax.jit(guided.attended)(linear_layers(eyes), jnp.asarray(x)), atol=1e-5)


@pytest.mark.parametrize("eye", recurrent.EYES)
def test_a_recurrent_network_is_the_same_in_numpy_jax_and_torch_and_for_one_and_many(eye):
    import torch

    from bson.learning.recurrent_network import Network

    rng = np.random.default_rng(1)
    torch.manual_seed(1)
    network = Network(eye)
    sizes = {"picture": recurrent.MOTION, "none": recurrent.size("none")}
    x = vectors(rng, 18).reshape(6, 3, -1)
    x = rng.normal(size=(6, 3, sizes[eye])).astype(np.float32) if eye in sizes else x
    seen = rng.random((6, 3, *recurrent.PICTURE)).astype(np.float32) if eye == "picture" else None
    wanted, _ = network(torch.from_numpy(x), None if seen is None else torch.from_numpy(seen))
    state = other = np.zeros((3, recurrent.UNITS), np.float32)
    alone = np.zeros((1, recurrent.UNITS), np.float32)
    step = jax.jit(recurrent.step)
    for now in range(6):
        picture = None if seen is None else seen[now]
        action, state = recurrent.step(network.parts(), x[now], picture, state)
        np.testing.assert_allclose(action, wanted[now].detach().numpy(), atol=1e-5)
        again, other = step(
            network.parts(), jnp.asarray(x[now]), None if picture is None else jnp.asarray(picture), other
        )
        np.testing.assert_allclose(again, action, atol=1e-5)
        single, alone = recurrent.step(network.parts(), x[now, 1:2], None if picture is None else picture[1:2], alone)
        np.testing.assert_allclose(single, action[1:2], atol=1e-6)


# --- what is seen


@settings(max_examples=50, deadline=None)
@given(
    place=st.tuples(st.floats(-8, 8), st.floats(-8, 8)),
    velocity=st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
)
def test_the_time_to_meet_is_when_the_discs_first_touch(place, velocity):
    place, velocity = np.array(place), np.array(velocity)
    when = guided.time_to_meet(place[None], velocity[None], 0.7)[0]
    times = np.linspace(0.0, 10.0, 20001)
    gaps = np.hypot(*(place[:, None] + velocity[:, None] * times)) - 0.7
    if when == 0:
        assert gaps[0] <= 1e-9
    elif np.isfinite(when) and when < 10:
        assert (gaps[times < when - 1e-3] > -1e-6).all() and abs(np.interp(when, times, gaps)) < 2e-3
    else:
        assert gaps.min() > -2e-3


@pytest.fixture(scope="module")
def maze():
    layout = maze_layout(np.random.default_rng(3), 1.0, 30.0)
    return Grid.from_layout(layout, 0.25).inflated(0.5)


def test_ways_are_as_long_as_the_shortest_and_their_aims_in_sight(maze):
    rng = np.random.default_rng(0)
    goal = maze.nearest_free([12.0, -11.0])
    ways = Ways(maze, goal)
    for _ in range(20):
        place = maze.nearest_free(rng.uniform(-14, 14, 2))
        aim, beyond, length = ways.ahead(place)
        shortest = path_cost(plan("dijkstra", maze, place, goal), maze)
        assert np.hypot(*(goal - place)) - 1e-9 <= length <= shortest + 0.5
        assert length >= 0.9 * shortest  # eight neighbours make ways at most 8 % longer than straight ones
        assert ways.in_sight(place, aim[None])[0] and maze.free(beyond)


def test_who_follows_the_aims_arrives_by_about_the_way_s_length(maze):
    goal = maze.nearest_free([12.0, -11.0])
    ways, place = Ways(maze, goal), maze.nearest_free([-13.0, 13.0])
    length, gone = ways.ahead(place)[2], 0.0
    while np.hypot(*(goal - place)) > 0.2:
        to = ways.ahead(place)[0] - place
        move = to * min(1.0, 0.2 / np.hypot(*to))
        place, gone = place + move, gone + np.hypot(*move)
        assert gone < length + 1.0
    assert gone > 0.9 * length


def test_walls_grow_as_those_of_a_grid_do():
    rng = np.random.default_rng(0)
    for radius in (0.3, 0.48, 0.7):
        occupied = np.pad(rng.random((40, 40)) < 0.02, 8)
        wanted = Grid(occupied, 0.25, [0.0, 0.0]).inflated(radius).occupied
        inside = np.s_[4:-4, 4:-4]
        assert np.array_equal(grown_by(occupied, radius, 0.25)[inside], wanted[inside])


def test_who_stands_is_told_by_the_mean_of_velocities():
    standing, period = Standing(0.1), 0.1
    for step in range(60):
        walks = [1.2, 0.0] if step < 30 else [0.0, 0.0]
        standing.see(np.array([walks, [0.5 * (-1) ** step, 0.0], [0.0, 0.0]]))
        if step in (0, 10, 29, 59):  # nobody at first; after half a second who stays where they are
            after = step * period > 0.5
            assert standing.stands.tolist() == [step == 59, after, after]
    standing.forget()
    standing.see(np.zeros((2, 2)))
    assert not standing.stands.any()


@pytest.mark.parametrize("doors", [1, 2])
def test_a_guide_leads_round_people_who_stand_where_there_is_another_way(doors):
    """A wall along x = 0 with doors at y = 0 and at y = 6, or at y = 0 alone; somebody comes to stand in the first."""
    config = TaskConfig(map_size=20.0)
    occupied = np.zeros((80, 80), bool)
    occupied[:, 39:41] = True
    occupied[36:44, 39:41] = False
    if doors == 2:
        occupied[60:68, 39:41] = False
    grid, goal = Grid(occupied, 0.25, [-10.0, -10.0]).inflated(config.robot.radius + MARGIN), np.array([5.0, 0.0])
    setting = Setting.of(config, make_track("global", "lidar2d"))
    guide, pose, lengths, people = Guide(setting, grid, goal), np.array([-3.0, 0.0, 0.0]), [], np.zeros((40, 1, 2))
    people[:10, 0, 1] = np.linspace(3.0, 0.0, 10)
    seen = {"velocity": np.zeros(2), "goal": np.array([8.0, 0.0]), "lidar": np.full(720, 10.0)}
    for place in people:
        x = guide.see(seen, pose, place)
        lengths.append(guide.length)
    assert lengths[0] == pytest.approx(8.0)
    assert np.arctan2(x[7], x[6]) == pytest.approx(0.0, abs=1e-6) if doors == 1 else np.arctan2(x[7], x[6]) > 0.8
    assert guide.length == pytest.approx(8.0 if doors == 1 else np.hypot(3, 6) + np.hypot(5, 6), rel=0.1)
    guide.see(seen, pose, np.full((1, 2), 9.0))  # who stood there is gone
    for _ in range(40):
        guide.see(seen, pose, np.full((1, 2), 9.0))
    assert guide.length == pytest.approx(8.0)


def test_without_a_way_the_goal_is_the_aim():
    occupied = np.zeros((20, 20), bool)
    occupied[:, 10] = True
    ways = Ways(Grid(occupied, 0.5, [0.0, 0.0]), np.array([8.0, 5.0]))
    aim, beyond, length = ways.ahead(np.array([1.0, 5.0]))
    assert (aim == [8.0, 5.0]).all() and (beyond == aim).all() and length == 7.0
    none = Ways(Grid(np.ones((5, 5), bool), 0.5, [0.0, 0.0]), np.array([1.0, 1.0]))
    assert (none.ahead(np.array([2.0, 2.0]))[0] == [1.0, 1.0]).all()


def driven(config, kind, seed, policy, steps=400):
    """An episode's last distance to the goal where `policy` acts on what `kind` sees."""
    track = make_track(kind.track, "lidar2d")
    session, sight = Session(config, track, 1), kind(Setting.of(config, track))
    observation = session.reset([0], [seed])
    for _ in range(steps):
        x = sight.see({name: value[0] for name, value in observation.items()})
        assert x.shape == (guided.SIZE,) and np.isfinite(x).all() and np.abs(x).max() <= 10
        observation, _, terminated, _ = session.step([0], policy(x)[None])
        if terminated[0]:
            break
    return float(session.world.distance[0])


@pytest.mark.parametrize("kind", [MapSight, ScanSight])
def test_who_follows_what_a_guided_robot_sees_gets_through_a_maze(kind):
    def follow(x):
        turn = np.arctan2(x[7], x[6])
        return np.array([max(0.0, 1.0 - 1.5 * abs(turn)), np.clip(2.0 * turn, -1.0, 1.0)])

    config = TaskConfig(obstacle_density=1.0, map_size=20.0, num_pedestrians=0, goal_distance=(10.0, 18.0))
    assert driven(config, kind, 5, follow) < 0.5


# --- agents


def test_a_reset_forgets_and_no_memory_comes_from_elsewhere():
    rng = np.random.default_rng(0)
    config, track = TaskConfig(**SMALL), make_track("local", "lidar2d")
    agent, other = (
        learned.Pupil(pupil_layers(np.random.default_rng(2), "people"), "clip", Setting.of(config, track)) for _ in "ab"
    )
    session = Session(config, track, 1)
    seen = [{name: value[0] for name, value in session.reset([0], [4]).items()}]
    for _ in range(6):
        seen.append({name: value[0] for name, value in session.step([0], rng.uniform(-1, 1, (1, 2)))[0].items()})
    agent.reset(0)
    first = np.array([agent(one) for one in seen])
    later = np.array([agent(one) for one in seen])
    agent.reset(1)
    assert np.array_equal(np.array([agent(one) for one in seen]), first) and not np.array_equal(later, first)
    other.reset(0)
    assert np.array_equal(np.array([other(one) for one in seen]), first)


@pytest.mark.parametrize("inputs", ["guided", "guided-scans", "gru", "gru-map", "camera", "gru-scans"])
def test_policies_are_read_as_they_were_written(inputs, tmp_path):
    rng, kind = np.random.default_rng(0), learned.KINDS[inputs]
    layers = pupil_layers(rng, kind.eye) if issubclass(kind, learned.Pupil) else guided_layers(rng)
    track = make_track("local", kind.sensor)
    setting = learned.setting_document(Setting.of(TaskConfig(), track), getattr(kind, "pictures", False))
    recipe = {"output": "clip", "inputs": inputs, "setting": setting}
    learned.write(tmp_path / "mine", layers, recipe)
    factory = load_agent(str(tmp_path / "mine.npz"))
    assert (factory.track, factory.sensor) == (kind.track, kind.sensor)
    agent = factory()
    held = (
        [layer for part in agent.network.values() for layer in part]
        if inputs[0] in "gc" and "network" in vars(agent)
        else agent.layers
    )
    for (weight, bias), (other, its) in zip(held, layers, strict=True):
        assert np.array_equal(weight, other) and np.array_equal(bias, its)

    slow = Setting.of(TaskConfig(control_period=0.2), make_track(kind.track, kind.sensor))
    with pytest.raises(Unsuited, match="control_period 0.1 s, not with control_period 0.2 s"):
        factory(slow)
    blind = Setting.of(TaskConfig(), make_track(kind.track, "lidar3d"))
    with pytest.raises(Unsuited, match="needs a (Lidar2D|DepthCamera)"):
        factory(blind)
    asked = "mine.npz", factory, TaskConfig(), make_track(kind.track, kind.sensor), "mine.npz"
    if inputs in ("camera", "gru-scans"):
        device_agent(*asked)
    else:
        with pytest.raises(UsageError, match=f"see scans, gru-scans, camera; 'mine.npz' sees {inputs}"):
            device_agent(*asked)

    recipe["inputs"] = "scans"
    (tmp_path / "mine.json").write_text(json.dumps(recipe))
    with pytest.raises(UsageError, match="mine"):
        load_agent(str(tmp_path / "mine.npz"))
    recipe["inputs"] = "eyes"
    (tmp_path / "mine.json").write_text(json.dumps(recipe))
    with pytest.raises(UsageError, match="scans, guided, guided-scans, gru, gru-map, camera, gru-scans, not 'eyes'"):
        load_agent(str(tmp_path / "mine.npz"))


# --- drawn tasks


def test_drawn_seeds_are_no_suite_s():
    from bson.learning.draw import training_seed, validation_seeds

    rng = np.random.default_rng(0)
    drawn = {training_seed(rng) for _ in range(200)} | set(validation_seeds(50))
    assert len(drawn) == 250
    for name in suite_names():
        suite = load_suite(name)
        assert max(max(suite.drawn(seed=seed)) for seed in (0, 9, 1000)) < min(drawn)


def test_the_standard_draw_spans_the_suite_standard():
    from bson.learning.draw import load_draw

    draw, rng = load_draw("standard"), np.random.default_rng(0)
    found = [draw.setting(rng, TaskConfig(control_period=0.2)) for _ in range(400)]
    assert {config.control_period for config in found} == {0.2}
    assert {config.people for config in found} <= {*draw.sizes}
    density = [config.people / config.map_size**2 for config in found]
    assert min(density) < 0.01 and max(density) > 0.075
    walls = [config.obstacle_density for config in found]
    assert min(walls) == 0 and max(walls) == 1 and any(0.4 < wall < 0.6 for wall in walls)
    cells = {cell.config.lcf for cell in load_suite("standard").cells}
    assert cells <= {config.lcf for config in found}
    assert {"macid", "orca", "social-force"} <= {name for config in found for name in config.model_shares}
    assert any(config.map for config in found) and len(draw.validation) > 3


DRAW = """
name = "mine"
description = "a test"
sizes = [2, 4]
[[kinds]]
share = 1
[kinds.config]
map_size = 20.0
goal_distance = [8.0, 14.0]
pedestrian_density = {{ from = 0.0, to = {most} }}
{more}
[[validation]]
map_size = 20.0
num_pedestrians = 2
goal_distance = [8.0, 10.0]
horizon = 5
"""


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"most": "-1.0"}, "from <= to"),
        ({"most": "2.0"}, "must be between 0 and 1"),
        ({"more": "colour = 3"}, "Unknown option 'colour'"),
        ({"more": "lcf = { among = [] }"}, "among must be a list of values"),
        ({"more": "lcf = { among = [99.0] }"}, "lcf must lie in"),
    ],
)
def test_a_faulty_draw_is_refused_by_its_part(fields, told, tmp_path):
    from bson.learning.draw import load_draw

    (tmp_path / "mine.toml").write_text(DRAW.format(**{"most": "1.0", "more": "", **fields}))
    with pytest.raises(UsageError, match=told) as refused:
        load_draw(str(tmp_path / "mine.toml"))
    assert "kinds[0].config" in str(refused.value)


# --- learning


@pytest.fixture
def draw(tmp_path):
    (tmp_path / "mine.toml").write_text(DRAW.format(most=1.0, more="horizon = 30"))
    return str(tmp_path / "mine.toml")


def test_guided_worlds_show_what_the_agent_sees_and_pay_for_the_way(draw):
    from bson.learning.draw import load_draw
    from bson.learning.guided_env import GuidedVecEnv

    def run(seed):
        env = GuidedVecEnv(3, seed, load_draw(draw), TaskConfig(reward={"collision": 0.0, "goal": 0.0}), nthread=1)
        rng, found, paid = np.random.default_rng(0), [env.reset()], np.zeros(3)
        lengths = env._groups[0]._length.copy()
        for _ in range(20):
            x, reward, done, _ = env.step(rng.uniform(-1, 1, (3, 2)).astype(np.float32))
            found.append(x)
            paid += reward
            assert not done.any()
        np.testing.assert_allclose(paid, lengths - env._groups[0]._length, atol=1e-4)
        for _ in range(10):
            _, _, done, infos = env.step(np.zeros((3, 2), np.float32))
        assert done.all() and all(info["TimeLimit.truncated"] for info in infos)
        assert all("SNS" in info["episode"] and info["terminal_observation"].shape == (guided.SIZE,) for info in infos)
        env.close()
        return np.array(found)

    one, again, other = run(0), run(0), run(1)
    assert np.array_equal(one, again) and not np.array_equal(one, other)


@pytest.mark.parametrize("inputs", ["gru", "gru-map"])
def test_a_pupil_that_drives_behind_the_shield_runs_into_no_wall(inputs):
    from bson.learning.dagger import DaggerConfig, Episodes, gather

    kind = learned.KINDS[inputs]
    shapes = recurrent.shapes(kind.eye)
    ahead = {part: [(np.zeros(shape, np.float32), np.zeros(shape[1], np.float32)) for shape in shapes[part]]
             for part in shapes}  # fmt: skip
    ahead[recurrent.HEAD][-1][1][:] = 1.0, 0.0
    setting = TaskConfig(obstacle_density=1.0, map_size=20.0, num_pedestrians=0, goal_distance=(10.0, 18.0), horizon=50)
    nearest = {}
    for shield in (False, True):
        found, chosen = Episodes(), DaggerConfig("vfh", shield=shield)
        gather(load_agent("vfh"), kind, ahead, lambda: setting, 1, np.random.default_rng(1), chosen, found, nworld=4)
        scans = np.concatenate(found.vector)[:, guided.OWN : guided.OWN + SECTORS]
        nearest[shield] = scans[:, SECTORS // 2 - 2 : SECTORS // 2 + 2].max()  # 1 at the sensor
    assert nearest[True] < 0.98 < nearest[False]  # 0.16 m


def test_the_guided_env_and_the_guided_agent_see_the_same():
    from bson.learning.guided_env import _Group

    config = TaskConfig(obstacle_density=0.5, **SMALL)
    group = _Group(0, 1, np.random.default_rng(3), None, config, make_track("global", "lidar2d"), 1)
    x = group.begin_round()
    group._blind[:] = False
    sight = MapSight(Setting.of(config, make_track("global", "lidar2d")))
    for step in range(10):
        seen = {name: value[0] for name, value in group._session.observe([0]).items()}
        told = sight.see(seen)
        if step:
            np.testing.assert_allclose(told, x[0], atol=2e-3)
        x, *_ = group.step(np.array([[0.5, 0.2]], np.float32))
    group.close()


def test_a_guided_robot_learns_resumes_and_drives(draw, tmp_path):
    from bson.learning.algorithms import SacConfig
    from bson.learning.train import TrainConfig, train

    chosen = SacConfig(hidden=(16,), batch=16, buffer=500, learning_starts=32, q=1.2)
    config = TrainConfig("tac", 0, 96, {}, 4, 1000, 1, chosen, "guided", draw)
    folder = train(config, tmp_path, seconds_between_checkpoints=0)
    assert folder.name == "tac-guided-mine-0" and train(config, tmp_path, resume=True) == folder
    longer = dataclasses.replace(config, steps=160)
    with pytest.raises(UsageError, match="steps is 96, not 160"):
        train(longer, tmp_path, resume=True)
    recipe = json.loads((folder / "policy.json").read_text())
    assert recipe["inputs"] == "guided" and recipe["validations"]
    agent = load_agent(str(folder / "policy.npz"))
    assert agent.track == "global" and agent().act(vectors(np.random.default_rng(0), 3)).shape == (3, 2)


def test_pupil_and_teacher_share_a_world_with_all_that_both_see():
    from bson.learning.dagger import common_track

    cases = {
        ("tac", learned.CameraPupil): "local",
        ("mppi", learned.Pupil): "global",
        ("goal", learned.MapPupil): "global",
    }
    for (teacher, pupil), wanted in cases.items():
        track = common_track(load_agent(teacher), pupil)
        assert type(track) is TRACKS[wanted]
        keys = {sensor.key for sensor in track.sensors}
        assert keys == {"imu", "lidar", "depth"} if pupil.pictures else keys == {"imu", "lidar"}


def test_a_depth_picture_keeps_the_nearest_pixel_of_each_block():
    depth = np.full((120, 160), 10.0, np.float32)
    depth[7, 9] = 1.5
    seen = recurrent.picture(depth)
    assert seen.shape == recurrent.PICTURE and seen[1, 2] == 0.75 and np.count_nonzero(seen) == 1


@pytest.mark.parametrize("inputs", ["gru", "gru-map", "gru-scans"])
def test_a_resumed_imitation_equals_an_uninterrupted_one(inputs, draw, tmp_path, monkeypatch):
    from bson.learning.dagger import DaggerConfig, Imitation, Noted
    from bson.learning.train import TrainConfig, train
    from macid.learning.curves import read_checkpoint

    config = TrainConfig(
        "bc", 0, 480, {}, 4, 1000, 1, DaggerConfig("goal", 2, batch=2, piece=8, updates=3), inputs, draw
    )
    whole = train(config, tmp_path / "whole")

    rounds, once = [], Imitation.round

    def stopped(self, *arguments):
        if rounds:
            raise KeyboardInterrupt
        rounds.append(1)
        once(self, *arguments)

    monkeypatch.setattr(Imitation, "round", stopped)
    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path / "parts")
    monkeypatch.undo()
    parts = train(config, tmp_path / "parts", resume=True)
    (one, first), (other, second) = (read_checkpoint(folder, Noted) for folder in (whole, parts))
    assert one.keys() == other.keys() and first["generator"] == second["generator"] and second["rounds"] == 2
    assert all(np.array_equal(one[name], other[name]) for name in one)
    one, other = (np.load(folder / "policy.npz") for folder in (whole, parts))
    assert all(np.array_equal(one[name], other[name]) for name in one.files)
    assert load_agent(str(parts / "policy.npz")).track == ("global" if inputs == "gru-map" else "local")


def test_a_pupil_goes_on_from_a_policy_and_drives_from_the_first_round_on(tmp_path, monkeypatch):
    """With no update at all it stays the policy that it began as; the teacher drives in no round."""
    from bson.learning import dagger
    from bson.learning.train import TrainConfig, train

    gathered, drove = dagger.gather, []
    monkeypatch.setattr(dagger, "gather", lambda *a, **more: drove.append(a[2]) or gathered(*a, **more))
    chosen = dagger.DaggerConfig("vfh", rounds=2, updates=0)
    config = TrainConfig("bc", 0, 60, SMALL, 2, 1000, 1, chosen, "gru", None, "gru")
    folder = train(config, tmp_path)
    assert folder.name == "bc-gru-from-gru-0" and len(drove) == 2 and None not in drove
    ours, theirs = (np.load(path) for path in (folder / "policy.npz", "assets/agents/gru.npz"))
    assert ours.files == theirs.files and all(np.array_equal(ours[name], theirs[name]) for name in ours.files)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (
            {"algo": "bc", "inputs": "guided"},
            "bc learns with --inputs of scans, gru, gru-map, camera, gru-scans, not guided",
        ),
        ({"algo": OWN, "inputs": "gru"}, f"{OWN} learns with --inputs of scans, guided, guided-scans, not gru"),
        ({"inputs": "eyes"}, "inputs must be one of"),
        ({"draw": "standard"}, "A draw is for robots with --inputs of guided"),
        ({"inputs": "guided", "draw": "nowhere"}, "Unknown draw 'nowhere'"),
    ],
)
def test_what_does_not_fit_is_refused(arguments, told):
    from bson.learning.train import TrainConfig

    with pytest.raises((UsageError, ValueError), match=told):
        TrainConfig(**arguments)


@pytest.mark.parametrize("inputs", ["gru", "gru-map", "camera"])
def test_bc_has_a_configuration_of_its_own_for_robots_with_a_memory(inputs, tmp_path):
    from bson import benchmark
    from bson.learning.dagger import DaggerConfig
    from bson.learning.presets import hyperparameters
    from bson.learning.train import TrainConfig

    assert hyperparameters("bc", inputs=inputs) == DaggerConfig() == TrainConfig("bc", inputs=inputs).hyperparameters
    for more in ({}, {"teacher": "goal"}):  # the paper has no such robot
        with pytest.raises(UsageError, match=f"--inputs {inputs} learns with no BcConfig"):
            benchmark.train("bc", tmp_path / "runs", inputs=inputs, preset="paper", **more)
    assert not (tmp_path / "runs").exists()
