"""What callers give a policy: read as arrays, checked, and bounded."""

import sys
from typing import Any

import numpy as np

from macid.geometry import Array
from macid.state import MAX_LCF

MOST_READING = 1e6  # any number in an observation but a distance that may be infinite [m, m/s, rad/s]


def within(xp: Any, x: Array, least: Array, most: Array) -> Array:
    """`x` in [least, most], NaN as 0."""
    return xp.clip(xp.where(xp.isnan(x), xp.zeros_like(x), x), least, most)


def is_traced(x: Array) -> bool:
    """Whether `x` stands for values that JAX doesn't have yet, as under jax.jit."""
    jax = sys.modules.get("jax")
    return jax is not None and isinstance(x, jax.core.Tracer)


def as_numbers(values: Any, what: str) -> Array:
    """`values` as a float32 array, NumPy's or JAX's. Raises ValueError where they are no numbers."""
    if not hasattr(values, "__array_namespace__"):
        try:
            values = np.asarray(values)
        except (ValueError, TypeError, RuntimeError) as error:  # rows of different lengths; a tensor on a GPU
            raise ValueError(f"{what} is no array of numbers: {' '.join(str(error).split())[:200]}") from None
    xp = values.__array_namespace__()
    if not xp.isdtype(values.dtype, ("bool", "integral", "real floating")):
        raise ValueError(f"{what} has real numbers, not {'None' if values.dtype == object else values.dtype}.")
    with np.errstate(over="ignore"):  # to infinity
        return xp.asarray(values, dtype=np.float32)


def check_shapes(observed: tuple[int, ...], lcf: tuple[int, ...], size: int, module: str) -> None:
    """Raises ValueError unless the shapes are those of observations (..., size) and of LCFs that fit them. module: what
    describes the observations."""
    if not observed or observed[-1] != size:
        given = observed[-1] if observed else "one number"
        raise ValueError(f"An observation has {size} columns ({module}), not {given}.")
    try:
        fits = np.broadcast_shapes(lcf, observed[:-1]) == tuple(observed[:-1])
    except ValueError:
        fits = False
    if not fits:
        wanted = f"LCFs {tuple(observed[:-1])} or one for all"
        raise ValueError(f"Observations {tuple(observed)} take {wanted}, not {tuple(lcf)}.")


def as_readings(observed: Array, lcf: Array, size: int, module: str) -> tuple[Array, Array, Any]:
    """(observations (..., size), LCFs that fit them, the array namespace of both), float32 arrays; LCFs are checked, or
    bounded where they are traced. module: as of `check_shapes`. Raises ValueError."""
    observed, lcf = as_numbers(observed, "An observation"), as_numbers(lcf, "An LCF")
    check_shapes(observed.shape, lcf.shape, size, module)
    xp = (lcf if is_traced(lcf) else observed).__array_namespace__()
    if is_traced(lcf):
        lcf = within(xp, lcf, -MAX_LCF, MAX_LCF)
    else:
        check_lcf(np.asarray(lcf))
    return observed, lcf, xp


def check_lcf(lcf: np.ndarray) -> None:
    """Raises ValueError unless every number of the NumPy array is an LCF."""
    good = np.abs(lcf) <= MAX_LCF
    if not good.all():
        raise ValueError(f"An LCF is a number from -{MAX_LCF:g} to {MAX_LCF:g}, not {lcf[~good].flat[0]:g}.")
