"""Colours of people, goals and pages."""

from collections.abc import Iterable

import numpy as np

LCF_RANGE = (-2.0, 2.0)  # the ends of the colour scale
LCF_STOPS = np.array(  # RGB at equal steps of the LCF: ColorBrewer's RdYlBu, safe for the colour-blind
    [[0.78, 0.07, 0.09], [0.98, 0.62, 0.34], [0.98, 0.95, 0.68], [0.52, 0.76, 0.90], [0.10, 0.38, 0.72]]
)
GOAL_RGB = (0.05, 0.62, 0.32)
INK, MUTED, PAPER, PANEL = (38, 43, 51), (112, 119, 130), (255, 255, 255), (244, 245, 247)


def lcf_colour(lcf: float | np.ndarray) -> np.ndarray:
    """The colour of each `lcf` (...), RGB (..., 3) in [0, 1]: red if adversarial (-2), pale yellow at 0, blue at 2."""
    stops = np.linspace(*LCF_RANGE, len(LCF_STOPS))
    return np.stack([np.interp(lcf, stops, channel) for channel in LCF_STOPS.T], axis=-1)


def rgb255(rgb: Iterable[float]) -> tuple[int, ...]:
    """A colour of [0, 1] as OpenCV has it: integers to 255."""
    return tuple(round(255 * float(channel)) for channel in rgb)
