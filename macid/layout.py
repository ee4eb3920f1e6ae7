"""Maps: outer walls and oriented boxes on a square, and where people can stand on them.

The origin is the centre of the map. A layout is frozen; whatever is drawn comes from a `numpy.random.Generator`.
"""

import dataclasses
import functools
import numbers
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike

from macid import assets, geometry
from macid.documents import number, read_document, shown_path
from macid.files import UsageError
from macid.routing import NoFreeSpace, refuse_blocked_routes
from macid.state import RADIUS

MAP_SIZE = 50.0  # side of the paper's maps [m]
MAX_PERSON_DENSITY = 0.08  # persons per m2 at pedestrian density 1: 200 on 50 x 50 m, the paper's Lv.4
WALL_THICKNESS = 0.3  # [m]
CORRIDOR = 5.0  # side of a maze's cell [m]
GOAL_DISTANCE = (8.0, 24.0)  # between a pedestrian's start and goal [m]
REGIONS = ("robot_start", "robot_goal", "people_start", "people_goal")
_BOX_ROW = ", ".join(geometry.BOX_COLUMNS)
_TRIES = 300
_LEAST_HALF = 1e-4  # least half side of a box that MuJoCo can touch [m]

LEVELS = (1, 2, 3, 4)
VALIDATION_LEVELS = ("v1", "v2", "v3", "v4")  # as many people as LEVELS, on other maps: settings are chosen on these
OTHER_LEVELS = ("big-boxes", "small-boxes", "foyer", "crossroads", "furnished", "crowded")  # maps of other kinds


@dataclasses.dataclass(frozen=True)
class Layout:
    """A square map.

    size: side [m]. obstacles: (B, 5) rows of `geometry.BOX_COLUMNS`, without the outer walls. routed: whether people
    need waypoints to find their way (mazes). pedestrians: how many people a level has, or None. regions: where robots
    and people begin and go, {name of REGIONS: boxes (N, 5)}; anywhere where a name is missing. routes: of each route
    the waypoints (W, 2) [m] that pedestrians walk to and fro along; person p takes route p modulo the number of routes.
    """

    size: float
    obstacles: np.ndarray
    routed: bool = False
    pedestrians: int | None = None
    name: str = "layout"
    regions: dict = dataclasses.field(default_factory=dict)
    routes: tuple = ()

    def __post_init__(self):
        if not isinstance(self.size, numbers.Real) or not 0 < self.size < np.inf:
            raise ValueError(f"A layout's size must be positive, not {self.size!r}.")
        if self.pedestrians is not None and self.pedestrians < 0:
            raise ValueError(f"Layout '{self.name}': pedestrians must be at least 0, not {self.pedestrians}.")
        object.__setattr__(self, "obstacles", self._boxes("obstacles", self.obstacles))
        if unknown := sorted(set(self.regions) - set(REGIONS)):
            raise ValueError(f"Layout '{self.name}': unknown region '{unknown[0]}'. Choose among {', '.join(REGIONS)}.")
        regions = {name: self._boxes(f"region {name}", rows) for name, rows in self.regions.items()}
        if empty := [name for name, rows in regions.items() if not len(rows)]:
            raise ValueError(f"Layout '{self.name}': region {empty[0]} has no box; leave it out for anywhere.")
        object.__setattr__(self, "regions", regions)
        routes = []
        for route in self.routes:
            points = _numbers(route)
            inside = points.ndim == 2 and points.shape[1] == 2 and len(points) > 1
            if not (inside and np.isfinite(points).all() and (np.abs(points) <= self.size / 2).all()):
                raise ValueError(f"Layout '{self.name}': a route needs two or more points (x, y) on the map.")
            points.flags.writeable = False
            routes.append(points)
        object.__setattr__(self, "routes", tuple(routes))
        if routes:
            refuse_blocked_routes(self)

    def _boxes(self, what, rows):
        """`rows` as an array (N, 5) of its own, checked."""
        boxes = _numbers(rows)
        if boxes.shape == (0,):
            boxes = boxes.reshape(0, len(geometry.BOX_COLUMNS))
        shaped = boxes.ndim == 2 and boxes.shape[1] == len(geometry.BOX_COLUMNS)
        if not (shaped and np.isfinite(boxes).all() and (boxes[:, 2:4] >= _LEAST_HALF).all()):
            raise ValueError(
                f"Layout '{self.name}': {what} must be finite rows {_BOX_ROW}, halves above 0, of at least "
                f"{_LEAST_HALF:g}."
            )
        boxes.flags.writeable = False
        return boxes

    @property
    def people(self) -> int:
        """How many people a level has. Raises ValueError for a layout that leaves that open."""
        if self.pedestrians is None:
            raise ValueError(f"Layout '{self.name}' does not say how many pedestrians it has.")
        return self.pedestrians

    @property
    def boxes(self) -> np.ndarray:
        """Outer walls, then obstacles: (4 + B, 5)."""
        return np.concatenate([outer_walls(self.size), self.obstacles])


def outer_walls(size: float) -> np.ndarray:
    """The four walls around a map of side `size` [m]: (4, 5). Their inner faces are the map's edge."""
    far, half, thin = size / 2 + WALL_THICKNESS / 2, size / 2 + WALL_THICKNESS, WALL_THICKNESS / 2
    return np.array(
        [[far, 0, thin, half, 0], [-far, 0, thin, half, 0], [0, far, half, thin, 0], [0, -far, half, thin, 0]]
    )


def person_count(density: float, size: float) -> int:
    """How many pedestrians a share `density` in [0, 1] of MAX_PERSON_DENSITY is on a map of side `size` [m]."""
    if not 0 <= density <= 1:
        raise ValueError(f"pedestrian_density must be between 0 and 1, not {density}.")
    return round(density * MAX_PERSON_DENSITY * size**2)


def random_layout(
    rng: np.random.Generator,
    number: int,
    size: float = MAP_SIZE,
    passage: float = 1.6,
    name: str = "random",
    half: tuple[float, float] = (0.5, 2.0),
) -> Layout:
    """`number` boxes at any yaw, at least `passage` [m] from each other and from the walls. half: the range of half a
    box's sides [m].

    Raises NoFreeSpace when they don't fit.
    """
    boxes = outer_walls(size)
    for _ in range(number):
        for _ in range(_TRIES):
            halves = rng.uniform(*half, 2)
            centre = rng.uniform(-size / 2, size / 2, 2)
            box = np.array([*centre, *halves, rng.uniform(-np.pi / 2, np.pi / 2)])
            if geometry.box_box_gap(box, boxes).min() >= passage:
                boxes = np.concatenate([boxes, box[None]])
                break
        else:
            raise NoFreeSpace(f"Only {len(boxes) - 4} of {number} obstacles fit on {size:g} x {size:g} m.")
    return Layout(size, boxes[4:], name=name)


def maze_layout(rng: np.random.Generator, density: float, size: float = MAP_SIZE) -> Layout:
    """A maze-like map: the first share `density` in [0, 1] of the walls of a spanning-tree maze, in a seeded order.

    The cells of a grid are joined by a random spanning tree (Kruskal); walls stand between cells that the tree does
    not join, so that every density leaves the map connected, 0 leaves it open, and a lower density has a subset of
    the walls of a higher one from the same seed.
    """
    if not 0 <= density <= 1:
        raise ValueError(f"obstacle_density must be between 0 and 1, not {density}.")
    cells = max(1, round(size / CORRIDOR))
    side = size / cells
    edges = [((i, j), (i + 1, j)) for i in range(cells - 1) for j in range(cells)]
    edges += [((i, j), (i, j + 1)) for i in range(cells) for j in range(cells - 1)]
    group = {(i, j): (i, j) for i in range(cells) for j in range(cells)}

    def root(cell):
        while group[cell] != cell:
            cell = group[cell]
        return cell

    walls = []
    for index in rng.permutation(len(edges)):
        (i, j), other = edges[index]
        a, b = root((i, j)), root(other)
        if a != b:
            group[a] = b
            continue
        vertical = other[0] == i + 1  # the wall between neighbours along x runs along y
        x = -size / 2 + (i + 1 if vertical else i + 0.5) * side
        y = -size / 2 + (j + 0.5 if vertical else j + 1) * side
        walls.append([x, y, (side + WALL_THICKNESS) / 2, WALL_THICKNESS / 2, np.pi / 2 if vertical else 0.0])
    shown = walls[: round(density * len(walls))]
    return Layout(size, np.reshape(shown, (-1, 5)), routed=bool(shown), name=f"maze-{density:g}")


def max_maze_walls(size: float) -> int:
    """The number of walls of a full maze on a map of side `size` [m]: interior edges that a spanning tree leaves."""
    cells = max(1, round(size / CORRIDOR))
    return 2 * cells * (cells - 1) - (cells**2 - 1)


_Coordinate = Annotated[float, Meta(ge=-1e4, le=1e4)]
_MOST_ROWS = 5000


def _rows(*columns: str) -> Meta:
    words = f"a list of rows {', '.join(columns)}, at most {_MOST_ROWS}, each number from -1e4 to 1e4"
    return Meta(max_length=_MOST_ROWS, description=words)


_Boxes = Annotated[list[list[_Coordinate]], _rows(*geometry.BOX_COLUMNS)]
_Route = Annotated[list[list[_Coordinate]], Meta(max_length=200)]
_Routes = Annotated[
    list[_Route],
    Meta(max_length=100, description="a list of routes, at most 100, each a list of points (x, y), at most 200"),
]
_Regions = Annotated[
    dict[str, _Boxes], Meta(description=f"a table of {', '.join(REGIONS)}, each a list of rows {_BOX_ROW}")
]


if TYPE_CHECKING:
    _Size = float
else:
    _Size = number("a number [m] above 0 and of at most 1000", gt=0, le=1000)


class _File(msgspec.Struct, forbid_unknown_fields=True):
    """The keys of a layout file."""

    size: _Size
    name: Annotated[str, Meta(min_length=1, max_length=100, description="a text of 1 to 100 characters")] = "layout"
    obstacles: _Boxes = []
    walls: Annotated[list[list[_Coordinate]], _rows("x0", "y0", "x1", "y1")] = []
    regions: _Regions = {}
    routes: _Routes = []
    routed: bool | None = None
    pedestrians: Annotated[int, Meta(ge=0, le=2000, description="a whole number from 0 to 2000")] | None = None


def load_layout(file: str | os.PathLike[str]) -> Layout:
    """A layout from a TOML file with `size` and any of `obstacles` (rows of BOX_COLUMNS), `walls` (rows x0, y0, x1, y1
    of walls 0.3 m thick), `regions` (a table of REGIONS, each rows of BOX_COLUMNS), `routes` (each a list of points),
    `name`, `routed` (default: whether there are walls), `pedestrians`. Raises UsageError, naming what is wrong."""
    fields = read_document(file, _File, "map")
    try:
        if not fields.name.isprintable():
            raise ValueError("name must be printable text")
        return Layout(
            fields.size,
            _numbers([*fields.obstacles, *map(wall_box, fields.walls)]),
            routed=bool(fields.walls) if fields.routed is None else fields.routed,
            pedestrians=fields.pedestrians,
            name=fields.name,
            regions=fields.regions,
            routes=tuple(fields.routes),
        )
    except ValueError as error:
        raise UsageError(f"map {shown_path(file)}: {error}") from None


def wall_box(wall: ArrayLike) -> np.ndarray:
    """The box (5,) of a wall (x0, y0, x1, y1) [m], WALL_THICKNESS thick, its ends half of that longer."""
    ends = _numbers(wall)
    if ends.shape != (4,) or not np.isfinite(ends).all():
        raise ValueError(f"a wall is four numbers x0, y0, x1, y1, not {wall!r}.")
    x0, y0, x1, y1 = ends
    half = (np.hypot(x1 - x0, y1 - y0) + WALL_THICKNESS) / 2
    return np.array([(x0 + x1) / 2, (y0 + y1) / 2, half, WALL_THICKNESS / 2, np.arctan2(y1 - y0, x1 - x0)])


def _numbers(rows):
    """`rows` as an array of floats of its own: one NaN without axes where they are ragged or no numbers."""
    try:
        array = np.array(rows)  # a copy: the caller's array stays the caller's
    except ValueError:
        return np.array(np.nan)
    return array.astype(float) if array.dtype.kind in "iuf" else np.array(np.nan)


def load_level(level: int | str) -> Layout:
    """A level, frozen in assets/layouts. Raises ValueError, naming the valid ones.

    1 to 4: the paper's, 25, 50, 100 or 200 people on 50 x 50 m; "v1" to "v4": as many on maps for validation; a name of
    OTHER_LEVELS: a map of another kind.
    """
    levels = LEVELS + VALIDATION_LEVELS + OTHER_LEVELS
    if level not in levels:
        raise ValueError(f"Unknown level {level!r}. Choose one of {', '.join(map(str, levels))}.")
    return load_layout(assets.path("layouts", f"lv{level}.toml" if level in LEVELS else f"{level}.toml"))


def clearance(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Distance [m] from `points` (..., 2) to the nearest of `boxes` (B, 5): (...)."""
    return geometry.point_box_distance(points, boxes).min(axis=-1)


def _draw(rng, number, half, region):
    """`number` places (number, 2), uniform over the square of half a side `half` [m], or over the boxes `region`."""
    if region is None:
        return rng.uniform(-half, half, (number, 2))
    area = region[:, 2] * region[:, 3]
    box = region[rng.choice(len(region), number, p=area / area.sum())]
    return box[:, :2] + geometry.rotate(rng.uniform(-1.0, 1.0, (number, 2)) * box[:, 2:4], box[:, 4])


def most_clearance(layout: Layout, region: np.ndarray | None = None) -> float:
    """The greatest distance from obstacles [m] that a person's centre can have on `layout`, in the boxes `region` (N,
    5) if given, to about a centimetre; 0 where there is no place."""
    region = np.array([[0.0, 0.0, layout.size / 2, layout.size / 2, 0.0]]) if region is None else region
    return _most_clearance(layout.size, layout.obstacles.tobytes(), region.tobytes())


@functools.lru_cache(16)  # it is asked again and again
def _most_clearance(size, obstacles, region):
    boxes = np.concatenate([outer_walls(size), np.frombuffer(obstacles).reshape(-1, 5)])
    region = np.frombuffer(region).reshape(-1, 5)[:100]
    best = 0.0
    for x, y, half_x, half_y, yaw in region:
        low, high = -np.array([half_x, half_y]), np.array([half_x, half_y])
        for level in range(4):  # around the best place so far, ever more closely
            number = [15, 15] if level else np.clip(15 * (high - low), 3, 121).astype(int)
            spans = [np.linspace(*ends) for ends in zip(low, high, number, strict=True)]
            local = np.stack(np.meshgrid(*spans), axis=-1).reshape(-1, 2)
            places = np.array([x, y]) + geometry.rotate(local, np.array(yaw))
            parts = np.array_split(places, 1 + len(places) * len(boxes) // 1_000_000)
            room = np.concatenate([clearance(part, boxes) for part in parts if len(part)])
            room = np.where((np.abs(places) < size / 2).all(axis=-1), room, 0.0)
            best = max(best, float(room.max()))
            step = np.array([span[1] - span[0] for span in spans])
            middle = local[room.argmax()]
            low = np.maximum(middle - 2 * step, [-half_x, -half_y])
            high = np.minimum(middle + 2 * step, [half_x, half_y])
    return best


def _no_room(layout, region, name):
    """Words for a message: where no place was found, on the layout or in its `region`, which messages call `name`."""
    where = f"region {name} of " if region is not None and name else ""
    return f"{where}map '{layout.name}' ({layout.size:g} x {layout.size:g} m, {len(layout.obstacles)} obstacles)"


def sample_people(
    rng: np.random.Generator,
    layout: Layout,
    number: int,
    gap: float = 0.2,
    taken: ArrayLike = (),
    keep_off: float = 0.0,
    region: np.ndarray | None = None,
    fits: Callable[[np.ndarray], np.ndarray] | None = None,
    who: str = "people",
    region_name: str = "people_start",
    radius: float = RADIUS,
) -> np.ndarray:
    """`number` places where people stand free of obstacles and of each other.

    gap: least surface gap to one another and to obstacles [m]. taken: (M, 2) places that others hold already, from
    which people stay `keep_off` [m] more. region: boxes (N, 5) in which to stand (default: anywhere). fits: a function
    that tells which of the places (M, 2) will do, (M,) bool. who, region_name: how messages call people and region.
    radius: everybody's [m]. Returns (number, 2) [m]. Raises NoFreeSpace.
    """
    boxes, half = layout.boxes, layout.size / 2 - radius
    taken = np.reshape(np.asarray(taken, dtype=float), (-1, 2))
    places = np.empty((0, 2))
    for _ in range(_TRIES):
        missing = number - len(places)
        if missing == 0:
            break
        candidates = _draw(rng, 2 * missing + 8, half, region)
        inside = (np.abs(candidates) <= half).all(axis=-1)
        candidates = candidates[inside & (clearance(candidates, boxes) >= radius + gap)]
        if len(taken):
            away = np.linalg.norm(candidates[:, None] - taken, axis=-1).min(axis=1)
            candidates = candidates[away >= 2 * radius + gap + keep_off]
        if fits is not None and len(candidates):
            candidates = candidates[fits(candidates)]
        for candidate in candidates[:missing]:
            if not len(places) or np.linalg.norm(places - candidate, axis=-1).min() >= 2 * radius + gap:
                places = np.concatenate([places, candidate[None]])
    if len(places) == number:
        return places
    most = most_clearance(layout, region)
    need = f"{radius + gap:.2f} m between a centre and obstacles"
    where = _no_room(layout, region, region_name)
    found = f"Only {len(places)} of {number} people found room in" if who == "people" else f"{who} finds no room in"
    if most < radius + gap:
        raise NoFreeSpace(f"{found} {where}: {need} is asked for, and the most there is is {most:.2f} m.")
    cure = "Lower the pedestrian or obstacle density." if who == "people" else "Give it more room."
    raise NoFreeSpace(
        f"{found} {where}: {need} is asked for, up to {most:.2f} m there is, but too little of that. {cure}"
    )


def sample_goals(
    rng: np.random.Generator,
    layout: Layout,
    starts: ArrayLike,
    distance: tuple[float, float] = GOAL_DISTANCE,
    gap: float = 0.3,
    region: np.ndarray | None = None,
    joins: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
    who: str = "a person",
    region_name: str = "people_goal",
    radius: float = RADIUS,
) -> np.ndarray:
    """A goal for each of `starts` (N, 2), in free space and `distance` (least, most) [m] away: (N, 2).

    region: boxes (M, 5) in which goals lie (default: anywhere). joins: a function of starts and goals (M, 2) that tells
    whether there is a way from each start to its goal, (M,) bool. who, region_name: how messages call people and
    region. radius: theirs [m]. Raises NoFreeSpace when the map has no such place.
    """
    starts = np.asarray(starts, dtype=float)
    boxes, half = layout.boxes, layout.size / 2 - radius - gap
    goals, missing = np.full_like(starts, np.nan), np.arange(len(starts))
    for _ in range(_TRIES):
        if not len(missing):
            break
        if region is None:
            # Uniform over the ring's area.
            apart = np.sqrt(rng.uniform(distance[0] ** 2, distance[1] ** 2, len(missing)))
            angle = rng.uniform(-np.pi, np.pi, len(missing))
            drawn = starts[missing] + apart[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        else:
            drawn = _draw(rng, len(missing), half, region)
        good = (np.abs(drawn) <= half).all(axis=-1) & (clearance(drawn, boxes) >= radius + gap)
        if region is not None:
            apart = np.linalg.norm(drawn - starts[missing], axis=-1)
            good &= (apart >= distance[0]) & (apart <= distance[1])
        if joins is not None and good.any():
            good[good] = joins(starts[missing[good]], drawn[good])
        goals[missing[good]] = drawn[good]
        missing = missing[~good]
    if not len(missing):
        return goals
    most = most_clearance(layout, region)
    place = f"in region {region_name} " if region is not None and region_name else ""
    raise NoFreeSpace(
        f"Map '{layout.name}' ({layout.size:g} x {layout.size:g} m) has no free goal that can be reached {place}"
        f"{distance[0]:g} to {distance[1]:g} m from {np.round(starts[missing[0]], 2).tolist()} by {who}: "
        f"{radius + gap:.2f} m between its centre and obstacles is asked for, and the most there is is {most:.2f} m."
    )
