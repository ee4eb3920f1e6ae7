"""What people are like in the robot's task: their radius, their speeds, and companions."""

import dataclasses
import json

import mujoco
import numpy as np
import pytest

from bson.agents.contract import Setting
from bson.agents.orca_oracle import OrcaOracle
from bson.agents.vfh import Vfh
from bson.episodes.tracks import make_track
from bson.evaluation.suites import read_suite
from bson.interfaces.export import export
from bson.sensors import Lidar2D, Lidar3D
from bson.simulation import pool, rays
from bson.simulation.people import beside_companions
from bson.simulation.world import World
from bson.task import TaskConfig, spawn
from macid.files import UsageError
from macid.state import CONTACT_GAP, RADIUS, Traits

SMALL = TaskConfig(num_pedestrians=4, map_size=14.0, goal_distance=(3.0, 8.0), pedestrian_model="standing")
SLIM = SMALL.replace(person_radius=0.2)
LIVELY = {"preferred_speed": "human", "person_max_speed": 2.0, "companions": 1.0}


def test_the_papers_people_given_outright_change_no_bit():
    told = TaskConfig(
        num_pedestrians=6, map_size=14.0, goal_distance=3.0, pedestrian_model="macid", person_radius=RADIUS,
        preferred_speed=None, person_max_speed=1.5, companions=None,
    )  # fmt: skip
    assert told == TaskConfig(num_pedestrians=6, map_size=14.0, goal_distance=3.0, pedestrian_model="macid")
    drawn, rich = (spawn(config, np.random.default_rng(4)) for config in (told, told.replace(preferred_speed=1.0)))
    assert drawn.traits == Traits()
    for name in ("robot", "goal", "people", "people_goals", "lcf", "models"):
        np.testing.assert_array_equal(getattr(drawn, name), getattr(rich, name))


def around(world, people):
    """World 0 with the robot in the middle, looking along x, and people at `people`, who stand."""
    standing = np.zeros((1, len(people), 3))
    standing[0, :, :2] = people
    world.place([0], pose=[[0.0, 0.0, 0.0]], people=standing)
    return world


@pytest.mark.parametrize("radius", [0.2, RADIUS])
def test_a_robot_touches_a_person_at_its_radius(radius):
    config = SMALL.replace(person_radius=radius)
    world, front = World(config), config.robot.half_length
    world.reset([0], [0])
    for more in (-2e-3, 2e-3):
        gap = CONTACT_GAP + more
        around(world, [[front + radius + gap, 0.0], [5.0, 5.0], [-5.0, 5.0], [-5.0, -5.0]])
        assert world.nearest_person[0] == pytest.approx(gap, abs=1e-9)
        before = int(world.collisions_person[0])
        world.step([0], [[0.0, 0.0]])
        assert (world.collisions_person[0] > before) == (more < 0)


def test_beams_end_at_the_radius_as_mujocos_do():
    sensors = Lidar2D(), Lidar3D(elevation=(-0.6, 0.6))
    world = World(SLIM, 1, sensors)
    world.reset([0], [1])
    around(world, [[2.0, 0.0], [0.5, 1.5], [0.3, -2.0], [-2.0, 0.4]])
    beam = world.readings["lidar"][0]
    site = world.model.site("robot/lidar_beams").id
    data = world.engine.data(0)
    mujoco.mj_forward(world.model, data)
    assert beam[len(beam) // 2] == pytest.approx(2.0 - 0.2 - data.site_xpos[site][0], abs=2e-3)
    solids = rays.Solids(world.people[0, :, :2].copy(), world.boxes[0], 8.0, SLIM.person_radius)
    for sensor in sensors:
        site = world.model.site(f"robot/{sensor.key}_beams").id
        place, frame = data.site_xpos[site], data.site_xmat[site].reshape(3, 3)
        found = rays.first(place, sensor.directions @ frame.T, solids).clip(sensor.range_min, sensor.range_max)
        np.testing.assert_allclose(found, world.readings[sensor.key][0], atol=1e-5)


def test_people_of_the_task_have_their_own_speeds():
    config = TaskConfig(
        num_pedestrians=3, map_size=50.0, pedestrian_model="macid", lcf=0.0, **LIVELY | {"companions": None}
    )
    world = World(config, 2, with_robot=False)
    world.reset([0, 1], [3, 4])
    wanted = np.stack([world.traits(index).preferred_speed for index in (0, 1)])
    assert not np.allclose(wanted[0], wanted[1])
    for _ in range(40):
        world.step([0, 1], np.zeros((2, 2)))
    speed = np.linalg.norm(world.people_velocity, axis=-1)
    assert np.median(np.abs(speed / wanted - 1.0)) < 0.05
    alone = World(config, 1, with_robot=False)
    alone.reset([0], [4])
    for _ in range(40):
        alone.step([0], np.zeros((1, 2)))
    np.testing.assert_array_equal(alone.people[0], world.people[1])


def test_companions_go_on_together():
    config = TaskConfig(num_pedestrians=6, map_size=30.0, pedestrian_model="standing", person_radius=0.2, **LIVELY)
    world = World(config)
    world.reset([0], [2])
    group = world.traits(0).group
    members = np.flatnonzero(group != np.arange(6))
    assert len(members)

    def shared(goals):
        apart = np.linalg.norm(goals[members] - goals[group[members]], axis=-1)
        return (apart <= 0.8).all() and (apart > 0.0).any()

    before = world.destinations(0)
    assert shared(before)
    person = members[0]
    people = world.people.copy()
    people[0, person, :2] = world.people_goals[0, person]
    world.place([0], people=people)
    world.step([0], [[0.0, 0.0]])
    after = world.destinations(0)
    assert shared(after)
    moved = np.linalg.norm(after - before, axis=-1) > 1e-9
    np.testing.assert_array_equal(moved, group == group[person])
    drawn = pool.draw(config, 2)
    np.testing.assert_array_equal(drawn.traits.group, group)
    for turn in range(pool.GOALS):
        assert shared(drawn.ways[:, turn])


def test_on_a_route_companions_have_one_route_and_one_goal():
    config = TaskConfig(map="corridor-flow", person_radius=0.2, **LIVELY)
    drawn = spawn(config, np.random.default_rng(0))
    routes, group = len(drawn.layout.routes), drawn.traits.group
    everybody = np.arange(len(group))
    assert (group != everybody).any()
    np.testing.assert_array_equal(group % routes, everybody % routes)
    np.testing.assert_array_equal(drawn.people_goals, drawn.people_goals[group])
    goals = beside_companions(config, drawn.layout, group, drawn.people[:, :2], drawn.people_goals)
    np.testing.assert_array_equal(goals, drawn.people_goals)


def test_agents_are_told_the_radius():
    setting = Setting.of(SLIM, make_track("local", "lidar2d"))
    assert setting.person_radius == 0.2 and Setting.default().person_radius == RADIUS
    assert Vfh(setting).config.person_radius == 0.2 and Vfh().config.person_radius == RADIUS
    assert OrcaOracle(Setting.of(SLIM, make_track("global", "lidar2d")))._person_radius == 0.2


def test_an_exported_scene_tells_of_its_people(tmp_path):
    config = SLIM.replace(**LIVELY)
    folder = export(config, make_track("local", "lidar2d"), 1, tmp_path / "scene")
    people = json.loads((folder / "episode.json").read_text())["people"]
    assert people["radius"] == 0.2 and people["max_speed"] == [2.0] * 4
    assert len(people["preferred_speed"]) == len(people["group"]) == 4
    assert "radius 0.2 m" in (folder / "README.md").read_text()
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    assert model.geom("person0/cylinder").size[0] == model.geom("person0/proxy").size[0] == 0.2


def test_a_suite_may_say_what_people_are_like(tmp_path):
    text = 'name = "own"\ndescription = "own"\nseeds = [1, 2]\n[config]\nperson_radius = 0.2\npreferred_speed = {}\n'
    text += "person_max_speed = 2.0\ncompanions = 0.5\n"
    file, digests = tmp_path / "own.toml", set()
    for speed, wanted in (("'human'", "human"), ("1.2", 1.2), ("[0.8, 1.6]", (0.8, 1.6))):
        file.write_text(text.format(speed))
        suite = read_suite(file)
        config = suite.cells[0].config
        assert config.preferred_speed == wanted and config.companions == 0.5
        assert dataclasses.asdict(config)["person_radius"] == 0.2
        digests.add(suite.digest)
    assert len(digests) == 3
    file.write_text(text.format("'brisk'"))
    with pytest.raises(UsageError, match="preferred_speed must be"):
        read_suite(file)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"person_radius": 0.05}, "person_radius must be a number from"),
        ({"person_max_speed": 3.0}, "person_max_speed must be a number from"),
        ({"preferred_speed": [1.0, 2.0, 3.0]}, "preferred_speed must be"),
        ({"companions": -0.1}, "companions must be"),
    ],
)
def test_what_people_can_not_be_is_told(fields, told):
    with pytest.raises(ValueError, match=told):
        SMALL.replace(**fields)
