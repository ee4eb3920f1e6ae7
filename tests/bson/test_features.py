import numpy as np
import pytest

from bson.features import FEATURES, RANGE, SCANS, SECTORS, Features, closeness, motion


def observation(rng, count):
    return {
        "goal": rng.normal(0.0, 10.0, (count, 2)).astype(np.float32),
        "velocity": rng.normal(0.0, 1.0, (count, 2)).astype(np.float32),
        "lidar": rng.uniform(0.1, 30.0, (count, 720)).astype(np.float32),
    }


def test_a_sector_holds_its_nearest_beam():
    scan = np.full(720, 30.0, np.float32)
    scan[45] = 2.0  # 20 beams a sector
    expected = np.zeros(SECTORS)
    expected[2] = 1.0 - 2.0 / RANGE
    assert closeness(scan) == pytest.approx(expected)


def test_a_mirrored_scan_gives_mirrored_sectors():
    scan = np.random.default_rng(0).uniform(0.1, 30.0, 720).astype(np.float32)
    assert (closeness(scan[::-1]) == closeness(scan)[::-1]).all()


def test_motion_of_a_known_place():
    row = motion({"goal": np.array([3.0, 4.0]), "velocity": np.array([1.0, -2.0])})
    assert row == pytest.approx([0.6, 0.8, np.exp(-5.0), 0.25, 0.5, -1.0], abs=1e-6)


def test_scans_of_earlier_steps_are_remembered_until_an_episode_begins():
    rng = np.random.default_rng(1)
    seen = [observation(rng, 2) for _ in range(SCANS[-1] + 3)]
    features = Features(2)
    features.begin([0, 1], seen[0])
    for now in seen[1:]:
        x = features.step([0, 1], now)
    assert x.shape == (2, FEATURES)
    for place, ago in enumerate(SCANS):
        part = x[:, 6 + place * SECTORS : 6 + (place + 1) * SECTORS]
        assert (part == closeness(seen[-1 - ago]["lidar"])).all()
    fresh = {name: value[1:] for name, value in observation(rng, 2).items()}
    assert (features.begin([1], fresh) == Features(1).begin([0], fresh)).all()


def test_robots_do_not_share_a_memory():
    rng = np.random.default_rng(2)
    together, alone = Features(3), Features(1)
    for step in range(6):
        now = observation(rng, 3)
        third = {name: value[2:] for name, value in now.items()}
        if step == 0:
            x, y = together.begin([0, 1, 2], now), alone.begin([0], third)
        else:
            x, y = together.step([0, 1, 2], now), alone.step([0], third)
        assert (x[2:] == y).all()
