"""What an agent is: made with the Setting that it is to drive in, it turns each observation into an action.

A plain function of the observation is an agent too; it is told nothing of the setting.
"""

import contextlib
import dataclasses
import inspect
import pathlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Protocol

import numpy as np

from bson.episodes.tracks import KEYS, MAP_RESOLUTION, TRACKS, LocalTrack, make_track
from bson.robot import RobotConfig, load_robot
from bson.sensors import Sensor
from bson.task import TaskConfig
from macid.files import UsageError
from macid.registry import Failed, raised
from macid.state import RADIUS

_OURS = (__file__, str(pathlib.Path(__file__).with_name("__init__.py")))


class AgentError(UsageError):
    """An agent can't be found, or broke the contract of agents."""


class AgentFailed(AgentError, Failed):
    """An agent's own code raised an error, the cause, or called exit()."""


class Unsuited(AgentError):
    """An agent refuses to drive in a Setting: raised where it is made, before the first step, with the reason, e.g.
    Unsuited("needs a Lidar3D."). The caller puts the agent's name before the reason."""


@dataclasses.dataclass(frozen=True)
class MapFrame:
    """The square map of the Global track, in the world frame, whose origin is the map's middle."""

    size: float  #: side [m]
    resolution: float = MAP_RESOLUTION  #: side of a cell [m]

    @property
    def origin(self) -> tuple[float, float]:
        """The outer corner (x, y) of the cell in row 0, column 0 [m]."""
        return -self.size / 2, -self.size / 2


@dataclasses.dataclass(frozen=True)
class Setting:
    """What an agent drives in."""

    control_period: float  #: from one observation and its action to the next observation [s]
    robot: RobotConfig  #: its limits, of which actions are shares [m/s], [rad/s]; its wheels and footprint [m]
    track: str  #: "local" or "global"
    sensors: tuple[Sensor, ...]  #: with their configurations: angles, ranges, places, noise, rates
    map: MapFrame
    horizon: int  #: control steps until an episode is cut off
    person_radius: float = RADIUS  #: of pedestrians [m]

    @classmethod
    def of(cls, config: TaskConfig, track: LocalTrack) -> "Setting":
        """The setting of a task's `config` on a `track` (see bson.episodes.tracks.make_track)."""
        names = [name for name, kind in TRACKS.items() if type(track) is kind]
        return cls(
            config.control_period,
            config.robot,
            names[0] if names else type(track).__name__,
            tuple(track.sensors),
            MapFrame(config.map_size),
            config.horizon,
            config.person_radius,
        )

    @classmethod
    def default(cls, track: str = "local", sensor: Any = "lidar2d") -> "Setting":
        """The paper's setting: the Jackal, a decision every 0.1 s. track, sensor: as make_track takes them."""
        return cls.of(TaskConfig(), make_track(track, sensor))

    @property
    def top(self) -> np.ndarray:
        """The command (2,) that an action of 1 stands for [m/s, rad/s]."""
        return np.array([self.robot.max_speed, self.robot.max_yaw_rate])

    @property
    def built_for(self) -> np.ndarray:
        """(2,): the robot's own top speed and yaw rate, which the task may have lowered or raised [m/s, rad/s]."""
        own = load_robot(self.robot.name).config
        return np.array([own.max_speed, own.max_yaw_rate])

    def steps(self, seconds: float) -> int:
        """The control steps that come nearest to `seconds` [s]; at least 1."""
        return max(1, round(seconds / self.control_period))

    def check_period(self, most: float) -> None:
        """Raises Unsuited where decisions are farther apart than `most` [s]."""
        if self.control_period > most + 1e-9:
            raise Unsuited(f"needs a control_period of at most {most:g} s, not {self.control_period:g} s.")


class Agent(Protocol):
    """Drives one world. It may also have `reset(seed)`, which is called as each episode begins, with its seed."""

    def __call__(self, observation: Mapping[str, np.ndarray], /) -> Any:
        """The action (2,) in [-1, 1], shares of top speed ahead and top yaw rate counter-clockwise, for one world's
        observation (see bson.interfaces.gym.BsonEnv): numbers, an array, or a torch tensor, which is brought to the
        CPU."""
        ...


class AgentFactory(Protocol):
    """Makes agents, one a world."""

    track: str  #: the track that its agents want
    sensor: Any  #: the sensors that its agents want, as make_track takes them

    def __call__(self, setting: Setting | None = None) -> Agent:
        """An agent for one world of `setting`; None: the default one, of its track and sensor.

        Raises AgentError, as its subclass Unsuited where the agent refuses to drive there."""
        ...


def takes_setting(kind: Callable) -> bool:
    """Whether `kind`, a class or a function that makes agents, is called with the Setting.

    `kind` is called with the Setting where it has an argument `setting`, or exactly one argument without a default; it
    is called without where it needs no argument. Raises TypeError where `kind` needs any other argument.
    """
    try:
        signature = inspect.signature(kind)
    except ValueError:  # a compiled class may have no signature
        return False
    named = signature.parameters.get("setting")
    if named and named.kind is not named.POSITIONAL_ONLY:
        signature.bind(setting=None)
        return True
    try:
        signature.bind()
    except TypeError:
        signature.bind(None)
        return True
    return False


def made_for(kind: Callable, setting: Setting) -> Agent:
    """The agent that `kind`, a class or a factory, makes for `setting`, if it takes one (see takes_setting)."""
    if not takes_setting(kind):
        return kind()
    named = inspect.signature(kind).parameters.get("setting")
    if named is None or named.kind is named.POSITIONAL_ONLY:
        return kind(setting)
    return kind(setting=setting)


def check_settings(factory: Callable, configs: Iterable[TaskConfig], track: LocalTrack) -> None:
    """Makes an agent for each setting among the tasks `configs`, so that an agent that refuses one does so before
    anything runs.

    Raises AgentError, as `factory` does.
    """
    if not getattr(factory, "takes_setting", True):
        return
    different = {(c.control_period, c.robot, c.map_size, c.horizon, c.person_radius): c for c in configs}
    for config in different.values():
        made_for(factory, Setting.of(config, track))


@contextlib.contextmanager
def its_code(name: str, doing: str) -> Iterator[None]:
    """Runs the own code of the agent `name`. An error there becomes AgentFailed, with one line: the error, its file and
    its line number. Unsuited stays Unsuited."""
    try:
        yield
    except Unsuited as error:
        raise Unsuited(f"Agent '{name}' {error}") from None
    except (Exception, SystemExit) as error:
        raise AgentFailed(f"Agent '{name}': {doing} {raised(error, _OURS)}.") from error


def reset_agent(agent: Agent, seed: int, name: str = "agent") -> None:
    """Calls the `reset` of `agent`, if it has one, as an episode of that seed begins. Raises AgentFailed."""
    with its_code(name, "its reset"):
        if (reset := getattr(agent, "reset", None)) is not None:
            reset(seed)


def act(agent: Agent, observation: Mapping[str, np.ndarray], name: str = "agent") -> np.ndarray:
    """The action (2,) float of `agent` for one world's observation, checked.

    Raises AgentError where the agent returns no valid action, or asks for a key that the observation doesn't have.
    Raises AgentFailed, from the cause, where the agent's code fails in any other way.
    """
    try:
        action = agent(observation)
    except AgentError:  # it says itself what is wrong
        raise
    except KeyError as error:
        if not any(key in KEYS and key not in observation for key in error.args if isinstance(key, str)):
            raise AgentFailed(f"Agent '{name}' {raised(error, _OURS)}.") from error
        raise AgentError(
            f"Agent '{name}' asks for observation[{error}], which its track and sensor don't give. There are: "
            f"{', '.join(observation)}. Choose others by --track and --sensor, or the agent's attributes track and "
            "sensor."
        ) from error
    except (Exception, SystemExit) as error:
        raise AgentFailed(f"Agent '{name}' {raised(error, _OURS)}.") from error
    try:
        array = _as_numbers(action)
    except (Exception, SystemExit) as error:  # an array of the user's own type may raise anything
        raise AgentError(
            f"Agent '{name}' returned {_kind(action)}, which NumPy can't read as numbers: {raised(error, _OURS)}; "
            f"{_ACTION}."
        ) from error
    if array.shape != (2,):
        raise AgentError(f"Agent '{name}' returned {_kind(action)} of shape {array.shape}; {_ACTION}.")
    if not np.isfinite(array).all():
        raise AgentError(f"Agent '{name}' returned {array.tolist()}; an action is two finite numbers in [-1, 1].")
    return array


_ACTION = "an action is two numbers in [-1, 1]: speed and yaw rate"


def _kind(value):
    kind = type(value)
    return kind.__name__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__name__}"


def _as_numbers(action):
    """`action` as an array of float. Raises any error that the conversion raises."""
    if isinstance(action, list | tuple):
        action = [_detached(one) for one in action]
    array = np.asarray(_detached(action))
    if array.dtype.kind not in "biufO":
        raise TypeError(f"it holds {array.dtype}, no real numbers")
    return array.astype(float)


def _detached(value):
    """A torch tensor without its gradient, on the CPU; anything else as it is."""
    if callable(getattr(value, "detach", None)) and callable(getattr(value, "cpu", None)):
        return value.detach().cpu()
    return value
