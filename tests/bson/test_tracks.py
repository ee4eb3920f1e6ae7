import gymnasium
import numpy as np
import pytest

from bson.episodes.session import Session
from bson.episodes.tracks import SENSORS, TRACKS, make_track
from bson.sensors import Lidar2D
from bson.task import TaskConfig
from macid.geometry import point_box_distance, rotate

FEW = TaskConfig(num_pedestrians=4, map_size=20.0, goal_distance=(5.0, 18.0), obstacle_density=0.5)


def test_the_global_track_adds_the_map_the_pose_and_the_people():
    session = Session(FEW, make_track("global", "lidar2d"), nworld=2)
    session.reset([0, 1], [3, 4])
    for _ in range(4):
        seen, *_ = session.step([0, 1], np.array([[1.0, 0.3], [0.5, -0.5]]))
    world = session.world
    for index in range(2):
        resolution, origin = seen["map_resolution"][index, 0], seen["map_origin"][index]
        rows, columns = np.indices(seen["map"][index].shape)
        centres = origin + resolution * (np.stack([columns, rows], axis=-1) + 0.5)
        solid = point_box_distance(centres, world.boxes[index]).min(axis=-1) == 0
        np.testing.assert_array_equal(seen["map"][index], solid)
        assert 0.01 < solid.mean() < 0.2
        np.testing.assert_allclose(seen["pose"][index], world.pose[index], atol=1e-5)
        np.testing.assert_allclose(seen["people"][index], world.people[index, :, :2], atol=1e-5)
        place = seen["pose"][index, :2] + rotate(seen["goal"][index], seen["pose"][index, 2])
        np.testing.assert_allclose(place, world.goal[index], atol=1e-4)
    before = seen["map"].copy()
    session.reset([0], [9])
    after = session.observe([0, 1])["map"]
    assert (after[0] != before[0]).any() and (after[1] == before[1]).all()


def test_what_both_tracks_give_is_the_same():
    seen = []
    for track in TRACKS:
        session = Session(FEW, make_track(track, "lidar2d"))
        session.reset([0], [5])
        seen.append(session.step([0], np.array([[0.7, 0.1]]))[0])
    for name in seen[0]:
        np.testing.assert_array_equal(seen[0][name], seen[1][name])


@pytest.mark.parametrize("track", TRACKS)
@pytest.mark.parametrize("sensor", SENSORS)
def test_observations_lie_in_their_space(track, sensor):
    made = make_track(track, sensor)
    session = Session(FEW, made)
    seen = session.reset([0], [1])
    space = made.space(FEW)
    assert space.contains({name: values[0] for name, values in seen.items()})


def test_unknown_names_are_told():
    with pytest.raises(ValueError, match="Unknown track 'locl'. Choose one of local, global, a 'module:class'"):
        make_track("locl", "lidar2d")
    with pytest.raises(ValueError, match="Unknown sensor 'sonar'"):
        make_track("local", "sonar")
    with pytest.raises(ValueError, match="a tuple of bson.sensors' configurations"):
        make_track("local", (Lidar2D(), "camera"))
    with pytest.raises(ValueError, match="keys must differ.*: lidar"):
        make_track("local", (Lidar2D(), Lidar2D(beams=10)))
    with pytest.raises(ValueError, match="keys must differ.*: pose"):
        make_track("local", Lidar2D(key="pose"))


def test_an_environment_takes_sensors_of_ones_own():
    sensors = (Lidar2D(beams=90), Lidar2D(key="rear", yaw=np.pi, beams=45))
    env = gymnasium.make("BSON/LocalLidar2D-v0", sensor=sensors, num_pedestrians=2)
    observation, _ = env.reset(seed=0)
    assert set(observation) == {"goal", "velocity", "lidar", "rear"}
    assert observation["lidar"].shape == (90,) and observation["rear"].shape == (45,)
    assert env.observation_space.contains(observation)
