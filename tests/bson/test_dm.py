import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from absl.testing import absltest
from dm_env import test_utils

import bson.dm
from bson.episodes.tracks import SENSORS, TRACKS
from macid.drawing.gl import gl_problem

FEW = {"num_pedestrians": 3, "map_size": 12.0, "goal_distance": (2.0, 8.0), "pedestrian_model": "social-force"}


class Conformance(test_utils.EnvironmentTestMixin):
    """dm_env's own test of what an environment must do."""

    def make_object_under_test(self):
        return bson.dm.load(self.track, self.sensor, **FEW, horizon=7, seed=1)


for _track in TRACKS:
    for _sensor in SENSORS:
        _drawn = _sensor == "camera" and gl_problem()
        _case = type(f"Test{_track}{_sensor}", (Conformance, absltest.TestCase), {"track": _track, "sensor": _sensor})
        globals()[_case.__name__] = pytest.mark.skipif(bool(_drawn), reason=str(_drawn))(_case)
del _case


@pytest.mark.skipif(bool(gl_problem()), reason=str(gl_problem()))
def test_a_process_that_drew_before_dm_control_came_ends_in_silence():
    script = (
        "import gymnasium, bson\n"
        "env = gymnasium.make('BSON/LocalCamera-v0', num_pedestrians=1)\n"
        "env.reset(seed=1)\n"
        "import bson.dm\n"
        "bson.dm.load('local', 'camera', num_pedestrians=1).reset()\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")


def test_it_plays_what_gymnasium_plays():
    ours, theirs = bson.dm.load(**FEW, seed=5), gymnasium.make("BSON/LocalLidar2D-v0", **FEW)
    step, (observation, _) = ours.reset(), theirs.reset(seed=5)
    assert step.first() and step.reward is None
    rng = np.random.default_rng(0)
    for _ in range(12):
        for name, values in observation.items():
            np.testing.assert_array_equal(step.observation[name], values)
            ours.observation_spec()[name].validate(step.observation[name])
        action = rng.uniform(-1, 1, 2).astype(np.float32)
        step, (observation, reward, *_) = ours.step(action), theirs.step(action)
        assert step.reward == reward
    assert ours.observation_spec().keys() == theirs.observation_space.spaces.keys()


def test_physics_is_open_to_named_readings():
    env = bson.dm.load(**FEW, seed=2)
    env.reset()
    for _ in range(5):
        env.step([1.0, 0.2])
    data, world = env.physics.named.data, env.world
    np.testing.assert_allclose(data.xpos["robot/base", ["x", "y"]], world.pose[0, :2])
    np.testing.assert_allclose(data.xpos["person1", ["x", "y"]], world.people[0, 1, :2])
    gyro = data.sensordata["robot/imu_gyro"]
    np.testing.assert_allclose(gyro, world.readings["imu"][0, 3:], rtol=1e-5, atol=1e-6)
    assert abs(gyro[2]) > 0.01
    assert env.physics.time() == pytest.approx(0.5)


def test_the_goal_ends_with_no_discount_and_the_horizon_with_one():
    env = bson.dm.load(**{**FEW, "num_pedestrians": 0}, seed=3)
    env.reset()
    while True:
        x, y = env.world.goal[0] - env.world.pose[0, :2]
        turn = np.arctan2(y, x) - env.world.pose[0, 2]
        step = env.step([1.0, np.clip(np.arctan2(np.sin(turn), np.cos(turn)), -1, 1)])
        if step.last():
            break
    assert step.discount == 0.0 and env.world.arrived[0]
    assert env.step([0.0, 0.0]).first()
    env = bson.dm.load(**FEW, horizon=2, seed=3)
    env.reset()
    env.step([0.0, 0.0])
    step = env.step([0.0, 0.0])
    assert step.last() and step.discount == 1.0


def test_wrong_names_and_actions_are_told():
    with pytest.raises(ValueError, match="Unknown track 'locl'"):
        bson.dm.load("locl")
    with pytest.raises(ValueError, match="Unknown option 'people'"):
        bson.dm.load(people=3)
    env = bson.dm.load(**FEW)
    env.reset()
    with pytest.raises(ValueError, match="shape"):
        env.step([0.0])


@pytest.mark.skipif(gl_problem() is not None, reason="needs OpenGL")
def test_dm_controls_pixel_wrapper_sees_the_scene():
    from dm_control.suite.wrappers import pixels

    env = pixels.Wrapper(
        bson.dm.load(**FEW, seed=4), render_kwargs={"height": 48, "width": 64, "camera_id": "robot/front"}
    )
    first = env.reset().observation["pixels"]
    for _ in range(10):
        last = env.step([0.0, 1.0]).observation["pixels"]
    assert first.shape == (48, 64, 3) and first.dtype == np.uint8
    assert first.std() > 5 and (first != last).mean() > 0.1
