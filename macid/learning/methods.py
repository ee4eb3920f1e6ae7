"""IPO, MFPO, CoPO, MAC-ID and MAC-ID(tri): only what sets them apart.

Each agent maximises c_I A_I + c_N A_N, with coefficients of its LCF (eq. 2). IPO is MAC-ID with the LCF at zero.
"""

import dataclasses
import math
from collections.abc import Callable

import jax.numpy as jnp


def linear(lcf):
    """MAC-ID's coefficients, eq. 2: 1 and the LCF."""
    return jnp.ones_like(lcf), lcf


def trigonometric(lcf):
    """SVO's coefficients, sec. V-B: cos and sin of the LCF."""
    return jnp.cos(lcf), jnp.sin(lcf)


def quarter_turn(lcf):
    """CoPO's coefficients: cos and sin of an LCF in [-1, 1] as a share of a quarter turn."""
    return trigonometric(jnp.clip(lcf, -1.0, 1.0) * (math.pi / 2))


@dataclasses.dataclass(frozen=True)
class Method:
    """A training method. lcf: the range from which an agent's LCF is drawn, uniformly, for an episode."""

    name: str
    lcf: tuple[float, float] = (0.0, 0.0)
    test_lcf: tuple[float, float] = (0.0, 0.0)  # the range for Table II
    coordination: Callable = linear
    mean_field: bool = False  # critics see the mean of the neighbours' features and actions beside one's own
    meta: bool = False  # LCFs come from one normal distribution, which a meta step learns (macid.learning.copo)

    @property
    def critics(self):
        """Names of the value networks; each is of the reward of that name. Without LCFs the second would weigh nothing."""
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
    )
}


def get_method(name):
    """The method `name`. Raises ValueError, naming the valid ones."""
    if name not in METHODS:
        raise ValueError(f"Unknown method '{name}'. Choose one of {', '.join(METHODS)}.")
    return METHODS[name]
