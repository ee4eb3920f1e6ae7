"""Gymnasium environments: one world, or many at once on one batch. Both are thin layers over `Session`."""

import copy
import dataclasses
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode

from bson.episodes.record import Recorder
from bson.episodes.session import Session
from bson.episodes.tracks import make_track, sensor_documents
from bson.simulation.world import World, check_worlds
from bson.task import TaskConfig
from macid.documents import shown

ACTION_SPACE = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
_METADATA = {"render_modes": ["rgb_array"], "render_fps": 10}
_VECTOR_METADATA = {**_METADATA, "render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}


def _check_render_mode(render_mode):
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"Unknown render_mode {render_mode!r}. Choose None or 'rgb_array'.")


def checked_action(action: Any, shape: tuple[int, ...]) -> np.ndarray:
    """`action` as floats of `shape`. Raises ValueError for anything but finite numbers of that shape."""
    try:
        action = np.asarray(action, dtype=float)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"An action must have shape {shape}, of numbers: {error}") from None
    if action.shape != shape:
        raise ValueError(f"An action must have shape {shape}, not {action.shape}.")
    if not np.isfinite(action).all():
        raise ValueError(f"An action must be finite, not {action.tolist()}.")
    return action


def check_seed(seed: Any) -> None:
    """Raises ValueError unless `seed` is an episode's seed or a list of such seeds."""
    seeds = [] if seed is None else np.ravel(np.array(seed, dtype=object))
    for one in seeds:
        if one is not None and not (isinstance(one, (int, np.integer)) and 0 <= one < 2**62):
            raise ValueError(f"A seed must be a whole number from 0 to 2**62 - 1, not {one!r}.")


def plain_seed(seed: Any) -> Any:
    """`seed` as a Python int where it is one of NumPy's. Raises ValueError as check_seed does."""
    check_seed(seed)
    return int(seed) if isinstance(seed, np.integer) else seed


def _episode_options(options):
    """A copy of a reset's options, which may be None. Raises ValueError for anything but a dict with names for keys."""
    if options is not None and not (isinstance(options, dict) and all(isinstance(name, str) for name in options)):
        raise ValueError(f"options must be a dict of TaskConfig's fields by name, not {shown(options)}.")
    return dict(options or {})


def _episode_config(config, track, options):
    """`config` with the options of a reset, which must leave the spaces of `track` as they are."""
    changed = config.replace(**options)
    if changed != config and track.space(changed) != track.space(config):
        alone = [
            name for name in options if track.space(config.replace(**{name: options[name]})) != track.space(config)
        ]
        raise ValueError(f"{' and '.join(alone)} shapes the observation space: give it to make, not to reset.")
    return changed


def frames_per_second(config: TaskConfig) -> float:
    """The frame rate [1/s] of a film of `config` in real time: one frame for each control step."""
    fps = 1.0 / config.control_period
    return round(fps) if abs(fps - round(fps)) < 1e-6 else fps


def _document(value):
    """`value`, an argument of `make`, in a form for JSON that `make` accepts in its place."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    if isinstance(value, dict):
        return {name: _document(each) for name, each in value.items()}
    if isinstance(value, (tuple, list)):
        return [_document(each) for each in value]
    return value.item() if isinstance(value, np.generic) else value


def _rebuilt(kind, arguments):
    return kind(**arguments)


class Rebuilt:
    """An environment that pickle makes anew from its `_arguments`. copy.deepcopy copies its present state, and the copy
    plays on equally, but without the attributes `_not_copied`, such as renderers."""

    _arguments: dict[str, Any]
    _not_copied: tuple[str, ...] = ()

    def __reduce__(self):
        return _rebuilt, (type(self), self._arguments), {"_spec": getattr(self, "_spec", None)}

    def __deepcopy__(self, memo):
        made = memo[id(self)] = object.__new__(type(self))
        for name, value in vars(self).items():
            setattr(made, name, None if name in self._not_copied else copy.deepcopy(value, memo))
        return made


class Specified(Rebuilt):
    """Gymnasium's spec of an environment, with arguments that JSON can have."""

    _spec: EnvSpec | None = None

    def _told_spec(self):
        """The EnvSpec by which the environment was made, or None."""
        return self._spec

    def _note_spec(self, spec):
        if spec is not None:
            kwargs = {name: _document(value) for name, value in spec.kwargs.items() if name != "sensor"}
            if "sensor" in spec.kwargs:
                kwargs["sensor"] = sensor_documents(spec.kwargs["sensor"])
            spec = copy.copy(spec)
            spec.kwargs = kwargs
        self._spec = spec

    spec: Any = property(_told_spec, _note_spec)  # Gymnasium has a plain attribute here


class BsonEnv(Specified, gymnasium.Env):
    """A robot, the Jackal if `robot` names no other, drives to a goal among pedestrians (paper, sec. VI).

    ## Action
    `Box(-1, 1, (2,), float32)`; zero stands still.

    | | what | at +1 | of the Jackal |
    |---|---|---|---|
    | 0 | speed ahead; negative drives back | the robot's max_speed | 2.0 m/s |
    | 1 | yaw rate, counter-clockwise | the robot's max_yaw_rate | 2.0 rad/s |

    ## Observation
    A dict of arrays, float32 where nothing else is said. The robot frame has x ahead, y to the left.

    | key | shape | what | frame, unit |
    |---|---|---|---|
    | goal | (2,) | position of the goal | robot, m |
    | velocity | (2,) | speed ahead, yaw rate | robot, m/s and rad/s |
    | imu | (6,) | specific force x, y, z; angular velocity x, y, z | robot, m/s2 and rad/s |
    | lidar | (720,) | (Lidar2D) distances, -135 degrees (right) to +135 (left); 30 m: nothing is hit | robot, m |
    | lidar3d | (16, 360) | (Lidar3D) rows -15 to +15 degrees, columns: behind over right; 100 m: no hit | robot, m |
    | rgb | (120, 160, 3) | (Camera) uint8, the view ahead | - |
    | depth | (120, 160) | (Camera) distance along the camera's axis, 0.3 to 10 m | camera, m |

    On the Global track also, in the world frame (the origin is the map's centre):

    | key | shape | what | unit |
    |---|---|---|---|
    | map | (cells, cells) | uint8: 1 where something solid reaches the cell's centre; row 0 is the lowest | - |
    | map_origin | (2,) | outer corner of the cell in row 0, column 0 | m |
    | map_resolution | (1,) | side of a cell | m |
    | pose | (3,) | the robot's x, y, yaw | m, m, rad |
    | people | (K, 2) | every pedestrian's position | m |

    ## Reward
    Eq. 5: 1.0 per metre that the goal came closer, +2.0 at the goal, -1.0 in a control step with any contact.

    ## Episode
    It terminates at the goal (within 0.5 m) and is truncated after `horizon` control steps, or where physics fails.

    ## Info
    The quantities that the metrics need. Where physics fails, the observation is the last good one.

    | key | shape | what | frame, unit |
    |---|---|---|---|
    | seed | - | seed of the episode | - |
    | time | - | since the reset | s |
    | pose | (3,) | the robot's x, y, yaw | world, m, m, rad |
    | goal | (2,) | position of the robot's goal | world, m |
    | start_distance | - | d_i: from the start to the goal, as the crow flies | m |
    | distance | - | d_f: from here to the goal, as the crow flies | m |
    | travelled | - | way driven | m |
    | collisions | - | steps in which the robot touched anything | steps of 0.02 s |
    | collisions_person | - | steps in which it touched a person | steps of 0.02 s |
    | collisions_robot_on_person | - | of those: it moved towards the person at more than 0.05 m/s | steps of 0.02 s |
    | collisions_obstacle | - | steps in which it touched an obstacle | steps of 0.02 s |
    | collisions_wall | - | steps in which it touched an outer wall | steps of 0.02 s |
    | nearest_person | - | to the nearest person, surface to surface; infinity without any | m |
    | arrived | - | whether the robot is at its goal | - |
    | fault | - | empty, or what of the physics became infinite or not a number; such a world stays as it was | - |

    ## Arguments
    The fields of `bson.task.TaskConfig` (num_pedestrians or pedestrian_density, obstacle_density, pedestrian_model,
    lcf, control_period, horizon, ...) and `seed`, of the first episode when `reset` is given none. `reset(options=...)`
    takes the same fields; they hold until the next reset. `reset(seed=s)` plays episode s: the same in a vector
    environment, in any process, bit for bit.

    ## Versions
    - v0: first version.
    """

    metadata = _METADATA
    _not_copied = ("_film",)

    def __init__(
        self,
        track: str = "local",
        sensor: Any = "lidar2d",
        render_mode: str | None = None,
        seed: int | None = None,
        **config: Any,
    ):
        _check_render_mode(render_mode)
        self._arguments = {"track": track, "sensor": sensor, "render_mode": render_mode, "seed": seed, **config}
        seed = plain_seed(seed)
        self.render_mode = render_mode
        self.config = TaskConfig().replace(**config)
        self.metadata = {**self.metadata, "render_fps": frames_per_second(self.config)}
        self._track = make_track(track, sensor)
        self._session = Session(self.config, self._track, seeds=[seed])
        self._first_seed = seed
        self._film = None
        self._recorder: Recorder | None = None
        self.observation_space = self._track.space(self.config)
        self.action_space = ACTION_SPACE

    @property
    def world(self) -> World:
        """The World (nworld = 1), for callers that need more than the observation."""
        return self._session.world

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begins an episode; see the class."""
        seed = plain_seed(seed)
        super().reset(seed=seed)
        config = _episode_config(self.config, self._track, _episode_options(options))
        with self._session.setting(config):
            seed = self._first_seed if seed is None else seed
            if seed is not None:
                self._session.reseed([0], [seed])
            else:
                (seed,) = self._session.next_seeds([0])
            observation = self._session.reset([0], [seed])
        self._first_seed = None
        self.metadata = {**self.metadata, "render_fps": frames_per_second(config)}
        if self.render_mode is not None:
            self._close_film()
            self._recorder = Recorder(self._session, 0)
        return first(observation), self._info()

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """One control step; see the class."""
        action = checked_action(action, (2,))
        observation, reward, terminated, truncated = self._session.step([0], action[None])
        if self.render_mode is not None:
            assert self._recorder is not None  # made by the reset
            self._recorder.snap()
        return first(observation), float(reward[0]), bool(terminated[0]), bool(truncated[0]), self._info()

    def render(self) -> np.ndarray | None:
        """The present state as an RGB image (height, width, 3) uint8: chase view, map, and the view of the robot's
        camera."""
        if self.render_mode is None or self._recorder is None:
            return None
        from bson.episodes.film import Film

        if self._film is None:
            self._film = Film(self.world.scene)
        return self._film.frame(self._recorder.episode(), -1)

    def close(self) -> None:
        """Frees all resources; closing twice does no harm. After it the environment can't be stepped or reset."""
        self._close_film()
        self._recorder = None
        self._session.close()

    def _close_film(self):
        if self._film is not None:
            self._film.close()
        self._film = None

    def _info(self):
        return {name: value[0] for name, value in self._session.info([0]).items()}


class BsonVectorEnv(Specified, gymnasium.vector.VectorEnv):
    """`num_envs` worlds of `BsonEnv` on one MuJoCo batch, threaded by MuJoCo itself; no subprocesses.

    Spaces, arguments and infos are BsonEnv's with a leading axis. `reset(seed=s)` plays episodes s, s + 1, ...; a list
    gives one seed for each world. Options of `reset` hold for all episodes until the next call of `reset`.
    autoreset_mode: as Gymnasium defines them: "NextStep" (default), "SameStep" or "Disabled". With engine="warp"
    `gymnasium.make_vec` gives bson.interfaces.vector.WarpVectorEnv instead, on a GPU if there is one. For
    stable-baselines3, wrap it: `bson.learning.vec_env.WorldsVecEnv(env)`.
    """

    metadata = _VECTOR_METADATA

    def __init__(
        self,
        num_envs: int = 1,
        track: str = "local",
        sensor: Any = "lidar2d",
        render_mode: str | None = None,
        seed: Any = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        nthread: int = 0,
        **config: Any,
    ):
        if render_mode is not None:
            raise ValueError("A vector environment draws no pictures: use render_mode=None, or a single environment.")
        check_worlds("num_envs", num_envs)
        self._arguments = {"num_envs": num_envs, "track": track, "sensor": sensor, "seed": seed, "nthread": nthread}
        self._arguments |= {"autoreset_mode": autoreset_mode, **config}
        seed = plain_seed(seed)
        self.num_envs, self.render_mode = num_envs, None
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.config = TaskConfig().replace(**config)
        fps = frames_per_second(self.config)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode, "render_fps": fps}
        made = make_track(track, sensor)
        self._first_seed = seed
        self._session = Session(self.config, made, num_envs, self._seeds(seed), nthread)
        self._all = np.arange(num_envs)
        self._ended = np.zeros(num_envs, bool)
        self.single_observation_space, self.single_action_space = made.space(self.config), ACTION_SPACE
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)

    @property
    def world(self) -> World:
        """The World, for callers that need more than the observation."""
        return self._session.world

    def _seeds(self, seed):
        if seed is None:
            return [None] * self.num_envs
        seeds = [seed + index for index in range(self.num_envs)] if np.ndim(seed) == 0 else list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"reset needs a seed, or {self.num_envs} of them, not {len(seeds)}.")
        return seeds

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begins an episode in every world, or in those of `options["reset_mask"]` (num_envs,) bool."""
        options = _episode_options(options)
        mask = options.pop("reset_mask", None)
        seed = plain_seed(seed)
        config, ids = self._session.config, self._all
        if mask is None:
            config = _episode_config(self.config, self._session.track, options)
        else:
            if options:
                raise ValueError("Options other than reset_mask are for a reset of all worlds.")
            mask = np.asarray(mask)
            if mask.shape != (self.num_envs,) or mask.dtype != bool:
                raise ValueError(f"reset_mask must be {self.num_envs} booleans, not {mask!r}.")
            ids = np.flatnonzero(mask)
            if not self.world.begun(np.flatnonzero(~mask)):
                raise gymnasium.error.ResetNeeded("Reset all worlds before some of them.")
        if seed is None and self._first_seed is not None:
            seed = self._first_seed
        given = self._seeds(seed)
        with self._session.setting(config):
            for index in ids:
                if given[index] is not None:
                    self._session.reseed([int(index)], [given[index]])
            seeds = [given[i] if given[i] is not None else self._session.next_seeds([int(i)])[0] for i in ids]
            self._session.reset(ids, seeds)
        self._first_seed = None
        self._ended[ids] = False
        self.metadata = {**self.metadata, "render_fps": frames_per_second(config)}
        return self._session.observe(self._all), self._infos(self._all)

    def step(self, actions: Any) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control step of every world. In the mode NextStep, a world whose episode ended begins its next
        instead."""
        actions = checked_action(actions, (self.num_envs, 2))
        reward = np.zeros(self.num_envs)
        terminated, truncated = np.zeros(self.num_envs, bool), np.zeros(self.num_envs, bool)
        if self.autoreset_mode is AutoresetMode.DISABLED and self._ended.any():
            raise ValueError("Reset the worlds whose episodes ended (options={'reset_mask': ...}) before stepping.")
        going, ended = np.flatnonzero(~self._ended), np.flatnonzero(self._ended)
        extra = {}
        with self._session.whole():
            if len(going):
                _, reward[going], terminated[going], truncated[going] = self._session.step(going, actions[going])
            if len(ended):
                self._session.reset(ended, self._session.next_seeds(ended))
            done = terminated | truncated
            if self.autoreset_mode is AutoresetMode.SAME_STEP and done.any():
                extra = self._final(np.flatnonzero(done))
                self._session.reset(np.flatnonzero(done), self._session.next_seeds(np.flatnonzero(done)))
                self._ended[:] = False
            else:
                self._ended = done
        return self._session.observe(self._all), reward, terminated, truncated, {**self._infos(self._all), **extra}

    def close_extras(self, **kwargs: Any) -> None:
        """Frees all resources. After it the environment can't be stepped or reset."""
        self._session.close()

    def _infos(self, ids):
        present = np.zeros(self.num_envs, bool)
        present[ids] = True
        info = self._session.info(ids)
        return {**info, **{f"_{name}": present.copy() for name in info}}

    def _final(self, ids):
        """Gymnasium's `final_obs` and `final_info` of the worlds `ids`, before they are reset."""
        observation, info = self._session.observe(self._all), self._session.info(self._all)
        present = np.zeros(self.num_envs, bool)
        present[ids] = True
        final = np.empty(self.num_envs, object)
        for index in ids:
            final[index] = {name: value[index] for name, value in observation.items()}
        masked = {f"_{name}": present.copy() for name in info}
        return {
            "final_obs": final,
            "_final_obs": present,
            "final_info": {**info, **masked},
            "_final_info": present.copy(),
        }


def first(observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The first world's observation, from the observations of a batch."""
    return {name: value[0] for name, value in observation.items()}
