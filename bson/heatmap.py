"""A suite's cells as heat maps, or as a dot plot where there is but one axis; HTML that fits wide and narrow pages."""

import dataclasses
import html
import itertools
import math

import numpy as np

from bson.page import numbers

STYLE = """
.maps{margin-bottom:20px} .maps>header{display:flex;flex-wrap:wrap;gap:4px 18px;align-items:baseline;margin-bottom:6px}
.maps>header b{font-size:15px} .maps>header small{color:#5b6876}
.scale{display:inline-flex;gap:6px;align-items:center;color:#5b6876;font-size:12px}
.scale i{width:130px;height:10px;border-radius:3px;display:inline-block}
.panels{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(300px,100%),1fr));gap:14px}
.panels.one{max-width:640px} .dotplots{display:grid;gap:14px}
.dotplots{grid-template-columns:repeat(auto-fit,minmax(min(330px,100%),1fr))}
.panel{background:#fff;border:1px solid #e1e6eb;border-radius:10px;padding:10px;overflow-x:auto}
.heat{border-collapse:separate;border-spacing:2px;table-layout:fixed} .heat th,.heat td{padding:5px 3px;text-align:center;vertical-align:middle;position:static}
.heat th{background:none;font-size:12px;font-weight:600;color:#5b6876} .heat th:first-child{text-align:right;width:66px;overflow-wrap:anywhere}
.heat th small{font-weight:400;font-size:11px;line-height:1.3;display:block} .heat td{border-radius:5px;line-height:1.2} .heat td b{display:block}
.heat td small{font-size:11px;color:inherit;opacity:.85}
.dots{display:grid;grid-template-columns:fit-content(40%) 1fr auto;gap:5px 14px;overflow-wrap:anywhere;align-items:center;font-size:13px}
.track{position:relative;height:20px;background:#f1f4f6;border-radius:4px}
.track u{position:absolute;top:0;bottom:0;width:1px;background:#9aa5b1} .dots>b{text-align:right}
.track i{position:absolute;top:8px;height:4px;border-radius:2px;background:#9aa5b1}
.track em{position:absolute;top:4px;width:12px;height:12px;margin-left:-6px;border-radius:6px;border:1px solid #1d2733}
.dots>b small{display:block;font-weight:400;color:#5b6876;line-height:1.1} .ends{display:flex;font-size:12px;color:#5b6876}
.ends{justify-content:space-between}
"""

_WORSE, _MIDDLE, _BETTER = np.array([[188, 74, 48], [250, 240, 215], [22, 108, 140]])  # safe for the colour-blind


@dataclasses.dataclass(frozen=True)
class Scale:
    """Of a metric: its ends, which way is better ("up" or "down"), and whether it is log(1 + value)."""

    low: float
    high: float
    better: str = "up"
    logarithmic: bool = False

    def place(self, value):
        """In [0, 1] from the low end to the high one."""
        low, high, value = (
            math.log1p(x) if self.logarithmic else x for x in (self.low, self.high, max(value, self.low))
        )
        return min((value - low) / (high - low), 1.0)

    def at(self, place):
        """The value at `place` in [0, 1]."""
        if self.logarithmic:
            return math.expm1(math.log1p(self.low) * (1 - place) + math.log1p(self.high) * place)
        return self.low * (1 - place) + self.high * place

    def colours(self, value):
        """CSS of a background, warm where it is worse and teal where it is better, and of text that is read on it."""
        goodness = self.place(value) if self.better == "up" else 1.0 - self.place(value)
        end = _BETTER if goodness > 0.5 else _WORSE
        rgb = _MIDDLE + (end - _MIDDLE) * abs(2 * goodness - 1)
        ink = "#fff" if rgb @ (0.299, 0.587, 0.114) < 140 else "#1d2733"
        return f"background:rgb({','.join(str(round(c)) for c in rgb)});color:{ink}"


@dataclasses.dataclass(frozen=True)
class Tile:
    """What is drawn of one cell. grades: {axis: grade}; value: None where there is none; mark: a sign beside it."""

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


def _legend(scale):
    backgrounds = (scale.colours(scale.at(place)).split(";")[0].removeprefix("background:") for place in (0, 0.5, 1))
    ends = _ends(scale)
    return (
        f'<span class="scale">{ends[0]}<i style="background:linear-gradient(90deg,{",".join(backgrounds)})" '
        f'title="middle: {ends[1]}"></i>{ends[2]}</span>'
    )


def _heat_table(tiles, rows, columns, scale, digits):
    """tiles: {(row grade, column grade): Tile}. rows, columns: (axis, grades)."""
    head = "".join(f"<th>{html.escape(grade)}</th>" for grade in columns[1])
    corner = f"<small>{html.escape(rows[0])} &darr;<br>{html.escape(columns[0])} &rarr;</small>"
    lines = []
    for row in rows[1]:
        boxes = []
        for column in columns[1]:
            tile = tiles.get((row, column))
            if tile is None or tile.value is None:
                boxes.append('<td style="background:#eef2f5">&ndash;</td>')
            else:
                value, interval = _shown(tile, scale, digits)
                boxes.append(f'<td style="{scale.colours(tile.value)}"><b>{value}</b><small>{interval}</small></td>')
        lines.append(f"<tr><th>{html.escape(row)}</th>{''.join(boxes)}</tr>")
    return f'<table class="heat"><tr><th>{corner}</th>{head}</tr>{"".join(lines)}</table>'


def _heat_maps(tiles, scale, digits):
    """A panel for each combination of the axes before the last two, which are rows and columns."""
    axes = _axes(tiles)
    *outer, rows, columns = axes
    panels = []
    for grades in itertools.product(*(axes[axis] for axis in outer)):
        chosen = dict(zip(outer, grades, strict=True))
        inside = {
            (tile.grades[rows], tile.grades[columns]): tile
            for tile in tiles
            if all(tile.grades[axis] == grade for axis, grade in chosen.items())
        }
        title = ", ".join(f"{axis}: {grade}" for axis, grade in chosen.items())
        table = _heat_table(inside, (rows, axes[rows]), (columns, axes[columns]), scale, digits)
        panels.append(f'<div class="panel">{f"<h4>{html.escape(title)}</h4>" if title else ""}{table}</div>')
    return f'<div class="panels{"" if outer else " one"}">{"".join(panels)}</div>'


def _dots(tiles, scale, digits):
    """One line a cell: a dot on the scale, and its interval."""
    zero = f'<u style="left:{100 * scale.place(0.0):.1f}%"></u>' if scale.low < 0 < scale.high else ""
    lines = []
    for tile in tiles:
        name = html.escape(", ".join(tile.grades.values()))
        if tile.value is None:
            lines.append(f'<span>{name}</span><span class="track">{zero}</span><b>&ndash;</b>')
            continue
        value, interval = _shown(tile, scale, digits)
        left, place, right = (100 * scale.place(x) for x in (tile.low, tile.value, tile.high))
        lines.append(
            f'<span>{name}</span><span class="track">{zero}<i style="left:{left:.1f}%;width:{right - left:.1f}%"></i>'
            f'<em style="left:{place:.1f}%;{scale.colours(tile.value).split(";")[0]}"></em></span>'
            f"<b>{value}<small>{interval}</small></b>"
        )
    ends = "".join(f"<span>{end}</span>" for end in _ends(scale))
    return f'<div class="panel dots">{"".join(lines)}<span></span><span class="ends">{ends}</span><span></span></div>'


def cell_maps(tiles, scale, heading, note="", digits=None):
    """`tiles`, all with the same axes (at least one), under `heading` and a smaller `note`. digits: decimals, or as many as
    fit each."""
    one = len(tiles[0].grades) == 1
    legend = "" if one else _legend(scale)
    body = _dots(tiles, scale, digits) if one else _heat_maps(tiles, scale, digits)
    return (
        f'<section class="maps"><header><b>{html.escape(heading)}</b><small>{html.escape(note)}</small>{legend}</header>'
        f"{body}</section>"
    )
