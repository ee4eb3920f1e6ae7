"""Rectangles cover all that is solid, and where they are too many, leave people's ways joined."""

import cv2
import numpy as np
import pytest
from scipy import ndimage

from macid import cover, maps
from macid.state import RADIUS


def filled(solid, found):
    cells = np.zeros_like(solid)
    for x0, x1, y0, y1 in found:
        cells[y0:y1, x0:x1] = True
    return cells


@pytest.mark.parametrize("seed", range(40))
def test_nothing_solid_becomes_free(seed):
    rng = np.random.default_rng(seed)
    solid = rng.random(rng.integers(1, 60, 2)) < rng.random()
    exact = cover.exact(solid)
    np.testing.assert_array_equal(filled(solid, exact), solid)
    for most in (1, 4, 20):
        merged = cover.merged(solid, 0.2, most)
        assert len(merged) <= most
        assert not (solid & ~filled(solid, merged)).any()


@pytest.mark.parametrize("seed", range(20))
def test_a_sweep_covers_nothing_but_what_it_may(seed):
    rng = np.random.default_rng(seed)
    solid = rng.random((30, 40)) < 0.2
    allowed = solid | (rng.random(solid.shape) < 0.5)
    cells = filled(solid, cover._sweep(solid, allowed))
    assert not (solid & ~cells).any() and not (cells & ~allowed).any()


def warehouse(cells, side, noise=0.0):
    """Rows of shelves with ragged edges, doors of 1 m in walls across, and noise, `cells` x `cells` of `side` [m]."""
    rng = np.random.default_rng(0)
    solid = np.zeros((cells, cells), bool)
    grid = np.arange(cells) * side
    along, across = grid % 26.0, grid % 4.0
    solid |= ((along > 3) & (along < 21))[:, None] & (across < 1.2)[None]
    wall = np.flatnonzero(np.isclose(along, 23.0, atol=side / 2))
    solid[wall] = True
    for row in wall:
        solid[row, (across > 2.0) & (across <= 3.0)] = False
    edge = ndimage.binary_dilation(solid, iterations=2) & ~solid
    doors = ndimage.binary_dilation(np.isin(np.arange(cells), wall), iterations=3)
    edge[doors] = False
    solid |= edge & (rng.random(solid.shape) < 0.4)
    return solid | (rng.random(solid.shape) < noise)


@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_a_scan_of_thousands_of_boxes_is_merged_and_its_ways_stay_joined(noise):
    solid, side = warehouse(1000, 0.05, noise), 0.05
    assert len(cover.exact(solid)) > 5000
    boxes = maps.rectangles(solid, side)
    assert len(boxes) <= maps.MAX_BOXES
    lower = np.rint((boxes[:, :2] - boxes[:, 2:4]) / side + 500).astype(int)
    upper = np.rint((boxes[:, :2] + boxes[:, 2:4]) / side + 500).astype(int)
    cells = filled(solid, np.stack([lower[:, 0], upper[:, 0], lower[:, 1], upper[:, 1]], axis=-1))
    assert not (solid & ~cells).any()
    assert (cells & ~solid).mean() < 0.03

    def ways(cells):  # of a disc, by SciPy
        return ndimage.distance_transform_edt(np.pad(~cells, 1))[1:-1, 1:-1] * side >= RADIUS

    before = ndimage.label(ways(solid), np.ones((3, 3)))[0]
    after = ndimage.label(ways(cells), np.ones((3, 3)))[0]
    large = [part for part in range(1, before.max() + 1) if (before == part).sum() * side**2 >= 2.0]
    assert large
    for part in large:
        pieces = np.bincount(after[before == part])[1:] * side**2
        assert (pieces >= 1.0).sum() == 1


def test_a_map_that_merging_would_fill_is_told_with_its_file(tmp_path):
    board = np.indices((100, 100)).sum(axis=0) % 2
    cv2.imwrite(str(tmp_path / "noise.png"), np.where(board, 0, 254).astype(np.uint8))
    (tmp_path / "noise.yaml").write_text("image: noise.png\nresolution: 1.0\n")
    with pytest.raises(ValueError, match=r"noise.yaml.*needs [\d,]+ boxes.*leave nobody room"):
        maps.load_map(str(tmp_path / "noise.yaml"))


def test_noise_among_which_nobody_could_go_is_merged_all_the_same():
    solid = np.random.default_rng(0).random((200, 200)) < 0.3
    boxes = maps.rectangles(solid, 0.05)
    assert 0 < len(boxes) <= maps.MAX_BOXES


@pytest.mark.slow
def test_a_large_scan_is_merged_in_bounded_time():
    solid = warehouse(4000, 0.05, 1e-5)
    merged = cover.merged(solid, 0.05, maps.MAX_BOXES)
    assert len(merged) <= maps.MAX_BOXES and not (solid & ~filled(solid, merged)).any()
