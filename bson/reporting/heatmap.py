"""A suite's cells as heat maps, or as a dot plot where there is but one axis; HTML that fits wide and narrow pages."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from bson.reporting.page import numbers, render
from macid.pages import INK

_WORSE, _MIDDLE, _BETTER = np.array([[188, 74, 48], [250, 240, 215], [22, 108, 140]])  # safe for the colour-blind


@dataclasses.dataclass(frozen=True)
class Scale:
    """A metric's scale: its ends, which way is better ("up" or "down"), and whether it is log(1 + value)."""

    low: float
    high: float
    better: str = "up"
    logarithmic: bool = False

    def place(self, value: float) -> float:
        """The place of `value`, from 0 at the low end to 1 at the high one."""
        low, high, value = (
            math.log1p(x) if self.logarithmic else x for x in (self.low, self.high, max(value, self.low))
        )
        return min((value - low) / (high - low), 1.0)

    def at(self, place: float) -> float:
        """The value at `place` in [0, 1]."""
        if self.logarithmic:
            return math.expm1(math.log1p(self.low) * (1 - place) + math.log1p(self.high) * place)
        return self.low * (1 - place) + self.high * place

    def colours(self, value: float) -> str:
        """CSS for `value`: a background, warm where it is worse and teal where it is better, and a text colour that is
        readable on it."""
        goodness = self.place(value) if self.better == "up" else 1.0 - self.place(value)
        end = _BETTER if goodness > 0.5 else _WORSE
        rgb = _MIDDLE + (end - _MIDDLE) * abs(2 * goodness - 1)
        ink = "#fff" if rgb @ (0.299, 0.587, 0.114) < 140 else INK
        return f"background:rgb({','.join(str(round(c)) for c in rgb)});color:{ink}"


@dataclasses.dataclass(frozen=True)
class Tile:
    """One cell to draw. grades: {axis: grade}; value: None where the cell has none; mark: a sign beside the value."""

    grades: dict
    value: float | None
    low: float | None = None
    high: float | None = None
    mark: str = ""


def _axes(tiles):
    """{axis: its grades} of the tiles, both in order."""
    return {axis: list(dict.fromkeys(tile.grades[axis] for tile in tiles)) for axis in tiles[0].grades}


def _ends(scale):
    """The scale's low end, its middle and its high end as texts."""
    return [f"{scale.at(place):.3g}" for place in (0, 0.5, 1)]


def _shown(tile, scale, digits):
    """The value with its mark, and the interval, as texts."""
    value, low, high = numbers(tile.value, tile.low, tile.high, digits=digits, signed=scale.low < 0)
    return value + tile.mark, f"[{low}, {high}]"


def _gradient(scale):
    """The scale's colours as CSS has a gradient's."""
    backgrounds = (scale.colours(scale.at(place)).split(";")[0].removeprefix("background:") for place in (0, 0.5, 1))
    return f"90deg,{','.join(backgrounds)}"


def _box(tile, scale, digits):
    """A heat table's entry for a tile; None where there is no tile."""
    if tile is None or tile.value is None:
        return None
    value, interval = _shown(tile, scale, digits)
    return {"colours": scale.colours(tile.value), "value": value, "interval": interval}


def _panels(tiles, scale, digits):
    """A heat table for each combination of the axes before the last two, which are rows and columns."""
    axes = _axes(tiles)
    *outer, rows, columns = axes
    panels = []
    for grades in itertools.product(*(axes[axis] for axis in outer)):
        chosen = dict(zip(outer, grades, strict=True))
        inside = {
            (tile.grades[rows], tile.grades[columns]): _box(tile, scale, digits)
            for tile in tiles
            if all(tile.grades[axis] == grade for axis, grade in chosen.items())
        }
        panels.append(
            {
                "title": ", ".join(f"{axis}: {grade}" for axis, grade in chosen.items()),
                "columns": axes[columns],
                "rows": [(row, [inside.get((row, column)) for column in axes[columns]]) for row in axes[rows]],
            }
        )
    return {"panels": panels, "rows": rows, "columns": columns, "several": bool(outer), "gradient": _gradient(scale)}


def _line(tile, scale, digits):
    """A dot plot's line for a tile: a dot on the scale, and its interval."""
    name = ", ".join(tile.grades.values())
    if tile.value is None:
        return {"name": name, "value": None}
    value, interval = _shown(tile, scale, digits)
    left, place, right = (100 * scale.place(x) for x in (tile.low, tile.value, tile.high))
    return {
        "name": name,
        "value": value,
        "interval": interval,
        "left": f"{left:.1f}",
        "width": f"{right - left:.1f}",
        "place": f"{place:.1f}",
        "colour": scale.colours(tile.value).split(";")[0],
    }


def _dots(tiles, scale, digits):
    """A dot plot, one line for each cell."""
    zero = f"{100 * scale.place(0.0):.1f}" if scale.low < 0 < scale.high else None
    return {"panels": None, "lines": [_line(tile, scale, digits) for tile in tiles], "zero": zero}


def cell_maps(tiles: Sequence[Tile], scale: Scale, heading: str, note: str = "", digits: int | None = None) -> Any:
    """`tiles`, all with the same axes (at least one), under `heading` and a smaller `note`, as HTML.

    digits: decimals, or as many as fit each."""
    drawn = (_dots if len(tiles[0].grades) == 1 else _panels)(tiles, scale, digits)
    return render("heatmap.html", heading=heading, note=note, ends=_ends(scale), **drawn)
