"""Files of people's walks: recognised by their SHA-256 or their form, read, and checked.

Forms of text, one sample a line:

| form | columns | units |
|---|---|---|
| `eth` | frame, id, x, z, y, vx, vz, vy | metres; 6 frames are 0.4 s |
| `ucy` | frame, id, x, y | metres; 10 frames are 0.4 s |
| `juelich` | id, frame, x, y and mostly z | as comments say (`# framerate:`, `x/m`), else centimetres, 16 frames/s |
| `csv` | id, t, x, y, named in the first line | seconds, metres |

PedPy writes and reads the form `juelich`. Walks are put on one grid of times, as each annotator's clock began anew.
"""

import dataclasses
import hashlib
import itertools
import os
import pathlib
import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from macid.documents import read_bytes
from macid.files import UsageError, named

MOST_BYTES = 1 << 28  # of a file
OPEN_PERIOD = 0.4  # of the grid of times of an open scene [s]
LAB_PERIOD = 0.1  # and of a laboratory's [s]
ETH_FRAMES, UCY_FRAMES = 15.0, 25.0  # frames a second: 6 and 10 are 0.4 s
LAB_FRAMES = 16.0  # frames a second
SPEEDS = (0.2, 2.2)  # the mean speed of people's walks lies between [m/s]
MOST_SPEED = 8.0  # of one person between two samples [m/s]
LONGEST_GAP = 2.0  # a person who is not seen for longer comes back as another [s]
ENDINGS = (".txt", ".csv", ".dat")
_MOST_SAMPLES = 10_000_000
_MOST_GRID = 50_000_000  # places of a grid: times x people


class Bottleneck(NamedTuple):
    """A corridor of the lab's that people walk down, towards smaller y, to an exit. Metres."""

    width: float  #: of the corridor, x from 0
    exit: float  #: of the exit, in the corridor's middle
    exit_y: float  #: where it is
    entrance_y: float  #: where the corridor begins


class TwoWays(NamedTuple):
    """A corridor of the lab's that people walk along from both ends. Metres."""

    width: float  #: of the corridor, x from 0
    half: float  #: it lies between y = -half and half


@dataclasses.dataclass(frozen=True)
class Known:
    """A file that is recognised by its SHA-256."""

    name: str
    title: str
    source: str
    licence: str
    form: str
    scene: str  # "open", "one way" or "two ways"
    place: Bottleneck | TwoWays | None = None


_BIWI = (
    "Pellegrini, Ess, Schindler, van Gool: You'll never walk alone, ICCV 2009 (BIWI)",
    "for research, with citation; nothing is said of redistribution",
)
_UCY = (
    "Lerner, Chrysanthou, Lischinski: Crowds by example, Eurographics 2007 (University of Cyprus)",
    "free to use with credit; nothing is said of redistribution",
)
_HERMES = "Forschungszentrum Juelich, Pedestrian Dynamics Data Archive, HERMES 2009"
_ONE_WAY = (f"{_HERMES}, unidirectional, DOI 10.34735/ped.2009.14", "said to be CC BY 4.0, unconfirmed")
_TWO_WAYS = (f"{_HERMES}, bidirectional", "said to be CC BY 4.0, unconfirmed")


def _one_way(entrance, width, exit_width):
    name = f"uo-{entrance:03d}-{width:03d}-{exit_width:03d}"
    title = f"one way: entrance {entrance / 100:g} m, corridor {width / 100:g} m, exit {exit_width / 100:g} m"
    return Known(name, title, *_ONE_WAY, "juelich", "one way", Bottleneck(width / 100, exit_width / 100, -4.0, 4.0))


def _two_ways(width, left, right):
    name = f"bo-{width:03d}-{left:03d}-{right:03d}"
    title = f"two ways in {width / 100:g} m, entrances {left / 100:g} and {right / 100:g} m"
    return Known(name, title, *_TWO_WAYS, "juelich", "two ways", TwoWays(width / 100, 4.0))


#: {SHA-256: the file}.
KNOWN = {
    "d452ae2185ecb1164c2fdf31e75f6236f4c2ffc02c751a6b2ae921740cbc60d1": Known(
        "eth", "BIWI ETH: before a university's door", *_BIWI, "eth", "open"
    ),
    "9caa771bb9153d6b809dd0916b6f86761b641e6bbb15e766c1de3133fbbb7fcf": Known(
        "hotel", "BIWI Hotel: a pavement with a tram stop", *_BIWI, "ucy", "open"
    ),
    "1147a1962a09abfb86f28c6cddcac862e095a0cf129b3016385b69eacdd09d85": Known(
        "zara01", "UCY Zara 1: a shopping street", *_UCY, "ucy", "open"
    ),
    "8a649d0f8c9ae75c87c4d23a85f892786b0aa30266e996c7be03e69dafff22ff": Known(
        "zara02", "UCY Zara 2: a shopping street", *_UCY, "ucy", "open"
    ),
    "e25798b660634330aa89f8bb259425de720e84d0873902726c1d1f4ccff21d6c": Known(
        "students03", "UCY Students 3: a university's yard", *_UCY, "ucy", "open"
    ),
    "a9bf49f9ca11b4953b4a16f0103523cc719c1d86e209149b5e4a402148ba2101": _one_way(50, 180, 180),
    "b81717c3f6fb9d0964878a877fd4187bf6061ceb640ae17c1767efc095dbd75b": _one_way(180, 180, 120),
    "e2e00a6c1698bc09066c600a1828a6637d09eaa00353936a2f1451252beaa24b": _one_way(180, 180, 180),
    "0451beffbf9cd4d9380304792fadf8a69bfd22c9fd535642cbcfa469f5d57d77": _one_way(300, 300, 200),
    "2204d4717d6be01f5ee4dbe65dd67d88ef71e5eb3024fa1998037fe9ff8e9081": _two_ways(360, 50, 50),
    "41f960a0f7b4178c133bc7af9c709be9b3412072d797e6d7850e49d1ed55d485": _two_ways(360, 90, 90),
    "6df7e394a7adad362c9371d2ec48c90ba8acbaaac43d11eb642a737115fc0f22": _two_ways(360, 160, 160),
}


_LAB_NAME = re.compile(r"(uo|bo)-(\d{3})-(\d{3})-(\d{3})(?!\d)")


def named_by_lab(name: str) -> Known | None:
    """What a file of HERMES is whose `name` says its corridor (uo-180-180-070, bo-360-120-120) but whose SHA-256 is
    not known; None for other names."""
    found = _LAB_NAME.search(name)
    if not found:
        return None
    widths = [int(width) for width in found.groups()[1:]]
    known = _one_way(*widths) if found[1] == "uo" else _two_ways(*widths)
    return dataclasses.replace(known, title=f"{known.title}; by its name, its SHA-256 is not known")


@dataclasses.dataclass(frozen=True)
class Walks:
    """The walks of K people on a grid of T times."""

    name: str
    period: float  # of the grid [s]
    position: np.ndarray  # (T, K, 2) [m], NaN where a person is not there
    source: Known | None = None
    frames: float | None = None  # a second, as the file has them; None where the file has seconds
    known: bool = False  # whether its SHA-256 is

    @property
    def scene(self) -> str:
        """ "open", "one way" or "two ways"; a file that is not known is an open scene."""
        return "open" if self.source is None else self.source.scene

    @property
    def duration(self) -> float:
        """[s]"""
        return (len(self.position) - 1) * self.period


def on_grid(person: np.ndarray, time: np.ndarray, place: np.ndarray, period: float) -> np.ndarray:
    """Samples of `person` (N,) at `time` (N,) [s] at `place` (N, 2) [m] on one grid of times: (T, K, 2) [m], NaN where
    somebody is not there.

    The grid begins with the first sample; places between samples are interpolated; a person who is missing for longer
    than LONGEST_GAP comes back as another. Raises ValueError where the grid would be too large.
    """
    order = np.lexsort((time, person))
    person, time, place = person[order], np.asarray(time, float)[order], np.asarray(place, float)[order]
    new = np.ones(len(person), bool)
    new[1:] = (person[1:] != person[:-1]) | (np.diff(time) > LONGEST_GAP)
    bounds = [*np.flatnonzero(new), len(person)]
    first = time.min()
    size = int(np.floor((time.max() - first) / period + 1e-6)) + 1
    if size * (len(bounds) - 1) > _MOST_GRID:
        raise ValueError(
            f"{len(bounds) - 1:,} people over {time.max() - first:,.0f} s are too many for one recording; divide it"
        )
    found = np.full((size, len(bounds) - 1, 2), np.nan)
    for who, (begin, end) in enumerate(itertools.pairwise(bounds)):
        own, where = time[begin:end] - first, place[begin:end]
        steps = np.arange(int(np.ceil(own[0] / period - 1e-6)), int(np.floor(own[-1] / period + 1e-6)) + 1)
        for axis in (0, 1):
            found[steps, who, axis] = np.interp(steps * period, own, where[:, axis])
    return found[:, ~np.isnan(found[..., 0]).all(axis=0)]


def load(path: str | os.PathLike[str]) -> Walks:
    """The walks in the file `path`. Raises UsageError, a line with file, line and reason, where it holds none."""
    content = read_bytes(path, "trajectory", MOST_BYTES)
    source = KNOWN.get(hashlib.sha256(content).hexdigest())
    known = source is not None
    lines = _Lines(path, content)
    form = source.form if source else lines.form()
    person, time, place, frames = _READERS[form](lines)
    _check(lines, person, time, place)
    period = OPEN_PERIOD if form in ("eth", "ucy") else LAB_PERIOD
    if form == "csv":
        period = OPEN_PERIOD if np.median(_steps(person, time)) > 0.25 else LAB_PERIOD
    if source is None and form == "juelich":
        source = named_by_lab(pathlib.Path(path).stem)
    try:
        position = on_grid(person, time, place, period)
    except ValueError as error:
        raise UsageError(f"{named(path)}: {error}.") from None
    return Walks(source.name if source else pathlib.Path(path).stem, period, position, source, frames, known)


def files(folder: str | os.PathLike[str]) -> list[pathlib.Path]:
    """The files under `folder` (or `folder` itself, where it is one) that can hold walks, sorted. Raises UsageError
    where there is none."""
    folder = pathlib.Path(folder)
    if folder.is_file():
        return [folder]
    if not folder.is_dir():
        raise UsageError(f"--data: there is no folder or file {named(folder)}.")
    found = sorted(path for path in folder.rglob("*") if path.suffix.lower() in ENDINGS and path.is_file())
    if not found:
        raise UsageError(f"--data: {named(folder)} has no file that ends in {', '.join(ENDINGS)}.")
    return found


def load_all(folder: str | os.PathLike[str]) -> Iterator[Walks]:
    """The walks of all `files` of `folder`, one after the other. Raises UsageError at the first bad file."""
    for path in files(folder):
        yield load(path)


class _Lines:
    """The samples of a text: its rows of numbers, and on which line each stands."""

    def __init__(self, path, content):
        self.path = path
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            self._refuse(content[: error.start].count(b"\n") + 1, "this is no text")
        lines = text.splitlines()
        self.comments = [line for line in lines if line.lstrip().startswith("#")]
        filled = [number for number, line in enumerate(lines) if line.strip() and not line.lstrip().startswith("#")]
        if not filled:
            raise UsageError(f"{named(path)}: no samples in it.")
        first = re.split(r"[\s,;]+", lines[filled[0]].strip().lower())
        self.header = first if any(re.match(r"[a-z]", word) and word not in ("nan", "inf") for word in first) else None
        filled = filled[1:] if self.header else filled
        if not filled:
            raise UsageError(f"{named(path)}: no samples in it.")
        if len(filled) > _MOST_SAMPLES:
            raise UsageError(f"{named(path)}: {len(filled):,} samples; at most {_MOST_SAMPLES:,} are read.")
        self.number = np.array(filled) + 1
        rows = [lines[number].replace(",", " ").replace(";", " ").split() for number in filled]
        try:
            self.rows = np.array(rows, dtype=float)
        except ValueError:
            self._refuse_one_of(rows)
        if not np.isfinite(self.rows).all():
            row, column = np.argwhere(~np.isfinite(self.rows))[0]
            self.refuse(row, f"column {column + 1} is not finite")

    def _refuse_one_of(self, rows):
        for row, words in enumerate(rows):
            if len(words) != len(rows[0]):
                self.refuse(row, f"{len(words)} columns; the first sample has {len(rows[0])}")
            for word in words:
                try:
                    float(word)
                except ValueError:
                    self.refuse(row, f"'{word[:40]}' is no number")
        raise AssertionError  # one of them is bad

    def refuse(self, row, reason):
        """Raises UsageError for sample `row`."""
        self._refuse(self.number[row], reason)

    def _refuse(self, line, reason):
        raise UsageError(f"{named(self.path)}, line {line}: {reason}.")

    def form(self):
        """The form of the text. Raises UsageError where it is none."""
        columns = self.rows.shape[1]
        if self.header and {"id", "t", "x", "y"} <= set(self.header):
            return "csv"
        if columns == 8:
            return "eth"
        says = " ".join(self.comments).lower()
        if columns == 5 or (columns == 4 and (self.comments and re.search(r"framerate|x/c?m", says))):
            return "juelich"
        if columns == 4:  # annotators of open scenes go from every 6th or 10th frame to the next
            return "ucy" if np.gcd.reduce(np.diff(np.unique(self.rows[:, 0])).astype(int)) > 1 else "juelich"
        self.refuse(
            0,
            f"{columns} columns: neither ETH's 8, nor UCY's 4 (frame, id, x, y), nor Juelich's 4 or 5 (id, frame, x, "
            "y, z), nor a csv whose first line names id, t, x and y",
        )
        return None


def _whole(lines, column, what):
    values = lines.rows[:, column]
    if (bad := np.flatnonzero(values != np.round(values))).size:
        lines.refuse(bad[0], f"{what} {values[bad[0]]:g} is no whole number")
    return values


def _eth(lines):
    frame, person = _whole(lines, 0, "frame"), _whole(lines, 1, "id")
    return person, frame / ETH_FRAMES, lines.rows[:, [2, 4]], ETH_FRAMES


def _ucy(lines):
    frame, person = _whole(lines, 0, "frame"), _whole(lines, 1, "id")
    return person, frame / UCY_FRAMES, lines.rows[:, 2:4], UCY_FRAMES


def _juelich(lines):
    says = " ".join(lines.comments)
    rate = re.search(r"framerate:?\s*([0-9.]+)", says)
    frames = float(rate[1]) if rate and float(rate[1]) > 0 else LAB_FRAMES
    unit = 1.0 if re.search(r"x\s*[/\[]\s*m\b|in m\b", says) else 0.01
    person, frame = _whole(lines, 0, "id"), _whole(lines, 1, "frame")
    return person, frame / frames, lines.rows[:, 2:4] * unit, frames


def _csv(lines):
    at = [lines.header.index(name) for name in ("id", "t", "x", "y")]
    if lines.rows.shape[1] != len(lines.header):
        lines.refuse(0, f"{lines.rows.shape[1]} columns; the first line names {len(lines.header)}")
    return _whole(lines, at[0], "id"), lines.rows[:, at[1]], lines.rows[:, at[2:]], None


_READERS = {"eth": _eth, "ucy": _ucy, "juelich": _juelich, "csv": _csv}


def _steps(person, time):
    """Times between the samples of one person [s]."""
    order = np.lexsort((time, person))
    same = np.diff(person[order]) == 0
    return np.diff(time[order])[same]


def _check(lines, person, time, place):
    """Raises UsageError where samples can't be people's walks in metres and seconds."""
    order = np.lexsort((time, person))
    same = np.diff(person[order]) == 0
    if not same.any():
        raise UsageError(f"{named(lines.path)}: nobody has two samples.")
    steps, ways = np.diff(time[order])[same], np.linalg.norm(np.diff(place[order], axis=0), axis=-1)[same]
    later = order[1:][same]
    if (bad := np.flatnonzero(steps <= 0)).size:
        row = max(later[bad[0]], order[:-1][same][bad[0]])
        lines.refuse(row, f"person {person[row]:g} has a second sample of one time")
    jumps = (ways / steps > MOST_SPEED) & (ways > 1.0)
    ordinary = ~jumps if jumps.mean() < 0.05 else np.ones_like(jumps)  # a few are faults, many are wrong units
    speed = ways[ordinary].sum() / steps[ordinary].sum()
    if not SPEEDS[0] <= speed <= SPEEDS[1]:
        raise UsageError(f"{named(lines.path)}: {_doubt(speed)}")
    if (bad := np.flatnonzero(jumps)).size:
        row = later[bad[0]]
        lines.refuse(row, f"person {person[row]:g} walks {ways[bad[0]]:.1f} m in {steps[bad[0]]:.2g} s")


def _doubt(speed):
    """What a mean speed [m/s] that nobody walks at comes from."""
    told = f"people walk at {speed:.2f} m/s on average, not {SPEEDS[0]:g} to {SPEEDS[1]:g}"
    if speed > 20.0:
        return f"{told}: are these centimetres? This form is read in metres."
    if speed > SPEEDS[1]:
        return (
            f"{told}: is this BIWI ETH with 10 frames as 0.4 s? It gives 2.49 m/s; in ETH 6 frames are 0.4 s "
            "(take its obsmat.txt)."
        )
    return f"{told}: are these metres? Form juelich is read in centimetres unless a comment says x/m."
