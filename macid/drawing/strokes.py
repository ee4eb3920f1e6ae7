"""Texts, lines and discs on a picture."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from macid.drawing.colours import PAPER


def _thick(width):
    return max(1, round(width))


def _font(bold):
    import cv2

    return cv2.FONT_HERSHEY_DUPLEX if bold else cv2.FONT_HERSHEY_SIMPLEX


def measure(text: str, size: float, bold: bool = False) -> Sequence[int]:
    """Width and height [pixels] of `text`."""
    import cv2

    return cv2.getTextSize(text, _font(bold), size, _thick(size))[0]


def write(
    image: np.ndarray,
    text: str,
    place: Iterable[float],
    size: float,
    colour: Sequence[float],
    bold: bool = False,
    halo: bool = False,
) -> None:
    """Writes `text` with its baseline's left end at `place`."""
    import cv2

    where = [round(float(value)) for value in place]
    if halo:
        for offset in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            shifted = [where[0] + offset[0], where[1] + offset[1]]
            cv2.putText(image, text, shifted, _font(bold), size, PAPER, _thick(size), cv2.LINE_AA)
    cv2.putText(image, text, where, _font(bold), size, colour, _thick(size), cv2.LINE_AA)


def _sixteenths(points):
    """Pixels as OpenCV's drawing takes them with shift=4."""
    return np.round(np.asarray(points) * 16).astype(np.int32)


def line(image: np.ndarray, points: ArrayLike, colour: Sequence[float], width: float, closed: bool = False) -> None:
    """Draws a line through `points` (N, 2), in pixels."""
    import cv2

    cv2.polylines(image, [_sixteenths(points)], closed, colour, _thick(width), cv2.LINE_AA, 4)


def polygon(image: np.ndarray, points: ArrayLike, colour: Sequence[float]) -> None:
    """Fills the polygon with the corners `points` (N, 2), in pixels."""
    import cv2

    cv2.fillPoly(image, [_sixteenths(points)], colour, cv2.LINE_AA, 4)


def disc(image: np.ndarray, place: Iterable[float], radius: float, colour: Sequence[float]) -> None:
    """Fills a circle around `place` x, y; in pixels."""
    import cv2

    cv2.circle(image, [round(16 * float(v)) for v in place], round(16 * radius), colour, -1, cv2.LINE_AA, 4)


def ring(image: np.ndarray, place: Iterable[float], radius: float, colour: Sequence[float], width: float) -> None:
    """Draws a circle around `place` x, y; in pixels."""
    import cv2

    cv2.circle(image, [round(16 * float(v)) for v in place], round(16 * radius), colour, _thick(width), cv2.LINE_AA, 4)
