"""Pedestrian models behind one call: `controller(state, boxes, goals, lcf) -> command`.

state: CrowdState (..., K), whose `traits` tell radii, preferred and maximum speeds and groups where these are not the
paper's; a model heeds what it knows of. boxes: (..., B, 5) rows of `geometry.BOX_COLUMNS`; goals: (..., K, 2) [m];
lcf: (..., K). command: (..., K, 3), world-frame velocity [m/s] and yaw rate [rad/s], for the controller's `period` [s].

Names and files are checked without JAX, which the models are made of and which takes long to load.
"""

import importlib
import inspect
from collections.abc import Callable
from typing import Any, Protocol, cast

from macid.files import UsageError
from macid.policy import load_policy, policy_names
from macid.registry import Kind
from macid.state import RADIUS


class Controller(Protocol):
    """What moves a crowd. It is traced by jax.jit, so it is made of JAX's functions, and may be vectorised."""

    def __call__(self, state: Any, boxes: Any, goals: Any, lcf: Any, /) -> Any:
        """The command (..., K, 3) in the world frame: velocity [m/s], and yaw rate [rad/s]. See the module."""
        ...


def _rule(name, **options):
    """Makes the rule `module:class` of this package, deciding every `period` [s]."""

    def make(period):
        module, _, kind = name.partition(":")
        return getattr(importlib.import_module(f"macid.pedestrians.{module}"), kind)(period=period, **options)

    return make


MODELS = {
    "social-force": _rule("social_force:SocialForce"),
    "social-force-progress": _rule("social_force:SocialForce", step_by_progress=True),
    "social-force-bodies": _rule("social_force:SocialForce", step_by_progress=True, body_radius=RADIUS),
    "orca": _rule("orca:ORCA"),
    "standing": _rule("standing:Standing"),
}


def _learned(name: str) -> Callable[[float], Controller]:
    """Makes the learned model `name`, which is shipped or a file (.npz)."""
    policy = load_policy(name)

    def make(period: float) -> Controller:
        from macid.encounter_policy import EncounterPolicy
        from macid.pedestrians.learned import Learned, LearnedEncounters

        return LearnedEncounters(policy, period) if isinstance(policy, EncounterPolicy) else Learned(policy, period)

    return make


def _own(found: Any, name: str) -> Callable[[float], Controller]:
    """Makes somebody's own model: a class or function that is called with `period=`, or a controller itself."""
    if not callable(found):
        raise UsageError(f"Pedestrian model '{name}' is not callable. {PEDESTRIANS.help}")
    try:
        takes_period = "period" in inspect.signature(found).parameters
    except ValueError:  # of compiled code
        takes_period = False

    def make(period: float) -> Controller:
        with PEDESTRIANS.running(name, "making one"):
            made = found(period=period) if takes_period else found() if inspect.isclass(found) else found
        return _Told(name, made) if callable(made) else cast(Controller, made)

    return make


class _Told:
    """Somebody's own controller `made`, of the model `name`: what its code raises, and a command of another shape than
    its call gives, are told in one line."""

    def __init__(self, name: str, made: Controller):
        self._name, self._made = name, made

    def __call__(self, state: Any, boxes: Any, goals: Any, lcf: Any, /) -> Any:
        with PEDESTRIANS.running(self._name, "deciding, traced by JAX (it is written with jax.numpy)"):
            command = self._made(state, boxes, goals, lcf)
        found, wanted = getattr(command, "shape", None), (*goals.shape[:-1], 3)
        if found != wanted:
            raise UsageError(f"Pedestrian model '{self._name}' gives commands of shape {found}, not {wanted}.")
        return command


#: Pedestrian models: each is called with the `period` [s] of its decisions and gives a Controller.
PEDESTRIANS: Kind[Callable[[float], Controller]] = Kind(
    "pedestrian model",
    MODELS,
    shipped=lambda: sorted({*policy_names(), *(name.rpartition("-")[0] for name in policy_names())}),
    listed=lambda: model_names(),
    read=_learned,
    files=(".npz",),
    own="class",
    check=_own,
)


def model_names() -> list[str]:
    """The names that `make_controller` takes: rules, and the methods that shipped policies were trained by; sorted.

    A method's name stands for its policy of the first seed; `name-SEED` is the policy of another seed.
    """
    return sorted([*MODELS, *{name.rpartition("-")[0] for name in policy_names()}])


def is_learned(name: str) -> bool:
    """Whether the pedestrian model `name` is a policy, which heeds LCFs, not a rule."""
    return name not in MODELS and (name.endswith(".npz") or name in PEDESTRIANS.shipped())


def check_model(name: str) -> None:
    """Raises UsageError unless `make_controller` can make the pedestrian model `name`."""
    PEDESTRIANS.load(name)


def make_controller(name: str, period: float) -> Controller:
    """The pedestrian model `name`, deciding every `period` [s]: a rule, a shipped policy ("macid", "macid-2"), a policy
    file (.npz), or one's own, `module:class` or `file.py:class`. Raises UsageError for an unknown name."""
    return PEDESTRIANS.load(name)(period)
