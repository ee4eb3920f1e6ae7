"""The benchmark as a dm_env environment on dm_control: `bson.dm.load("local", "lidar2d", seed=7)`."""

import os
import platform

if platform.system() == "Linux" and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")  # dm_control would try GLFW first, which needs a display

import dm_env
import mujoco
import numpy as np
from dm_control.mujoco import Physics
from dm_control.mujoco.wrapper.core import MjModel
from dm_env import specs

from bson.env import ACTION_SPACE, check_seed, first
from bson.session import Session
from bson.task import TaskConfig
from bson.tracks import make_track
from macid.drawing import close_before_all_else

close_before_all_else()  # dm_control has an EGL of its own, which it ends at exit


def load(track="local", sensor="lidar2d", seed=None, **config):
    """The environment of a track and a sensor (as in `gymnasium.make`'s ids) and TaskConfig's fields `config`.

    seed: of the first episode; later episodes' seeds come from it, as in `bson.env.BsonEnv`. Raises ValueError, naming
    the valid choices.
    """
    return Environment(TaskConfig().replace(**config), make_track(track, sensor), seed)


class Environment(dm_env.Environment):
    """One world. Observations, actions and rewards are those of `bson.env.BsonEnv`, which has them as tables.

    The discount is 0 at the goal, and 1 at the horizon, where the episode is cut off.
    """

    def __init__(self, config: TaskConfig, track, seed=None):
        check_seed(seed)
        self._session, self._track, self._seed = Session(config, track, seeds=[seed]), track, seed
        self._over = True
        world = self._session.world
        self.physics = Physics.from_model(MjModel(world.scene))
        # The batch has computed the sensors already; its readings are copied.
        self.physics.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR

    @property
    def world(self):
        """The World (nworld = 1), for whoever needs more than the observation."""
        return self._session.world

    def reset(self):
        """Begins an episode."""
        (seed,) = self._session.next_seeds([0]) if self._seed is None else (self._seed,)
        self._seed, self._over = None, False
        observation = self._session.reset([0], [seed])
        self._mirror()
        return dm_env.restart(first(observation))

    def step(self, action):
        """One control step under `action` (2,) in [-1, 1]; after an episode's last step, the next episode's first."""
        if self._over:
            return self.reset()
        action = np.asarray(action, dtype=float)
        self.action_spec().validate(action.astype(ACTION_SPACE.dtype))
        observation, reward, terminated, truncated = self._session.step([0], action[None])
        self._mirror()
        self._over = bool(terminated[0] or truncated[0])
        end = dm_env.termination if terminated[0] else dm_env.truncation if truncated[0] else dm_env.transition
        return end(float(reward[0]), first(observation))

    def observation_spec(self):
        """A dict of BoundedArrays."""
        spaces = self._track.space(self._session.config).spaces
        return {name: _spec(space, name) for name, space in spaces.items()}

    def action_spec(self):
        """(2,) in [-1, 1]: shares of top speed and top yaw rate."""
        return _spec(ACTION_SPACE, "action")

    def _mirror(self):
        """Puts the world's state into `physics`, for named readings and pictures."""
        batch, data = self.world.batch, self.physics.data
        for name in ("qpos", "qvel", "ctrl", "mocap_pos", "mocap_quat"):
            np.copyto(getattr(data, name), batch.bind(name)[0])
        data.time = self.world.time[0]
        self.physics.forward()
        np.copyto(data.sensordata, batch.bind("sensordata")[0])


def _spec(space, name):
    return specs.BoundedArray(space.shape, space.dtype, space.low, space.high, name)
