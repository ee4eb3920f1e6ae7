"""The benchmark as a dm_env environment on dm_control: `bson.dm.load("local", "lidar2d", seed=7)`."""

import os
import platform
import sys
from typing import Any

import dm_env
import mujoco
import numpy as np
from dm_env import specs

from bson.episodes.session import Session
from bson.episodes.tracks import LocalTrack, make_track
from bson.interfaces.gym import ACTION_SPACE, Rebuilt, checked_action, first, plain_seed
from bson.simulation.world import World
from bson.task import TaskConfig
from macid.drawing.gl import close_before_all_else


def _import_dm_control():
    """dm_control's Physics and MjModel, drawing by EGL where neither a display nor MUJOCO_GL says otherwise; where EGL
    is missing, without pictures. (It would try GLFW first, which needs a display.)"""

    def wanted():
        from dm_control.mujoco import Physics
        from dm_control.mujoco.wrapper.core import MjModel

        return Physics, MjModel

    if platform.system() != "Linux" or os.environ.get("DISPLAY") or os.environ.get("MUJOCO_GL"):
        return wanted()
    os.environ["MUJOCO_GL"] = "egl"
    try:
        return wanted()
    except Exception:  # an incomplete graphics library fails in many ways without EGL
        for name in [name for name in sys.modules if name.partition(".")[0] == "dm_control"]:
            del sys.modules[name]
        os.environ["MUJOCO_GL"] = "off"  # dm_control reads it when it is imported
        found = wanted()
        del os.environ["MUJOCO_GL"]
        return found


Physics, MjModel = _import_dm_control()
close_before_all_else()  # dm_control has an EGL context of its own, which it ends at exit


def load(track: str = "local", sensor: Any = "lidar2d", seed: int | None = None, **config: Any) -> "Environment":
    """The environment of a track and a sensor (as in `gymnasium.make`'s ids) and TaskConfig's fields `config`.

    seed: the first episode's; later episodes' seeds follow from it, as in `bson.interfaces.gym.BsonEnv`. Raises
    ValueError, naming the valid choices.
    """
    return Environment(TaskConfig().replace(**config), make_track(track, sensor), seed)


class Environment(Rebuilt, dm_env.Environment):
    """One world. Observations, actions and rewards are those of `bson.interfaces.gym.BsonEnv`, which has them as
    tables.

    The discount is 0 at the goal, and 1 at the horizon, where the episode is cut off.
    """

    def __init__(self, config: TaskConfig, track: LocalTrack, seed: int | None = None):
        self._arguments = {"config": config, "track": track, "seed": seed}
        seed = plain_seed(seed)
        self._session, self._track, self._seed = Session(config, track, seeds=[seed]), track, seed
        self._over = True
        self._make_physics()

    _not_copied = ("physics",)
    physics: Any  #: dm_control's Physics; None once closed

    def _make_physics(self):
        self.physics = Physics.from_model(MjModel(self.world.scene))
        # The engine has computed the sensors already; `physics` gets a copy of its readings.
        self.physics.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR

    def __deepcopy__(self, memo):
        made = super().__deepcopy__(memo)
        if self.physics is not None:
            made._make_physics()
            if self.world.begun([0]):
                made._mirror()
                np.copyto(made.physics.data.sensordata, self.physics.data.sensordata)
        return made

    def close(self) -> None:
        """Frees all resources; closing twice does no harm. After it the environment can't be stepped or reset."""
        if self.physics is not None:
            self.physics.free()
        self.physics = None
        self._session.close()

    @property
    def world(self) -> World:
        """The World (nworld = 1), for callers that need more than the observation."""
        return self._session.world

    def reset(self) -> dm_env.TimeStep:
        """Begins an episode."""
        (seed,) = self._session.next_seeds([0]) if self._seed is None else (self._seed,)
        self._seed, self._over = None, False
        observation = self._session.reset([0], [seed])
        self._mirror()
        return dm_env.restart(first(observation))

    def step(self, action: Any) -> dm_env.TimeStep:
        """One control step under `action` (2,) in [-1, 1]; after an episode's last step, the next episode's first."""
        if self._over:
            return self.reset()
        action = checked_action(action, (2,))
        self.action_spec().validate(action.astype(ACTION_SPACE.dtype))
        observation, reward, terminated, truncated = self._session.step([0], action[None])
        self._mirror()
        self._over = bool(terminated[0] or truncated[0])
        end = dm_env.termination if terminated[0] else dm_env.truncation if truncated[0] else dm_env.transition
        return end(float(reward[0]), first(observation))

    def observation_spec(self) -> Any:
        """A dict of BoundedArrays."""
        spaces = self._track.space(self._session.config).spaces
        return {name: _spec(space, name) for name, space in spaces.items()}

    def action_spec(self) -> Any:
        """(2,) in [-1, 1]: shares of top speed and top yaw rate."""
        return _spec(ACTION_SPACE, "action")

    def _mirror(self):
        """Puts the world's state into `physics`, for named readings and pictures."""
        engine, data = self.world.engine, self.physics.data
        for name in ("qpos", "qvel", "ctrl", "mocap_pos", "mocap_quat"):
            np.copyto(getattr(data, name), getattr(engine, name)[0])
        data.time = self.world.time[0]
        self.physics.forward()
        np.copyto(data.sensordata, engine.sensordata[0])


def _spec(space, name):
    return specs.BoundedArray(space.shape, space.dtype, space.low, space.high, name)
