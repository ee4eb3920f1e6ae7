"""The policy of a training that scores best on validation episodes, and the curve: written, and kept in checkpoints."""

import functools
import pathlib
import time
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from bson.agents import learned
from bson.agents.contract import Setting, Unsuited
from bson.agents.learned import KINDS
from bson.agents.shield import Shield
from bson.episodes.tracks import make_track
from bson.evaluation.metrics import measure
from bson.evaluation.play import run_episodes, sound, versions
from bson.evaluation.suites import load_suite
from bson.learning.draw import load_draw, validation_seeds
from bson.task import TaskConfig
from macid.files import UsageError
from macid.learning.curves import plain, thin, write_curve
from macid.policy import check_layers

SCORES = ("SNS", "RC", "Coll", "SP", "PE", "success")
RECENT = 100  # number of ended episodes in a curve's means
_VALIDATION_SEED = 9  # of the suite `paper`: other episodes than the scored ones
_LAYER = ("weight", "bias")
Count = Annotated[int, msgspec.Meta(ge=0, le=10**15)]


def means_of(ended: Sequence[dict[str, float]]) -> dict[str, float]:
    """The means over episodes of what their infos tell as `episode` (bson.learning.vec_env.summary)."""
    return {name: float(np.mean([one[name] for one in ended])) for name in ("r", "l", *SCORES)}


class _Best(msgspec.Struct):
    output: Literal["clip", "tanh"]
    steps: Count
    validation: dict[str, float]


class Keeper(msgspec.Struct):
    """What a training's keeper notes."""

    curve: list[dict[str, float]]
    validations: list[dict[str, float]]
    best: _Best | None
    spent: Annotated[float, msgspec.Meta(ge=0)]


def collect_keeper(keeper: dict[str, Any]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """({name: array}, the rest) of a keeper's state."""
    found, best = {}, keeper["best"]
    if best:
        for index, (weight, bias) in enumerate(best["layers"]):
            found |= {f"best/weight{index}": weight, f"best/bias{index}": bias}
    return found, keeper | {"best": best and {name: best[name] for name in ("output", "steps", "validation")}}


def wanted_keeper(noted: dict[str, Any], layers: Any) -> dict[str, np.ndarray]:
    """The arrays, as far as names and shapes go, that `collect_keeper` gave beside `noted`; layers: an example of the
    policy's. Raises ValueError."""
    if not noted["best"]:
        return {}
    if "SNS" not in noted["best"]["validation"]:
        raise ValueError("its best policy has no SNS")
    return {
        f"best/{name}{index}": one
        for index, layer in enumerate(layers)
        for name, one in zip(_LAYER, layer, strict=True)
    }


def restore_keeper(found: dict[str, np.ndarray], noted: dict[str, Any], number: int) -> dict[str, Any]:
    """The keeper's state, from arrays whose names and shapes were checked. number: of layers. Raises ValueError."""
    best = noted["best"]
    if best:
        layers = [(found[f"best/weight{index}"], found[f"best/bias{index}"]) for index in range(number)]
        for layer in layers:  # whose shapes are the example's
            check_layers([layer])
        best = {"layers": layers, **best}
    return noted | {"best": best}


class BestKeeper:
    """Writes a training's policy.npz and policy.json, of the policy that did best on the validation episodes, and
    curve.csv.

    config: a TrainConfig or DeviceTrainConfig; folder: the training's, of curves.training_folder. board: the
    curves.Board that gets the curve and the validations too, once there is one."""

    def __init__(self, config: Any, folder: pathlib.Path):
        self.config, self.folder = config, folder
        self.board: Any = None
        self.curve: list[dict[str, float]] = []
        self.validations: list[dict[str, float]] = []
        self.spent = 0.0
        self.best: dict | None = None  # the policy that scored best: layers, output, steps, validation
        self._begin = time.monotonic()

    @property
    def state(self) -> dict[str, Any]:
        """The keeper's part of a checkpoint."""
        return {"curve": self.curve, "validations": self.validations, "best": self.best, "spent": self.seconds}

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on from a `state`."""
        self.curve, self.validations, self.best = state["curve"], state["validations"], state["best"]
        self.spent, self._begin = state["spent"], time.monotonic()

    @property
    def seconds(self) -> float:
        """Time spent so far, in all sittings [s]."""
        return self.spent + time.monotonic() - self._begin

    def validate(
        self, layers: Any, output: str, steps: int, interrupted: Callable[[], bool] = lambda: False
    ) -> dict[str, float]:
        """Scores a policy on the validation episodes, and keeps it if it is the best so far; returns its scores. Raises
        KeyboardInterrupt once interrupted() is true."""

        def progress(steps, episode):
            if interrupted():
                raise KeyboardInterrupt

        config, kind, measured = self.config, KINDS[self.config.inputs], []
        track = make_track(kind.track, kind.sensor)
        agent = functools.partial(_agent, config, layers, output)
        for setting, seeds in validation(config):
            episodes = sound(run_episodes(agent, setting, track, seeds, config.name, progress))
            measured += [measure(episode) for episode in episodes]
        scores = {name: round(float(np.mean([row[name] for row in measured])), 4) for name in SCORES}
        self.validations.append({"steps": steps, **scores})
        if self.board:
            self.board.write({"steps": steps, **{f"validation/{name}": score for name, score in scores.items()}})
        if self.best is None or scores["SNS"] > self.best["validation"]["SNS"]:
            self.best = {"layers": layers, "output": output, "steps": steps, "validation": scores}
        return scores

    def log(self, row: dict[str, float], more: dict[str, float] | None = None) -> None:
        """Adds `row`, {name: number}, to the curve. more: further numbers, {name: number}, for the board only."""
        self.curve.append(row)
        write_curve(self.folder / "curve.csv", self.curve)
        if self.board:
            self.board.write(row | (more or {}))

    def write(self, steps: int) -> None:
        """Writes the best policy so far, with its recipe; steps: done."""
        best = self.best
        assert best is not None  # set by the first validation
        kind = KINDS[self.config.inputs]
        recipe = {
            "name": self.config.name,
            "command": self.config.command,
            **noted_config(self.config),
            "steps_done": steps,
            "seconds": round(self.seconds, 1),
            "output": best["output"],
            "setting": learned.setting_document(
                Setting.of(self.config.setting, make_track("local", kind.sensor)), getattr(kind, "pictures", False)
            ),
            "from_steps": best["steps"],
            "validation": best["validation"],
            "validations": self.validations,
            "curve": [{name: round(value, 4) for name, value in row.items()} for row in thin(self.curve, 60)],
            "versions": versions(),
        }
        learned.write(self.folder / "policy", best["layers"], recipe)


def _agent(config, layers, output, setting):
    """The agent of a training's policy for a robot in `setting`."""
    policy = KINDS[config.inputs].of_layers(layers, output, setting)
    return Shield(policy, setting) if getattr(config.hyperparameters, "shield", False) else policy


def noted_config(config: Any) -> dict[str, Any]:
    """A TrainConfig or DeviceTrainConfig as a recipe has it, without what came later and is as it always was."""
    noted = plain(config)
    for name in ("inputs", "draw", "start"):
        if noted[name] == getattr(type(config), name):
            del noted[name]
    return noted


def validation(config: Any) -> list[tuple[TaskConfig, list[int]]]:
    """[(setting, seeds), ...] of the episodes by which the policy of a training is chosen."""
    if config.draw is None:
        return [(config.setting, load_suite("paper").drawn(config.validate_episodes, _VALIDATION_SEED))]
    settings = load_draw(config.draw).validation
    each = -(-config.validate_episodes // len(settings))
    return [(setting.replace(**config.task), validation_seeds(each)) for setting in settings]


def started(config: Any) -> Any:
    """The parts of the policy `config.start`, with which a recurrent robot begins to learn; None for a new one. Raises
    UsageError where it is of another kind, or from another setting."""
    if config.start is None:
        return None
    policy, kind = learned.load(config.start), KINDS[config.inputs]
    outputs = ("clip", "tanh") if config.algo in ("sac", "tac") else ("clip",)  # others' actions are clipped
    if policy.kind is not kind or policy.output not in outputs:
        inputs = next(name for name, each in KINDS.items() if each is policy.kind)
        raise UsageError(
            f"--start {config.start}: its inputs are {inputs}, its output is {policy.output}; it must be a policy with "
            f"--inputs {config.inputs} and the output {' or '.join(outputs)}."
        )
    try:
        return policy(Setting.of(config.setting, make_track(kind.track, kind.sensor))).network
    except Unsuited as error:
        raise UsageError(f"--start {config.start}: {str(error).partition(';')[0]}.") from None
