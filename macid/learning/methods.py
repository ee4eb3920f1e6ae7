"""IPO, MFPO, CoPO, MAC-ID, MAC-ID(tri), MAC-ID(touch) and MAC-ID(human): for each method only what sets it apart.

Each agent maximises c_I A_I + c_N A_N, with coefficients of its LCF (eq. 2). IPO is MAC-ID with the LCF at zero.
"""

import dataclasses
import math
from collections.abc import Callable

import jax.numpy as jnp

from macid.documents import shown
from macid.files import UsageError
from macid.geometry import Array
from macid.registry import Kind
from macid.reward import RewardWeights, neighborhood_mean, neighbors


def linear(lcf: Array) -> tuple[Array, Array]:
    """MAC-ID's coefficients, eq. 2: 1 and the LCF."""
    return jnp.ones_like(lcf), lcf


def trigonometric(lcf: Array) -> tuple[Array, Array]:
    """SVO's coefficients, sec. V-B: cos and sin of the LCF."""
    return jnp.cos(lcf), jnp.sin(lcf)


def quarter_turn(lcf: Array) -> tuple[Array, Array]:
    """CoPO's coefficients: cos and sin of an LCF in [-1, 1] as a share of a quarter turn."""
    return trigonometric(jnp.clip(lcf, -1.0, 1.0) * (math.pi / 2))


CARE = 8.0  # at 3.0 people collided more (on the maps for validation)


def considerate(lcf: Array) -> tuple[Array, Array]:
    """MAC-ID(touch)'s coefficients: 1, and the LCF times CARE above 0, half the LCF below.

    So at LCF 1 a touch costs w_c for oneself and CARE w_c for each other person; at -2 the two cancel, and touching is
    free.
    """
    return jnp.ones_like(lcf), jnp.where(lcf > 0, CARE, 0.5) * lcf


def neighbors_mean(reward: Array, position: Array, touched: Array, weights: RewardWeights) -> Array:
    """Eq. 1: the mean (..., K) of the neighbours' individual rewards (..., K); people are at `position` (..., K, 2)
    [m]."""
    return neighborhood_mean(reward[..., None], neighbors(position))[..., 0]


def cost_of_touch(reward: Array, position: Array, touched: Array, weights: RewardWeights) -> Array:
    """MAC-ID(touch)'s shared reward (..., K), in place of eq. 1: what a person's touch costs the others by eq. 5.

    touched (..., K): how many people each person touches. The rest of the neighbours' rewards is left out: it does not
    follow from the person's own decisions, and in eq. 1 it makes company pay, since everybody who walks earns.
    """
    return -weights.collision * touched


@dataclasses.dataclass(frozen=True)
class Method:
    """A training method. lcf: the range from which an agent's LCF is drawn, uniformly, for an episode."""

    name: str
    lcf: tuple[float, float] = (0.0, 0.0)
    test_lcf: tuple[float, float] = (0.0, 0.0)  # the range for Table II
    coordination: Callable = linear
    shared: Callable = neighbors_mean  # the neighbourhood's reward
    mean_field: bool = False  # critics see the mean of the neighbours' features and actions beside one's own
    meta: bool = False  # LCFs come from one normal distribution, which a meta step learns (macid.learning.copo)
    in_scenes: bool = False  # it learns in scenes, from gradients (macid.learning.scene_trainer), not on a level

    @property
    def critics(self) -> tuple[str, ...]:
        """Names of the value networks; each predicts the reward of its name. Without LCFs the second would weigh
        nothing."""
        if self.meta:
            return ("individual", "neighborhood", "global")
        return ("individual",) if self.lcf == (0.0, 0.0) else ("individual", "neighborhood")


METHODS = {
    method.name: method
    for method in (
        Method("ipo"),
        Method("mfpo", mean_field=True),
        Method("copo", lcf=(-1.0, 1.0), coordination=quarter_turn, meta=True),
        Method("macid", lcf=(-2.0, 2.0), test_lcf=(0.67, 1.33)),
        Method(
            "macid-tri",
            lcf=(-math.pi / 2, math.pi / 2),
            test_lcf=(math.pi / 6, math.pi / 3),
            coordination=trigonometric,
        ),
        Method("macid-touch", lcf=(-2.0, 2.0), test_lcf=(0.67, 1.33), coordination=considerate, shared=cost_of_touch),
        Method("macid-human", lcf=(-2.0, 2.0), test_lcf=(0.67, 1.33), in_scenes=True),
    )
}
#: Those that learn on a level, with the first observation: the tables compare these.
LEVEL_METHODS = [method.name for method in METHODS.values() if not method.in_scenes]


def _own(found, name):
    if not isinstance(found, Method):
        raise UsageError(f"Method '{name}' must be a macid.learning.methods.Method, not {shown(found)}.")
    return found


KIND: Kind[Method] = Kind("method", METHODS, own="method", check=_own)


def get_method(name: str) -> Method:
    """The method `name`: one of METHODS, or one's own, `module:method` or `file.py:method`. Raises UsageError."""
    return KIND.load(name)
