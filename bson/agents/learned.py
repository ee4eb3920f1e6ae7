"""Agents that were trained, run by NumPy alone: an MLP on `bson.features`; guided ones, a network on `bson.guided`; and
recurrent ones (bson.recurrent), on scans or depth pictures.

macid.policy.write_network writes such an agent: NAME.npz (weights, no pickle) and NAME.json (how it was made, how it
scores, "output": "clip" or "tanh", and "setting": the setting in which it was trained). The shipped agents lie in
assets/agents.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from bson import guided, recurrent
from bson.agents.contract import Setting, Unsuited
from bson.agents.guide import MapSight, ScanSight
from bson.episodes.tracks import make_track
from bson.features import FEATURES, SECTORS, TOP, Features, motion
from bson.sensors import DepthCamera, Lidar2D
from bson.task import TaskConfig
from macid import assets
from macid.documents import convert, read_document, shown
from macid.files import UsageError
from macid.networks import ENCODER, relu_mlp, write_networks
from macid.policy import MOST_RECIPE_BYTES, read_networks

ACTIONS = 2
_OUTPUTS = {"clip": lambda x: np.clip(x, -1.0, 1.0), "tanh": np.tanh}
_TOP = ("max_speed", "max_yaw_rate")
_UNITS = {"control_period": " s", "max_speed": " m/s", "max_yaw_rate": " rad/s", "field": " rad", "range_max": " m"}


class FeatureSight:
    """Sees bson.features: call `reset` as an episode begins, then `see`. top: the robot's top speed and yaw rate."""

    def __init__(self, top: Sequence[float]):
        self._features, self._begun = Features(1, top), False

    def reset(self) -> None:
        """Begins an episode."""
        self._begun = False

    def see(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The features (FEATURES,) of one world's observation."""
        batched = {name: np.asarray(observation[name])[None] for name in ("goal", "velocity", "lidar")}
        look = self._features.step if self._begun else self._features.begin
        self._begun = True
        return look([0], batched)[0]


class Learned:
    """An agent for one world on the Local track with the 2D LIDAR; stateful, since it remembers its last scans.

    layers: [(weight (in, out), bias (out,)), ...] with ReLU between; output: "clip" or "tanh", the function that turns
    the last layer's output into an action; top: the top speed and yaw rate of the robot that it was trained on, see
    bson.features.motion.
    """

    track, sensor = "local", "lidar2d"

    def __init__(self, layers: Sequence[tuple[np.ndarray, np.ndarray]], output: str, top: Sequence[float] = TOP):
        self.layers, self.output, self.top = layers, output, top
        self._output = _OUTPUTS[output]
        self.eyes = FeatureSight(top)

    @classmethod
    def of_layers(cls, layers: Any, output: str, setting: Setting) -> "Learned":
        """The agent for a robot that is trained in `setting`."""
        return cls(layers, output, tuple(setting.top.tolist()))

    def reset(self, seed: int | None) -> None:
        """Begins an episode."""
        self.eyes.reset()

    def __call__(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The action (2,) in [-1, 1] for one world's observation."""
        return self.act(self.eyes.see(observation)[None])[0]

    def act(self, x: np.ndarray) -> np.ndarray:
        """Actions (N, 2) for features (N, FEATURES)."""
        with np.errstate(over="ignore", invalid="ignore"):  # `contract.act` refuses an action that is not finite
            return self._output(relu_mlp(self.layers, x))


class Guided:
    """An agent for one world: what it sees is `bson.guided`, with the map and people's places (the Global track).
    layers: those of the people's encoder first, then the head's, as `bson.learning.algorithms.export` gives them."""

    sight, track, sensor = MapSight, MapSight.track, "lidar2d"

    def __init__(self, layers: Sequence[tuple[np.ndarray, np.ndarray]], output: str, setting: Setting):
        self.layers, self._output = tuple(layers), _OUTPUTS[output]
        self.eyes = self.sight(setting)

    @classmethod
    def of_layers(cls, layers: Any, output: str, setting: Setting) -> "Guided":
        """The agent for a robot that is trained in `setting`."""
        return cls(layers, output, setting)

    def reset(self, seed: int | None) -> None:
        """Begins an episode."""
        self.eyes.reset()

    def __call__(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The action (2,) in [-1, 1] for one world's observation."""
        return self.act(self.eyes.see(observation)[None])[0]

    def act(self, x: np.ndarray) -> np.ndarray:
        """Actions (N, 2) for vectors (N, bson.guided.SIZE)."""
        person, head = self.layers[: guided.ENCODER_LAYERS], self.layers[guided.ENCODER_LAYERS :]
        with np.errstate(over="ignore", invalid="ignore"):  # `contract.act` refuses an action that is not finite
            return self._output(relu_mlp(head, guided.attended(person, x)))


class ScanGuided(Guided):
    """The same by the LIDAR alone (the Local track)."""

    sight, track = ScanSight, ScanSight.track


class CameraSight:
    """Sees by the depth camera: call `reset` as an episode begins, then `see`."""

    track = "local"

    def __init__(self, setting: Setting):
        self._top = setting.top

    def reset(self) -> None:
        """Nothing is remembered here."""

    def see(self, observation: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """The motion (recurrent.MOTION,) and the depth picture (*recurrent.PICTURE,) of one world's observation."""
        return motion(observation, self._top), recurrent.picture(observation["depth"])


class Pupil:
    """A recurrent agent for one world, which learns by imitation (bson.learning.dagger), PPO
    (bson.learning.recurrent_ppo), or SAC and TAC (bson.learning.recurrent_sac): what it sees is `bson.guided` by the
    LIDAR alone.

    layers: those of bson.recurrent's parts, EYE, MEMORY and HEAD, one after the other.
    """

    sight: Any = ScanSight
    track, sensor = "local", "lidar2d"
    eye = "people"  #: of its network, one of recurrent.EYES
    pictures = False  #: whether it sees depth pictures, and not scans

    def __init__(self, layers: Sequence[tuple[np.ndarray, np.ndarray]], output: str, setting: Setting):
        self.network, self._output = _parts(layers, self.eye), _OUTPUTS[output]
        self.eyes = self.sight(setting)
        self.reset(None)

    @classmethod
    def of_layers(cls, layers: Any, output: str, setting: Setting) -> "Pupil":
        """The agent for a robot that is trained in `setting`."""
        return cls(layers, output, setting)

    @classmethod
    def look(cls, sight: Any, observation: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray | None]:
        """What bson.recurrent.step takes of one world, without its leading axis: vector and picture."""
        return sight.see(observation) if cls.pictures else (sight.see(observation), None)

    def reset(self, seed: int | None) -> None:
        """Begins an episode, with nothing remembered."""
        self.eyes.reset()
        self._state = np.zeros((1, recurrent.UNITS), np.float32)

    def __call__(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """The action (2,) in [-1, 1] for one world's observation."""
        vector, picture = self.look(self.eyes, observation)
        seen = None if picture is None else picture[None]
        with np.errstate(over="ignore", invalid="ignore"):  # `contract.act` refuses an action that is not finite
            action, self._state = recurrent.step(self.network, vector[None], seen, self._state)
            return self._output(action)[0]


class MapPupil(Pupil):
    """The same with the map and people's places (the Global track)."""

    sight, track = MapSight, MapSight.track


class CameraPupil(Pupil):
    """The same with a depth camera in place of the LIDAR and of a map."""

    sight, sensor, eye, pictures = CameraSight, "camera", "picture", True


class ScanPupil(Pupil):
    """The same on bson.features, without a map of its own and people to be told of: it can learn on a device."""

    eye = "none"

    @staticmethod
    def sight(setting: Setting) -> FeatureSight:
        """What sees for a robot in `setting`."""
        return FeatureSight(tuple(setting.top.tolist()))


def _parts(layers: Sequence[tuple[np.ndarray, np.ndarray]], eye: str) -> dict[str, Any]:
    """`layers` of a recurrent policy as bson.recurrent takes them: {part: its layers}."""
    rest, found = list(layers), {}
    for name, shapes in recurrent.shapes(eye).items():
        found[name], rest = rest[: len(shapes)], rest[len(shapes) :]
    return found


# What a robot sees, as a recipe's "inputs" has it, and the agent that sees it.
KINDS: dict[str, Any] = {
    "scans": Learned,
    "guided": Guided,
    "guided-scans": ScanGuided,
    "gru": Pupil,
    "gru-map": MapPupil,
    "camera": CameraPupil,
    "gru-scans": ScanPupil,
}


def _kind(recipe):
    """The agent that a recipe is of. Raises UsageError."""
    inputs = recipe.get("inputs", "scans")
    if not isinstance(inputs, str) or inputs not in KINDS:
        raise UsageError(f'A robot\'s policy has "inputs" of {", ".join(KINDS)}, not {shown(inputs)}.')
    return KINDS[inputs]


def _shapes(kind) -> dict[str, list[tuple[int, int]]] | None:
    """The shapes of the weights in the parts of a policy's file, in the order of the agent's layers; None for an MLP of
    any layers. The last part, the head of a guided policy, may have any layers too: its shapes here are the first's
    inputs and the last's outputs."""
    if issubclass(kind, Pupil):
        return recurrent.shapes(kind.eye)
    return {ENCODER: _ENCODER} if issubclass(kind, Guided) else None


def write(path: Any, layers: Sequence[tuple[np.ndarray, np.ndarray]], recipe: dict[str, Any]) -> None:
    """Writes `path`.npz and `path`.json of a robot's policy, with the layers that the agent of the recipe's "inputs"
    takes."""
    rest, parts = list(layers), {}
    for prefix, shapes in (_shapes(_kind(recipe)) or {}).items():
        parts[prefix], rest = rest[: len(shapes)], rest[len(shapes) :]
    write_networks(path, parts if "" in parts else {"": rest, **parts}, recipe)


def names() -> list[str]:
    """Names of the shipped agents."""
    return assets.names("agents", ".npz")


class _Trained(msgspec.Struct):
    """The setting in which a policy was trained, as its recipe has it; fields that the recipe lacks are not
    compared."""

    control_period: float
    robot: dict[str, str | float]
    lidar: dict[str, Any] | None = None
    depth: dict[str, Any] | None = None


def setting_document(setting: Setting, pictures: bool = False) -> dict:
    """The "setting" in which a policy was trained, as its recipe notes it in JSON. pictures: whether it sees those of a
    DepthCamera "depth", and not a Lidar2D "lidar".

    Raises Unsuited where there is no such sensor."""
    return {
        "control_period": setting.control_period,
        "robot": dataclasses.asdict(setting.robot),
        **(
            {"depth": dataclasses.asdict(_depth(setting))}
            if pictures
            else {"lidar": dataclasses.asdict(_lidar(setting))}
        ),
    }


def _depth(setting):
    rows, columns = recurrent.PICTURE
    for sensor in setting.sensors:
        if sensor.key == "depth" and isinstance(sensor, DepthCamera):
            if sensor.height % rows or sensor.width % columns:
                raise Unsuited(
                    f"needs depth pictures of multiples of {columns} x {rows}, not {sensor.width} x {sensor.height}."
                )
            return sensor
    has = ", ".join(type(sensor).__name__ for sensor in setting.sensors) or "none"
    raise Unsuited(f'needs a DepthCamera with the key "depth"; the sensors are: {has}. Choose --sensor camera.')


def _lidar(setting):
    for sensor in setting.sensors:
        if sensor.key == "lidar" and isinstance(sensor, Lidar2D):
            if sensor.beams % SECTORS:
                raise Unsuited(f"needs a LIDAR whose beams are a multiple of {SECTORS}, not {sensor.beams}.")
            return sensor
    has = ", ".join(type(sensor).__name__ for sensor in setting.sensors) or "none"
    raise Unsuited(f'needs a Lidar2D with the key "lidar"; the sensors are: {has}. Choose --sensor lidar2d.')


def _trained(recipe, path):
    """The _Trained of a recipe. A recipe without a "setting" has the fields of TaskConfig that differed, as "task"; its
    policy was trained with the default sensors. Raises UsageError."""
    called = f"the policy's recipe '{path.with_suffix('.json')}'"
    if "setting" in recipe:
        trained = convert(recipe["setting"], _Trained, f"{called}, key 'setting'")
        for key in _TOP:
            value = trained.robot.get(key)
            if not (isinstance(value, float) and value > 0):
                raise UsageError(f"{called}, key 'setting': its robot has no {key} above 0.")
        return trained
    task = recipe.get("task") or {}
    try:
        config = TaskConfig(**{key: task[key] for key in ("control_period", "robot") if key in task})
    except (ValueError, TypeError) as error:
        raise UsageError(f"{called}, key 'task', does not tell in what it was trained: {error}") from None
    setting = Setting.of(config, make_track(Learned.track, Learned.sensor))
    return convert(setting_document(setting), _Trained, called)


def _compared(trained, setting):
    """Every difference between the setting of training and the given one: (texts of the first, texts of the second)."""
    found = [("", {"control_period": trained.control_period}, {"control_period": setting.control_period})]
    ours, theirs = dict(trained.robot), dataclasses.asdict(setting.robot)
    names = [pathlib.Path(str(robot.pop("name"))).stem for robot in (ours, theirs)]
    if names[0] != names[1]:
        found.append(("", {"robot": names[0]}, {"robot": names[1]}))
    else:
        found.append((f"robot {names[0]}'s ", ours, theirs))
    if trained.depth is not None:
        found.append(("depth camera's ", trained.depth, dataclasses.asdict(_depth(setting))))
    if trained.lidar is not None:
        found.append(("LIDAR's ", trained.lidar, dataclasses.asdict(_lidar(setting))))
    pairs = [
        [f"{prefix}{key} {_shown(each[key])}{_UNITS.get(key, '')}" for each in (before, now)]
        for prefix, before, now in found
        for key in before
        if key in now and _plain(before[key]) != _plain(now[key])
    ]
    return [before for before, _ in pairs], [now for _, now in pairs]


def _plain(value):
    return list(value) if isinstance(value, tuple) else value


def _shown(value):
    return f"{value:.6g}" if isinstance(value, float) else str(value)


class Factory:
    """The AgentFactory of the policy `name` with `layers` and `recipe`, read from the file `path`."""

    takes_setting = True

    def __init__(
        self,
        name: str,
        path: pathlib.Path,
        layers: Sequence[tuple[np.ndarray, np.ndarray]],
        recipe: dict[str, Any],
        untrained: bool,
    ):
        self._name, self.untrained, self._layers, self.output = name, untrained, layers, recipe["output"]
        self.kind = _kind(recipe)  #: the class of its agents
        self.track, self.sensor = self.kind.track, self.kind.sensor
        self._trained = functools.cache(lambda: _trained(recipe, path))
        robot = self._trained().robot if "setting" in recipe else dict(zip(_TOP, TOP, strict=True))
        self._top: tuple[Any, ...] = tuple(robot[key] for key in _TOP)

    def __call__(self, setting: Setting | None = None) -> Any:
        """An agent for one world of `setting`. Raises Unsuited."""
        try:
            return self.made(setting)
        except Unsuited as error:
            raise Unsuited(f"Agent '{self._name}' {error}") from None

    def made(self, setting: Setting | None) -> Any:
        """The same; Unsuited is raised with the reason alone, without the agent's name."""
        if setting is not None:
            self._check(setting)
        if self.kind is Learned:
            return Learned(self._layers, self.output, self._top)
        return self.kind(self._layers, self.output, setting or Setting.default(self.track, self.sensor))

    def _check(self, setting):
        """Raises Unsuited where `setting` differs from the setting of training, or, with `untrained`, where the policy
        can't even try."""
        _depth(setting) if getattr(self.kind, "pictures", False) else _lidar(setting)
        if self.untrained:
            return
        before, now = _compared(self._trained(), setting)
        if before:
            raise Unsuited(
                f"was trained with {', '.join(before)}, not with {', '.join(now)}; "
                "--untrained-setting (in Python: load_agent(name, untrained=True)) lets it try."
            )


def load(name: str, untrained: bool = False) -> Factory:
    """A factory of the agent `name`: a shipped one, or a .npz file. Raises UsageError (a ValueError) for any other
    name.

    The factory raises Unsuited for a Setting with another robot, control period or LIDAR than it was trained with,
    unless `untrained`.
    """
    path = pathlib.Path(name) if name.endswith(".npz") else assets.path("agents", f"{name}.npz")
    kind = _kind(read_document(path.with_suffix(".json"), dict, "policy's recipe", MOST_RECIPE_BYTES))
    shapes = _shapes(kind) or {}
    parts, recipe = read_networks(path, ("", *(prefix for prefix in shapes if prefix)))
    output = recipe.get("output")
    if not isinstance(output, str) or output not in _OUTPUTS:
        raise UsageError(
            f"'{path}' is no robot's policy, as bson train makes them: its json has no \"output\" of "
            f"{', '.join(_OUTPUTS)}."
        )
    for prefix, wanted in shapes.items():
        found = [weight.shape for weight, _ in parts[prefix]]
        if found != wanted:
            raise UsageError(
                f"'{path}' is no robot's policy: its part '{prefix}' has weights of {found}, not {wanted}."
            )
    head = parts[""]
    if "" not in shapes:
        takes = guided.ATTENDED if shapes else FEATURES
        for given, wanted, does in ((head[0][0].shape[0], takes, "takes"), (head[-1][0].shape[1], ACTIONS, "gives")):
            if given != wanted:
                raise UsageError(f"'{path}' is no robot's policy: it {does} {given} numbers, not {wanted}.")
    layers = [layer for prefix in shapes if prefix for layer in parts[prefix]]
    return Factory(name, path, (*layers, *head), recipe, untrained)


_ENCODER = [(guided.OWN + guided.PERSON, guided.HIDDEN), (guided.HIDDEN, 1 + guided.ENCODED)]
