"""The seam between worlds and what computes them, the table of what is known of a world, and what is loaded for it."""

import copy
import pathlib
import re
import subprocess
import sys

import gymnasium
import mujoco
import numpy as np
import pytest

from bson.episodes.record import Episode, Recorder
from bson.episodes.session import Session
from bson.episodes.tracks import SENSORS, TRACKS, LocalTrack, make_track
from bson.interfaces.gym import BsonEnv, BsonVectorEnv
from bson.sensors import Imu, Lidar2D
from bson.simulation.data import INFO, MAP_RESOLUTION, QUANTITIES
from bson.simulation.world import World
from bson.task import TaskConfig
from macid.geometry import norm

SMALL = {"num_pedestrians": 5, "map_size": 20.0, "goal_distance": (6.0, 15.0)}
TRACK = LocalTrack((Imu(), Lidar2D(beams=60)))
ROOT = pathlib.Path(__file__).parents[2]


class PlainEngine:
    """An Engine (bson.simulation.engines.base) of one MjData a world, stepped by mj_step in turn: the oracle."""

    def __init__(self, model, nworld, nthread=0):
        self.model, self.nworld, self.about = model, nworld, "plain MuJoCo"
        self._data = [mujoco.MjData(model) for _ in range(nworld)]
        self.qpos, self.qvel = np.tile(model.qpos0, (nworld, 1)), np.zeros((nworld, model.nv))
        self.ctrl, self.sensordata = np.zeros((nworld, model.nu)), np.zeros((nworld, model.nsensordata))
        self.mocap_pos, self.mocap_quat = np.zeros((nworld, model.nmocap, 3)), np.zeros((nworld, model.nmocap, 4))
        self._rays = []

    def _go(self, index, call):
        data = self._data[index]
        for name in ("qpos", "qvel", "ctrl", "mocap_pos", "mocap_quat"):
            getattr(data, name)[:] = getattr(self, name)[index]
        call(self.model, data)
        self.qpos[index], self.qvel[index] = data.qpos, data.qvel
        return data

    def reset(self, ids):
        for index in ids:
            data = self._data[index]
            mujoco.mj_resetData(self.model, data)
            for name in ("qpos", "qvel", "ctrl", "mocap_pos", "mocap_quat"):
                getattr(self, name)[index] = getattr(data, name)

    def step(self, ids, steps):
        return np.array([[self._go(index, mujoco.mj_step).qpos.copy() for _ in range(steps)] for index in ids])

    def forward(self, ids):
        for index in ids:
            self.sensordata[index] = self._go(index, mujoco.mj_forward).sensordata

    def warnings(self, ids):
        counts = {row: [one.number for one in self._data[index].warning] for row, index in enumerate(ids)}
        return {row: f"warning {np.argmax(count)}" for row, count in counts.items() if any(count)}

    def add_rays(self, site, directions):
        self._rays.append((site, directions))
        return len(self._rays) - 1

    def rays(self, ids, number):
        site, directions = self._rays[number]
        found, hit = np.empty((len(ids), len(directions))), np.zeros(1, np.int32)
        for row, index in enumerate(ids):
            data, body = self._data[index], self.model.site_bodyid[site]
            for beam, ray in enumerate(directions @ data.site_xmat[site].reshape(3, 3).T):
                found[row, beam] = mujoco.mj_ray(self.model, data, data.site_xpos[site], ray, None, 1, body, hit)
        return np.where(found < 0, np.inf, found)

    def save(self):
        names = ("qpos", "qvel", "ctrl", "mocap_pos", "mocap_quat")
        return [copy.copy(data) for data in self._data], {name: getattr(self, name).copy() for name in names}

    def restore(self, saved):
        data, arrays = saved
        self._data = [copy.copy(one) for one in data]
        for name, array in arrays.items():
            getattr(self, name)[:] = array

    def close(self):
        self._data = []


# The seam.


def _step_and_stop(session, action):
    """A step that is put back."""
    with session.whole():
        session.step([0, 1], action)
        raise KeyboardInterrupt


@pytest.mark.parametrize("model", ["macid", "social-force"])
def test_a_second_engine_plays_the_same_episodes(model):
    config = TaskConfig(**SMALL, pedestrian_model=model, obstacle_density=0.3)
    native, plain = Session(config, TRACK, 2), Session(config, TRACK, 2, engine=PlainEngine)
    ours, theirs = native.reset([0, 1], [3, 4]), plain.reset([0, 1], [3, 4])
    rng = np.random.default_rng(0)
    for step in range(15):
        for key, values in ours.items():
            np.testing.assert_allclose(values, theirs[key], atol=1e-5, err_msg=f"{key}, step {step}")
        action = rng.uniform(-1, 1, (2, 2))
        (ours, reward, *_), (theirs, other, *_) = native.step([0, 1], action), plain.step([0, 1], action)
        np.testing.assert_allclose(reward, other, atol=1e-9)
    np.testing.assert_allclose(native.world.qpos, plain.world.qpos, atol=1e-9)
    assert np.array_equal(native.world.collisions, plain.world.collisions)
    copied = copy.deepcopy(plain)
    with pytest.raises(KeyboardInterrupt):
        _step_and_stop(plain, action)
    for session in (native, plain, copied):
        session.step([0, 1], action)
        np.testing.assert_allclose(native.world.qpos, session.world.qpos, atol=1e-9)


def test_only_the_engine_knows_mujocos_batch():
    for path in (ROOT / "bson").rglob("*.py"):
        names = re.search(r"mujoco\.batch|\.bind\(\"|\.batch\.", path.read_text())
        assert not names or path.parts[-3:] == ("simulation", "engines", "native.py"), (path, names)


def test_no_test_reaches_into_a_world():
    for path in (ROOT / "tests").rglob("*.py"):
        assert not re.search(r"\bworld(\[\w+\])?\._[a-z]|_session\._[a-z]", path.read_text()), path


# Placing.


def test_who_is_placed_is_there_and_moves_as_told():
    world = World(TaskConfig(**{**SMALL, "num_pedestrians": 2}), 3, TRACK.sensors)
    with pytest.raises(gymnasium.error.ResetNeeded):
        world.place([0], pose=[[0.0, 0.0, 0.0]])
    world.reset(range(3), [1, 2, 3])
    before, lidar = world.qpos.copy(), world.readings["lidar"].copy()
    pose = np.array([[1.0, 2.0, 0.5], [-3.0, 0.0, -2.0]])
    people = np.array([[[3.0, 2.0, 1.0], [1.0, 5.0, 0.0]], [[0.0, 0.0, 2.0], [5.0, 5.0, 0.0]]])
    walking = np.array([[[0.3, -0.4], [0, 0]], [[0, 1.0], [-1.0, 0]]])
    world.place([0, 2], pose=pose, people=people, velocity=[[1.5, 0.0], [0.5, -1.0]], people_velocity=walking)
    np.testing.assert_allclose(world.pose[[0, 2]], pose, atol=1e-12)
    np.testing.assert_allclose(world.velocity[[0, 2]], [[1.5, 0.0], [0.5, -1.0]], atol=1e-12)
    assert np.array_equal(world.people[[0, 2]], people)
    assert np.array_equal(world.people_velocity[[0, 2]], walking)
    np.testing.assert_allclose(world.distance[[0, 2]], norm(world.goal[[0, 2]] - pose[:, :2]))
    assert np.array_equal(world.qpos[1], before[1])
    assert np.array_equal(world.readings["lidar"][1], lidar[1])
    assert (world.readings["lidar"][[0, 2]] != lidar[[0, 2]]).any(axis=-1).all()
    assert not world.travelled.any()
    world.step([0], [[1.5, 0.0]])
    assert world.travelled[0] == pytest.approx(0.15, rel=0.05)  # it need not speed up first
    world.place([0])
    assert np.array_equal(world.velocity[0], [0.0, 0.0])
    assert not world.people_velocity[0].any()
    wrong = (("pose", [[0, 0]]), ("people", np.zeros((1, 3, 3))), ("velocity", [[np.nan, 0]]), ("pose", "here"))
    for name, value in wrong:
        with pytest.raises(ValueError, match=f"{name} must be finite numbers of shape"):
            world.place([0], **{name: value})


def test_a_temper_changed_in_mid_episode_changes_what_people_do():
    changed, made, other = (BsonEnv(**SMALL, lcf=lcf) for lcf in (-2.0, 2.0, -2.0))
    for env in (changed, made, other):
        env.reset(seed=1)
    changed.world.lcf[:] = 2.0
    for env in (changed, made, other):
        for _ in range(20):
            env.step([0.0, 0.0])
    assert np.array_equal(changed.world.people, made.world.people)
    assert not np.array_equal(changed.world.people, other.world.people)


# What is known of a world.


def test_a_world_its_info_and_its_episodes_have_what_the_table_says():
    session = Session(TaskConfig(**SMALL, obstacle_density=0.2), TRACK, 2)
    session.reset([0, 1], [3, 4])
    world, recorder = session.world, Recorder(session, 1)
    for _ in range(3):
        session.step([0, 1], np.full((2, 2), 0.5))
        recorder.snap()
    info, episode = session.info([1]), recorder.episode()
    assert tuple(info) == INFO == tuple(each.name for each in QUANTITIES if each.info)
    sides = {"K": 5, "B": world.model.nmocap, "nq": world.model.nq}
    for each in QUANTITIES:
        now, shape = getattr(world, each.name), tuple(sides.get(side, side) for side in each.shape)
        assert now.shape == (2, *shape), each.name
        assert now.dtype == (object if each.kind is str else each.kind), each.name
        if each.info:
            assert np.array_equal(info[each.name], now[1:])
        if each.each:
            rows = getattr(episode, each.each)
            assert rows.shape == (4, *shape)
            assert np.array_equal(rows[-1], now[1])
        if each.last:
            end = getattr(episode, each.last)
            assert np.array_equal(end, now[1])
            assert isinstance(end, np.ndarray if shape else each.kind)
            assert f"- {each.last}: " in Episode.__doc__
    assert len({each.name for each in QUANTITIES}) == len(QUANTITIES)


def _tables(text):
    """The tables of a docstring, each a list of rows, those lists of cells, without the line under the heads."""
    tables, rows = [], []
    for line in text.splitlines():
        if line.strip().startswith("|"):
            rows.append([cell.strip() for cell in line.strip().strip("|").split(" | ")])
        elif rows:
            tables.append([row for row in rows if not row[0].startswith("---")])
            rows = []
    return tables


def test_the_tables_in_the_environments_docstring_are_true():
    actions, observations, more, info = _tables(BsonEnv.__doc__)
    assert len(actions) == 3
    rows = [[each.name, each.shaped() or "-", each.what, each.measured()] for each in QUANTITIES if each.info]
    assert info[1:] == rows
    config = TaskConfig()
    spaces = [make_track(track, sensor).space(config) for track in TRACKS for sensor in SENSORS]
    seen = {key: space.shape for each in spaces for key, space in each.spaces.items()}
    sides = {"cells": str(round(config.map_size / MAP_RESOLUTION)), "K": str(config.people)}
    rows = observations[1:] + more[1:]
    shapes = {key: re.sub(r"[a-zA-Z]+", lambda side: sides[side[0]], shape) for key, shape, *_ in rows}
    assert shapes == {key: str(shape) for key, shape in seen.items()}


def test_infos_of_vector_environments_are_the_same_rows():
    _, info = BsonVectorEnv(2, **SMALL).reset(seed=1)
    assert [name for name in info if not name.startswith("_")] == list(INFO)


# What is loaded.


@pytest.mark.parametrize(
    ("code", "absent"),
    [
        ("from bson.task import TaskConfig; TaskConfig()", ("jax", "torch")),
        ("import mujoco; mujoco.MjSpec = mujoco.MjModel = None; import bson.robot", ("jax", "torch")),  # no model
        ("import bson.evaluation.metrics, bson.episodes.record", ("jax", "mujoco", "scipy", "torch")),
        (
            "import bson.reporting.compare, bson.reporting.leaderboard, bson.evaluation.results",
            ("jax", "mujoco", "scipy", "torch"),
        ),
    ],
)
def test_pure_modules_stay_light(code, absent):
    code += f"; import sys; print([name for name in {absent} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (done.stdout, done.returncode) == ("[]\n", 0), done.stderr
