"""Maps from files: a layout's TOML, or an occupancy image with its resolution, as ROS's map_server keeps them."""

import functools
import pathlib

import numpy as np

from macid import assets
from macid.layout import Layout, load_layout

MAX_BOXES = 1500  # that an image may need
_THRESHOLDS = {"occupied_thresh": 0.65, "free_thresh": 0.196}  # map_server's own


def map_names():
    """Names of the maps in assets/maps."""
    return sorted(assets.names("maps", ".toml") + assets.names("maps", ".yaml"))


def load_map(name):
    """The Layout of a map: a name of `map_names()`, a layout's .toml file, or a map_server's .yaml file.

    Raises ValueError, naming the valid choices or what is wrong in the file.
    """
    path = pathlib.Path(name)
    if path.suffix not in (".toml", ".yaml"):
        if name not in map_names():
            raise ValueError(f"Unknown map '{name}'. Choose one of {', '.join(map_names())}, or a .toml or .yaml file.")
        suffix = ".toml" if name in assets.names("maps", ".toml") else ".yaml"
        path = assets.path("maps", f"{name}{suffix}")
    if not path.is_file():
        raise ValueError(f"There is no map file '{name}'.")
    return _read(path.resolve(), path.stat().st_mtime_ns)


@functools.lru_cache(16)
def _read(path, _changed):
    return load_layout(path) if path.suffix == ".toml" else load_occupancy(path)


def load_occupancy(file):
    """The Layout of an occupancy image described by the YAML `file`: image, resolution [m], and map_server's origin,
    negate, occupied_thresh, free_thresh.

    Cells that are not free are solid; what is unknown counts as solid. The frame's origin is the image's centre; an
    image that is no square is filled up. Raises ValueError, naming what is wrong.
    """
    import cv2
    import yaml

    file = pathlib.Path(file)
    try:
        fields = yaml.safe_load(file.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{file} is not YAML: {' '.join(str(error).split())}.") from None
    if not isinstance(fields, dict) or not {"image", "resolution"} <= set(fields):
        raise ValueError(f"{file}: a map needs 'image' and 'resolution' [m].")
    if fields.get("mode", "trinary") != "trinary":
        raise ValueError(f"{file}: mode must be 'trinary', not {fields['mode']!r}.")
    numbers = {"resolution": fields["resolution"], **{k: fields.get(k, v) for k, v in _THRESHOLDS.items()}}
    for key, value in numbers.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < np.inf:
            raise ValueError(f"{file}: {key} must be a number above 0, not {value!r}.")
    if not numbers["free_thresh"] < numbers["occupied_thresh"] <= 1:
        raise ValueError(f"{file}: free_thresh must be below occupied_thresh, and that at most 1.")
    if fields.get("negate", 0) not in (0, 1):
        raise ValueError(f"{file}: negate must be 0 or 1, not {fields['negate']!r}.")
    origin = fields.get("origin", [0, 0, 0])
    good = isinstance(origin, list) and len(origin) == 3 and all(isinstance(x, (int, float)) for x in origin)
    if not good or not np.isfinite(origin).all() or origin[2] != 0:
        raise ValueError(f"{file}: origin must be [x, y, 0] (a turned map is not supported), not {origin!r}.")
    picture = cv2.imread(str(file.parent / str(fields["image"])), cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise ValueError(f"{file}: can't read its image '{fields['image']}'.")
    shade = picture.astype(float) / 255.0
    occupancy = shade if fields.get("negate") else 1.0 - shade
    solid = np.flipud(occupancy >= numbers["free_thresh"])  # row 0 is the lowest
    return Layout(
        numbers["resolution"] * max(solid.shape),
        rectangles(solid, numbers["resolution"]),
        routed=True,
        name=file.stem,
    )


def rectangles(solid, resolution):
    """Boxes (B, 5) [m] that cover the cells `solid` (rows, columns) bool, and what a square around them has more.

    The origin is the centre. Runs of cells along a row are joined with equal runs in the rows above. Raises ValueError
    for more than MAX_BOXES.
    """
    rows, columns = solid.shape
    side = max(rows, columns)
    square = np.ones((side, side), bool)
    top, left = (side - rows) // 2, (side - columns) // 2
    square[top : top + rows, left : left + columns] = solid
    edges = np.diff(np.pad(square.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    open_runs, found = {}, []
    for row in range(side + 1):
        runs = []
        if row < side:
            runs = list(zip(np.flatnonzero(edges[row] == 1), np.flatnonzero(edges[row] == -1), strict=True))
        for run in [run for run in open_runs if run not in runs]:
            found.append((*run, open_runs.pop(run), row))
        for run in runs:
            open_runs.setdefault(run, row)
    if len(found) > MAX_BOXES:
        raise ValueError(
            f"The image needs {len(found)} boxes, more than {MAX_BOXES}: smooth it or lower its resolution."
        )
    x0, x1, y0, y1 = np.array(found, float).reshape(-1, 4).T * resolution
    half = side * resolution / 2
    return np.stack([(x0 + x1) / 2 - half, (y0 + y1) / 2 - half, (x1 - x0) / 2, (y1 - y0) / 2, 0 * x0], axis=-1)
