"""Maps from files: a layout's TOML, or an occupancy image with its resolution, as ROS's map_server keeps them."""

import functools
import math
import os
import pathlib
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from macid import assets, cover, geometry, occupancy
from macid.documents import number, read_document, shown, shown_path
from macid.files import UsageError
from macid.layout import Layout, load_layout
from macid.registry import Kind

MAX_BOXES = 1500  # that stand for an image
_SUFFIXES = (".toml", ".yaml", ".yml")
_MOST_RUNS = 2_000_000  # of solid cells along a row, of an image that may need no merging
_YAML_BYTES = 1 << 16
_Place = Annotated[float, Meta(ge=-1e9, le=1e9)]


if TYPE_CHECKING:
    _Resolution = float
else:
    _Resolution = number("a number above 0 and of at most 100 m", gt=0, le=100)


class _Occupancy(msgspec.Struct):
    """The keys of map_server's YAML that count here; it may have others. Defaults are map_server's."""

    image: Annotated[str, Meta(min_length=1)]
    resolution: _Resolution
    origin: tuple[_Place, _Place, _Place] = (0.0, 0.0, 0.0)
    negate: bool | Literal[0, 1] = 0
    occupied_thresh: Annotated[float, Meta(gt=0, le=1)] = 0.65
    free_thresh: Annotated[float, Meta(gt=0, le=1)] = 0.196
    mode: str = "trinary"


def map_names() -> list[str]:
    """Names of the maps in assets/maps."""
    return sorted(assets.names("maps", ".toml") + assets.names("maps", ".yaml"))


def load_map(name: str) -> Layout:
    """The Layout of a map: a name of `map_names()`, a layout's .toml file, or a map_server's .yaml or .yml file.

    Raises UsageError, naming the valid choices or what is wrong in the file.
    """
    return MAPS.load(name)


def _load(name):
    """The Layout of a map that comes with the project, or of a file."""
    path = pathlib.Path(name)
    if path.suffix not in _SUFFIXES:
        suffix = ".toml" if name in assets.names("maps", ".toml") else ".yaml"
        path = assets.path("maps", f"{name}{suffix}")
    try:
        if not path.is_file():
            raise UsageError(f"There is no map file {shown_path(name)}.")
        path = path.resolve()
        return _read(path, _changed(path))
    except (OSError, UnicodeError) as error:
        raise UsageError(f"Can't read the map {shown_path(name)}: {getattr(error, 'strerror', error)}.") from None


MAPS: Kind[Layout] = Kind("map", shipped=map_names, read=_load, files=_SUFFIXES)


def map_files(name: str) -> list[pathlib.Path]:
    """The files of a map that is given as a file: it and its image; none of one of `map_names()`. Raises UsageError."""
    path = pathlib.Path(name)
    if path.suffix not in _SUFFIXES:
        return []
    found = path.stat()
    if path.suffix == ".toml":
        return [path]
    return [path, _image(path, _fields(path.resolve(), found.st_mtime_ns, found.st_size))]


def _changed(path):
    """A value that changes when the content of the map `path` or of its image does."""
    found = [path.stat()]
    if path.suffix != ".toml":
        image = _image(path, _fields(path, found[0].st_mtime_ns, found[0].st_size))
        found += [image.stat()] if image.is_file() else []
    return tuple((each.st_mtime_ns, each.st_size) for each in found)


@functools.lru_cache(16)
def _read(path, _changed):
    return load_layout(path) if path.suffix == ".toml" else load_occupancy(path)


@functools.lru_cache(16)
def _fields(path, _changed, _size):
    return read_document(path, _Occupancy, "map", _YAML_BYTES)


def _image(file, fields):
    """The image's path: beside the YAML `file`, unless it is absolute."""
    if "\0" in fields.image:
        raise UsageError(f"map {shown_path(file)}, key 'image': it must be a file's name, not {shown(fields.image)}.")
    return file.parent / fields.image


def load_occupancy(file: str | os.PathLike[str]) -> Layout:
    """The Layout of an occupancy image described by the YAML `file`: image, resolution [m], and map_server's origin,
    negate, occupied_thresh, free_thresh, mode.

    Cells that are not free are solid; what is unknown counts as solid (macid.occupancy). The frame's origin is the
    image's centre, about which the image is turned by the yaw of map_server's `origin`; the map is a square around it,
    and solid outside the image. Raises UsageError, naming what is wrong.
    """
    file = pathlib.Path(file)
    fields = read_document(file, _Occupancy, "map", _YAML_BYTES)
    mode = fields.mode.lower()
    if mode not in occupancy.MODES:
        raise UsageError(
            f"map {shown_path(file)}, key 'mode': it must be one of {', '.join(occupancy.MODES)}, not "
            f"{shown(fields.mode)}."
        )
    if not fields.free_thresh < fields.occupied_thresh:
        raise UsageError(
            f"map {shown_path(file)}, key 'free_thresh': it must be below occupied_thresh, {fields.occupied_thresh:g}, "
            f"not {fields.free_thresh:g}."
        )
    image = _image(file, fields)
    if not image.is_file():
        raise UsageError(f"map {shown_path(file)}: can't read its image {shown_path(fields.image)}: no such file.")
    try:
        solid = occupancy.solid_cells(image, mode, fields.negate, fields.free_thresh)
        size, boxes = _boxes(solid, fields.resolution, fields.origin[2])
        name = "".join(letter if letter.isprintable() else "?" for letter in file.stem)
        return Layout(size, boxes, routed=True, name=name)
    except ValueError as error:
        raise UsageError(f"map {shown_path(file)}: {error}") from None


def _boxes(solid, resolution, yaw):
    """The side [m] of a square map around the cells `solid` (rows, columns) bool, turned by `yaw` [rad] about their
    centre, and boxes (B, 5) that cover them and the square outside them."""
    if yaw == 0:
        return resolution * max(solid.shape), rectangles(solid, resolution)
    height, width = np.array(solid.shape) * resolution
    ahead, aside = abs(math.cos(yaw)), abs(math.sin(yaw))
    size = max(width * ahead + height * aside, width * aside + height * ahead)
    inside = _cell_boxes(_rectangles(solid, resolution), solid.shape, resolution)
    half = size / 2
    square = geometry.rotate(np.array([[half, half], [-half, half], [-half, -half], [half, -half]]), np.array(-yaw))
    around = []
    for axis, sign, edge in ((0, 1, width / 2), (0, -1, width / 2), (1, 1, height / 2), (1, -1, height / 2)):
        beyond = _clipped(square, axis, sign, edge)
        if len(beyond):
            low, high = beyond.min(axis=0), beyond.max(axis=0)
            around.append([*(low + high) / 2, *(high - low) / 2, 0.0])
    boxes = np.concatenate([np.reshape(around, (-1, 5)), inside])
    boxes = boxes[(boxes[:, 2:4] > 1e-9).all(axis=-1)]
    boxes[:, :2] = geometry.rotate(boxes[:, :2], np.array(yaw))
    boxes[:, 4] = geometry.wrap_angle(yaw)
    return size, boxes


def _clipped(corners, axis, sign, edge):
    """The part of the polygon `corners` (N, 2) where sign * coordinate[axis] > edge, as corners (M, 2)."""
    above = sign * corners[:, axis] - edge
    found = []
    for one, other, a, b in zip(corners, np.roll(corners, -1, axis=0), above, np.roll(above, -1), strict=True):
        if a > 0:
            found.append(one)
        if (a > 0) != (b > 0):
            found.append(one + (other - one) * a / (a - b))
    return np.reshape(found, (-1, 2))


def rectangles(solid: np.ndarray, resolution: float) -> np.ndarray:
    """Boxes (B, 5) [m] that cover the cells `solid` (rows, columns) bool, and the square around them outside them.

    The origin is the centre. Runs of cells along a row are joined with equal runs in the rows above. Where that makes
    more than MAX_BOXES, they are merged (macid.cover.merged), so that some free cells are covered, too. Raises
    ValueError where the merged boxes leave people no way, and there was one.
    """
    rows, columns = solid.shape
    side = max(rows, columns)
    square = np.ones((side, side), bool)
    top, left = (side - rows) // 2, (side - columns) // 2
    square[top : top + rows, left : left + columns] = solid
    return _cell_boxes(_rectangles(square, resolution), square.shape, resolution)


def _rectangles(solid, resolution):
    """Rows (x0, x1, y0, y1) of at most MAX_BOXES rectangles that cover the cells `solid`, in cells."""
    needed = cover.runs(solid)
    if needed <= _MOST_RUNS:
        found = cover.exact(solid)
        if len(found) <= MAX_BOXES:
            return found
        needed = len(found)
    merged = cover.merged(solid, resolution, MAX_BOXES)
    if not cover.leaves_room(solid, merged, resolution):
        raise ValueError(
            f"its image needs {needed:,} boxes; merged into the {MAX_BOXES:,} that are possible, they leave nobody "
            "room to go. Smooth it, or lower its resolution."
        )
    return merged


def _cell_boxes(found, shape, resolution):
    """Boxes (B, 5) [m] of rectangles in cells (macid.cover) of a grid of `shape` (rows, columns), from its centre."""
    x0, x1, y0, y1 = np.array(found, float).reshape(-1, 4).T * resolution
    half_y, half_x = np.array(shape) * resolution / 2
    return np.stack([(x0 + x1) / 2 - half_x, (y0 + y1) / 2 - half_y, (x1 - x0) / 2, (y1 - y0) / 2, 0 * x0], axis=-1)
