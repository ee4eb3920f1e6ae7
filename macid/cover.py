"""Few rectangles that cover the solid cells of a grid.

A rectangle is a row `(x0, x1, y0, y1)` of whole numbers, ends excluded, counted in columns and rows.
"""

import numpy as np

from macid.state import RADIUS

_MOST_RUNS = 100_000  # of the grid that is merged; a finer one is made coarser
_MOST_CELLS = 1 << 24
_ROUNDING = 1e-3  # of distances in float32, in cells
_POCKET = 1.0  # area in which nobody needs to walk [m2]


def runs(solid: np.ndarray) -> int:
    """The number of runs of solid cells along rows in the grid `solid` (rows, columns) bool; `exact` takes time and
    memory for each."""
    return int(np.count_nonzero(solid[:, 1:] & ~solid[:, :-1]) + np.count_nonzero(solid[:, 0]))


def exact(solid: np.ndarray) -> np.ndarray:
    """Rectangles (N, 4) that cover the cells `solid` (rows, columns) bool and no other, none twice: runs of cells along
    a row are joined with equal runs in the rows above."""
    rows = len(solid)
    edges = np.diff(np.pad(solid.astype(np.int8), ((0, 1), (1, 1))), axis=1)
    starts, ends = np.argwhere(edges == 1), np.argwhere(edges == -1)
    first = np.searchsorted(starts[:, 0], np.arange(rows + 2))
    along = list(zip(starts[:, 1].tolist(), ends[:, 1].tolist(), strict=True))
    open_runs, found = {}, []
    for row in range(rows + 1):
        here = dict.fromkeys(along[first[row] : first[row + 1]])
        for run in [run for run in open_runs if run not in here]:
            found.append((*run, open_runs.pop(run), row))
        for run in here:
            open_runs.setdefault(run, row)
    return np.reshape(np.array(found, dtype=int), (-1, 4))


def merged(solid: np.ndarray, resolution: float, most: int) -> np.ndarray:
    """At most `most` rectangles (N, 4) that cover all of the cells `solid` (rows, columns) bool, of side `resolution`
    [m], and some free ones beside.

    Free cells are covered in this order, as far as needed: cells that no person of RADIUS can reach, then cells near
    solid ones. Where it is possible, the covered cells leave people's ways as connected as they are.
    """
    grain = 1
    coarse = solid
    while coarse.size > _MOST_CELLS or runs(coarse) > _MOST_RUNS:
        grain *= 2
        coarse = _coarser(solid, grain)
    side = grain * resolution
    distance = _distance(coarse)
    ways = _ways(distance, side)
    fallback = None
    steps = 1 + int(np.ceil(np.log2(sum(coarse.shape))))  # the last reaches everywhere
    for far in (0.0, *(side * 2.0 ** np.arange(steps))):
        choices = (True, False) if far <= 4 * RADIUS else (False,)
        for spared in choices:
            found = _cover(coarse, _allowed(coarse, distance, side, far, ways, spared))
            if len(found) > most:
                continue
            if _still_joined(coarse, found, side, ways):
                return _scaled(found, grain, solid.shape)
            fallback = found if fallback is None else fallback
        if fallback is not None and far > 4 * RADIUS:
            return _scaled(fallback, grain, solid.shape)
    raise AssertionError("one rectangle covers everything")


def leaves_room(solid: np.ndarray, found: np.ndarray, resolution: float) -> bool:
    """Whether people have a way on the grid `solid` (rows, columns) bool of cells of side `resolution` [m] that the
    rectangles `found` (N, 4) cover in part; True also where people had no way before."""
    covered = solid.copy()
    _fill(covered, found)
    return bool(_ways(_distance(covered), resolution).any() or not _ways(_distance(solid), resolution).any())


def _fill(cells, found):
    for x0, x1, y0, y1 in found:
        cells[y0:y1, x0:x1] = True


def _coarser(solid: np.ndarray, grain: int) -> np.ndarray:
    """The grid of blocks of `grain` x `grain` cells: solid where a cell is."""
    rows, columns = (-(-length // grain) * grain for length in solid.shape)
    padded = np.ones((rows, columns), bool)
    padded[: solid.shape[0], : solid.shape[1]] = solid
    return np.asarray(padded.reshape(rows // grain, grain, columns // grain, grain).any(axis=(1, 3)))


def _scaled(found, grain, shape):
    return np.minimum(found * grain, [shape[1], shape[1], shape[0], shape[0]])


def _distance(solid):
    """Distance from each cell's centre to the centre of the nearest `solid` cell: (rows, columns), in cells. Everything
    beyond the edge of the grid is solid."""
    import cv2

    return cv2.distanceTransform(np.pad(~solid, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]


def _near(cells, distance):
    """Which cells are less than `distance`, in cells, from one of `cells` (rows, columns) bool."""
    import cv2

    if not cells.any():
        return cells
    return cv2.distanceTransform((~cells).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) < distance


def _labels(cells):
    import cv2

    return cv2.connectedComponents(cells.astype(np.uint8), connectivity=8, ltype=cv2.CV_32S)[1]


def _ways(distance, side):
    """Where a person's centre can be (rows, columns) bool, without pockets, of the `distance` to what is solid."""
    ways = distance >= RADIUS / side - _ROUNDING
    labels = _labels(ways)
    large = np.bincount(labels.ravel()) * side**2 >= _POCKET
    large[0] = False
    return large[labels]


def _allowed(solid, distance, side, far, ways, spared):
    """Which cells may be covered: solid cells, free cells that no person on the `ways` covers, and cells less than
    `far` [m] from solid ones; with `spared`, the last only where the way is so wide that a way remains."""
    allowed = solid | ~_near(ways, RADIUS / side + 0.5)
    if far == 0:
        return allowed
    near = distance <= far / side + _ROUNDING
    if spared:
        wide = distance >= (RADIUS + far) / side + 1
        narrow = ways & ~_near(wide, 1.5 * (far / side + 1) + 1)
        near &= ~_near(narrow, (RADIUS + 2 * far) / side + 2)
    return allowed | near


def _still_joined(solid, found, side, ways):
    """Whether the rectangles `found` leave each connected part of `ways` in one piece, but for pockets."""
    covered = solid.copy()
    _fill(covered, found)
    before, after = _labels(ways), _labels((_distance(covered) >= RADIUS / side - _ROUNDING) & ways)
    size = np.bincount(after.ravel())
    part = np.zeros(len(size), int)
    part[after] = before  # a piece lies within one part
    large = part[1:][size[1:] * side**2 >= _POCKET]
    return sorted(large.tolist()) == list(range(1, 1 + before.max()))


def _cover(solid, allowed):
    """Rectangles (N, 4) within `allowed` that cover `solid`: built by rows or by columns, whichever needs fewer."""
    if not solid.any():
        return np.empty((0, 4), int)
    by_rows = _sweep(solid, allowed)
    by_columns = _sweep(solid.T, allowed.T)
    return by_rows if len(by_rows) <= len(by_columns) else by_columns[:, [2, 3, 0, 1]]


def _sweep(solid, allowed):
    """`_cover`, row by row. A rectangle grows as long as the cells that it must cover lie within the columns that it
    may cover in all of its rows."""
    rows, columns = solid.shape
    width = columns + 1
    flat = np.zeros((rows, width), np.int8)
    flat[:, :columns] = allowed
    edges = np.diff(flat.ravel(), prepend=0)
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    needed = np.flatnonzero(np.pad(solid, ((0, 0), (0, 1))).ravel())
    first, last = np.searchsorted(needed, starts), np.searchsorted(needed, ends) - 1
    empty = first > last
    low = np.where(empty, -1, needed[np.minimum(first, len(needed) - 1)] % width)
    high = np.where(empty, -1, needed[last] % width + 1)
    row = starts // width
    table = np.stack([starts % width, (ends - 1) % width + 1, low, high], axis=-1).tolist()
    begins = np.searchsorted(row, np.arange(rows + 1)).tolist()
    going, found = [], []  # [may from, may to, must from, must to, first row, last row + 1]
    for number in range(rows):
        runs = table[begins[number] : begins[number + 1]]
        following, place = [], 0
        for may0, may1, must0, must1 in runs:
            while place < len(going) and going[place][1] <= may0:  # over: nothing to go on in
                found.append(going[place])
                place += 1
            taken = must0 < 0
            at = place
            while at < len(going) and going[at][0] < may1:
                one = going[at]
                at += 1
                from_, to = max(one[0], may0), min(one[1], may1)
                if not taken and from_ <= min(one[2], must0) and to >= max(one[3], must1):
                    following.append([from_, to, min(one[2], must0), max(one[3], must1), one[4], number + 1])
                    taken = True
                elif from_ <= one[2] and to >= one[3]:
                    following.append([from_, to, *one[2:]])
                elif one[1] > may1:  # it may go on in the next run
                    at -= 1
                    break
                else:
                    found.append(one)
            place = at
            if not taken:
                following.append([may0, may1, must0, must1, number, number + 1])
        found += going[place:]
        following.sort()
        going = following
    found += going
    return np.reshape(np.array([each[2:] for each in found], dtype=int), (-1, 4))
