"""The Jackal does what it is told, stays upright, and is the robot that Clearpath describes; so do robots from
files."""

import functools
import math

import gymnasium
import mujoco
import numpy as np
import pytest

from bson import ENVIRONMENTS, robot
from bson.agents.scripted import goal
from bson.sensors import DepthCamera, Imu, Lidar2D, Lidar3D
from bson.simulation.world import World
from bson.task import TaskConfig
from macid import assets, geometry
from macid.drawing import gl

STEP = 0.02  # [s]
OTHERS = ("diffbot", "courier")  # a URDF and an MJCF


def world(pedestrian=None, wall_x=None, description=robot.JACKAL):
    """A floor and a robot; a pedestrian at (x, y) [m], or a wall whose face is at `wall_x` [m]."""
    spec = mujoco.MjSpec()
    spec.option.timestep = STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(name="floor", type=plane, size=[50, 50, 1], contype=4, conaffinity=0)
    if pedestrian is not None:
        body = spec.worldbody.add_body(name="pedestrian", pos=[*pedestrian, 0])
        size, middle = [0.35, 0.85, 0], [0, 0, 0.85]
        cylinder = mujoco.mjtGeom.mjGEOM_CYLINDER
        body.add_geom(type=cylinder, size=size, pos=middle, mass=75, contype=2, conaffinity=0)
        slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
        for name, kind, axis, gain, limit in (
            ("x", slide, [1, 0, 0], 1500, 400),
            ("y", slide, [0, 1, 0], 1500, 400),
            ("yaw", hinge, [0, 0, 1], 50, 100),
        ):
            body.add_joint(name=name, type=kind, axis=axis)
            motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            motor.set_to_velocity(kv=gain)
            motor.forcerange = [-limit, limit]
    if wall_x is not None:
        box = mujoco.mjtGeom.mjGEOM_BOX
        spec.worldbody.add_geom(
            type=box, size=[0.1, 3, 0.6], pos=[wall_x + 0.1, 0, 0.6], contype=3, conaffinity=1, name="wall"
        )
    robot.add_robot(spec, description)
    return spec.compile()


def spawn(model, yaw=0.0, description=robot.JACKAL):
    data = mujoco.MjData(model)
    data.joint("robot").qpos[:] = robot.spawn_qpos(0.0, 0.0, yaw, description.config)
    return data


def tilt(data):
    """Angle [deg] between the robot's z axis and the vertical."""
    _, x, y, _ = data.joint("robot").qpos[3:]
    return np.degrees(np.arccos(np.clip(1 - 2 * (x**2 + y**2), -1, 1)))


def pose(data):
    return robot.planar_pose(data.joint("robot").qpos)


def drive(model, data, command, seconds, description=robot.JACKAL):
    """Drive for `seconds`: (velocities (steps, 2), the largest tilt [deg])."""
    data.ctrl[robot.wheel_actuators(model, description)] = robot.wheel_speeds(np.array(command), description)
    velocity, largest = [], 0.0
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
        joint = data.joint("robot")
        velocity.append(robot.planar_velocity(joint.qpos, joint.qvel))
        largest = max(largest, tilt(data))
    return np.array(velocity), largest


@pytest.fixture(scope="module")
def model():
    return world()


def after_a_second(model, command, description=robot.JACKAL):
    """Velocity (2,), the mean over 0.2 s that begin 1 s after the start from rest."""
    start = spawn(model, description=description)
    return drive(model, start, command, 1.2, description)[0][-10:].mean(axis=0)


def test_masses_are_the_published_ones(model):
    assert model.body("robot/base").mass == pytest.approx(16.523)
    assert model.body_subtreemass[model.body("robot/base").id] == pytest.approx(16.523 + 4 * 0.477)
    assert model.body("robot/base").ipos == pytest.approx([0.012, 0.002, 0.067])
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.body("robot/base").iquat)
    rotation = rotation.reshape(3, 3)
    published = [[0.3136, -0.0008, 0.0164], [-0.0008, 0.3922, -0.0009], [0.0164, -0.0009, 0.4485]]
    inertia = rotation @ np.diag(model.body("robot/base").inertia) @ rotation.T
    assert inertia == pytest.approx(np.array(published), abs=1e-9)


@pytest.mark.parametrize("name", robot.JACKAL.wheels)
def test_wheels_are_where_they_belong_and_touch_the_floor_only(model, name):
    body, tyre = model.body(f"robot/{name}"), model.geom(f"robot/{name.removesuffix('_wheel')}_tyre")
    sign = np.array([1 if "front" in name else -1, 1 if "left" in name else -1, 1])
    assert body.pos * sign == pytest.approx([0.131, 0.187795, 0.0345])
    assert body.mass == pytest.approx(0.477)
    assert body.inertia == pytest.approx([0.0013, 0.0024, 0.0013])
    assert (tyre.contype, tyre.conaffinity) == (0, 4)


def test_only_hull_and_tyres_collide(model):
    colliding = [model.geom(i).name for i in range(model.ngeom) if model.geom_contype[i] | model.geom_conaffinity[i]]
    tyres = [f"robot/{name.removesuffix('_wheel')}_tyre" for name in robot.JACKAL.wheels]
    assert sorted(colliding) == sorted(["floor", "robot/hull", *tyres])
    assert model.geom("robot/hull").conaffinity == 6


def test_hull_is_the_footprint(model):
    config, hull = robot.JACKAL.config, model.geom("robot/hull")
    assert hull.size[:2] == pytest.approx([config.half_length, config.half_width])
    assert hull.pos[:2] == pytest.approx([0, 0])


def test_nothing_but_the_base_rises_into_the_lidar_plane(model):
    data = spawn(model)
    mujoco.mj_forward(model, data)
    base, plane = model.body("robot/base").id, data.site("robot/lidar").xpos[2]
    assert plane == pytest.approx(0.40, abs=0.005)
    assert data.site("robot/lidar3d").xpos[2] == pytest.approx(0.385, abs=0.005)
    for i in range(model.ngeom):
        if model.geom_bodyid[i] not in (0, base):
            assert data.geom_xpos[i, 2] + model.geom_rbound[i] < plane


def test_joints_of_others_come_first():
    crowded = world(pedestrian=(3.0, 0.0))
    assert crowded.joint("robot").qposadr[0] == 3
    assert [crowded.actuator(i).name for i in range(3, 7)] == [f"robot/{name}" for name in robot.JACKAL.wheels]


@pytest.mark.parametrize("speed", [0.5, 1.0, 1.5, 2.0, -1.0, -2.0])
def test_speed_follows_the_command(model, speed):
    ahead, yaw_rate = after_a_second(model, (speed, 0.0))
    assert ahead == pytest.approx(speed, rel=0.05)
    assert yaw_rate == pytest.approx(0, abs=0.02)


@pytest.mark.parametrize("yaw_rate", [0.5, 1.0, 2.0, -0.5, -1.0, -2.0])
def test_yaw_rate_follows_the_command(model, yaw_rate):
    ahead, turned = after_a_second(model, (0.0, yaw_rate))
    assert turned == pytest.approx(yaw_rate, rel=0.1)
    assert ahead == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize("command", [(1, 1), (1, -1), (-1, 1), (-1, -1), (2, 1), (2, -1), (1.5, 0.5), (-2, 1)])
def test_mixed_commands(model, command):
    ahead, yaw_rate = after_a_second(model, command)
    assert ahead == pytest.approx(command[0], rel=0.1)
    assert yaw_rate == pytest.approx(command[1], rel=0.15)


@pytest.mark.parametrize("speed", [2.0, -2.0])
def test_a_straight_line_is_straight(model, speed):
    data = spawn(model)
    drive(model, data, (speed, 0.0), 3.0)
    x, y, _ = pose(data)
    assert abs(x) > 4
    assert abs(y) < 0.02 * abs(x)


def test_left_mirrors_right(model):
    left, right = after_a_second(model, (1.0, 1.0)), after_a_second(model, (1.0, -1.0))
    assert left == pytest.approx(right * [1, -1], abs=0.02)


def test_at_rest_it_stays_and_the_imu_reads_gravity(model):
    data = spawn(model)
    drive(model, data, (0.0, 0.0), 10.0)
    x, y, yaw = pose(data)
    assert np.hypot(x, y) < 1e-3
    assert abs(np.degrees(yaw)) < 0.1
    assert data.joint("robot").qpos[2] == pytest.approx(robot.JACKAL.config.spawn_height, abs=5e-4)
    assert data.sensor("robot/imu_accelerometer").data == pytest.approx([0, 0, 9.81], abs=0.05)
    assert data.sensor("robot/imu_gyro").data == pytest.approx([0, 0, 0], abs=1e-3)


def test_brakes_within_half_a_second_and_stays_level(model):
    data = spawn(model)
    _, starting = drive(model, data, (2.0, 0.0), 1.5)
    velocity, braking = drive(model, data, (0.0, 0.0), 0.5)
    assert abs(velocity[-1, 0]) < 0.05
    assert max(starting, braking) < 5


@pytest.mark.parametrize("change", [((2, 0), (-2, 0)), ((-2, 0), (2, 0)), ((2, 2), (2, -2))])
def test_stays_level_when_the_command_reverses(model, change):
    data = spawn(model)
    drive(model, data, change[0], 1.5)
    assert drive(model, data, change[1], 1.5)[1] < 10


@pytest.mark.parametrize("command", [(0, 0), (2, 0), (-2, 0), (1, 1)])
@pytest.mark.parametrize("bearing", [0, 42, 90, 180])
def test_a_pedestrian_who_walks_into_it_does_not_tip_it(bearing, command):
    towards = np.array([np.cos(np.radians(bearing)), np.sin(np.radians(bearing))])
    crowded = world(pedestrian=1.2 * towards)
    data = spawn(crowded)
    data.ctrl[:2] = -1.5 * towards
    _, largest = drive(crowded, data, command, 3.0)
    assert largest < 20
    data.ctrl[:2] = 1.5 * towards
    drive(crowded, data, (0.0, 0.0), 1.5)
    assert tilt(data) < 2


def test_a_pedestrian_does_push_it():
    crowded = world(pedestrian=(0.0, 1.2))
    data = spawn(crowded)
    data.ctrl[1] = -1.5
    drive(crowded, data, (0.0, 0.0), 3.0)
    assert pose(data)[1] < -0.5


@pytest.mark.parametrize("yaw", [0.0, 0.3, 0.78])
def test_a_wall_stops_it_upright(yaw):
    walled = world(wall_x=2.0)
    data = spawn(walled, yaw)
    _, largest = drive(walled, data, (2.0, 0.0), 3.0)
    assert largest < 20
    assert 1.5 < pose(data)[0] < 2.0 - 0.2
    drive(walled, data, (0.0, 0.0), 1.0)
    assert tilt(data) < 1


def test_commands_are_clipped_and_shapes_broadcast():
    config = robot.JACKAL.config
    assert np.array_equal(robot.wheel_speeds(np.array([9.0, 9.0])), robot.wheel_speeds(np.array([2.0, 2.0])))
    wheels = robot.wheel_speeds(np.random.default_rng(0).uniform(-1, 1, (3, 5, 2)))
    assert wheels.shape == (3, 5, 4)
    assert np.array_equal(wheels[..., 0], wheels[..., 1]) and np.array_equal(wheels[..., 2], wheels[..., 3])
    left, _, right, _ = robot.wheel_speeds(np.array([0.0, 1.0]))
    assert right == -left == pytest.approx(config.effective_track / 2 / config.rolling_radius)


def test_pose_undoes_spawn_and_velocity_is_in_the_body_frame():
    yaw = np.linspace(-3.1, 3.1, 7)
    qpos = robot.spawn_qpos(1.0, -2.0, yaw)
    assert robot.planar_pose(qpos) == pytest.approx(np.stack([np.full(7, 1.0), np.full(7, -2.0), yaw], axis=-1))
    qvel = np.zeros((7, 6))
    qvel[:, 0], qvel[:, 1], qvel[:, 5] = 1.5 * np.cos(yaw), 1.5 * np.sin(yaw), 0.3
    assert robot.planar_velocity(qpos, qvel) == pytest.approx(np.tile([1.5, 0.3], (7, 1)))


def test_footprint_is_a_box_row():
    assert robot.footprint([1.0, 2.0, 0.5]) == pytest.approx([1.0, 2.0, 0.229, 0.2078, 0.5])
    assert robot.footprint(np.zeros((4, 3))).shape == (4, 5)


@functools.cache
def other(name):
    """The description of a robot, and a floor with it."""
    description = robot.load_robot(name)
    return description, world(description=description)


def put(world, pose):
    """The robot of world 0 to `pose`, at rest."""
    world.place([0], pose=[pose])


_ALL_SENSORS = (Imu(), Lidar2D(), Lidar3D())


def alone(sensors=_ALL_SENSORS, pose=(1.0, 2.0, 0.4), **changes):
    """A World without people, in which the robot stands still at `pose` and has settled."""
    found = World(TaskConfig(num_pedestrians=0, map_size=20.0, goal_distance=(6.0, 12.0), **changes), 1, sensors)
    found.reset([0], [3])
    put(found, pose)
    for _ in range(10):
        found.step([0], [[0.0, 0.0]])
    return found


@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize("share", [0.3, 1.0, -1.0])
def test_another_robot_drives_straight_and_turns_as_told(name, share):
    description, model = other(name)
    speed, yaw_rate = share * description.config.max_speed, share * description.config.max_yaw_rate
    assert after_a_second(model, (speed, 0.0), description) == pytest.approx([speed, 0.0], rel=0.02, abs=0.01)
    assert after_a_second(model, (0.0, yaw_rate), description) == pytest.approx([0.0, yaw_rate], rel=0.02, abs=0.01)
    both = speed / 2, yaw_rate / 2
    assert after_a_second(model, both, description) == pytest.approx(both, rel=0.05)


@pytest.mark.parametrize("name", OTHERS)
def test_another_robot_stands_still_at_its_height_and_its_imu_reads_gravity(name):
    description, model = other(name)
    data = spawn(model, description=description)
    drive(model, data, (0.0, 0.0), 3.0, description)
    assert np.hypot(*pose(data)[:2]) < 1e-3
    assert data.joint("robot").qpos[2] == pytest.approx(description.config.spawn_height, abs=2e-3)
    assert data.sensor("robot/imu_accelerometer").data == pytest.approx([0, 0, 9.81], abs=0.05)


@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize("bearing", [0, 42, 90])
def test_a_pedestrian_pushes_another_robot_but_does_not_tip_it(name, bearing):
    towards = np.array([np.cos(np.radians(bearing)), np.sin(np.radians(bearing))])
    description = robot.load_robot(name)
    crowded = world(pedestrian=1.2 * towards, description=description)
    data = spawn(crowded, description=description)
    data.ctrl[:2] = -1.5 * towards
    assert drive(crowded, data, (0, 0), 2.5, description)[1] < 20
    assert pose(data)[:2] @ towards < -0.3
    data.ctrl[:2] = 1.5 * towards
    drive(crowded, data, (0, 0), 1.5, description)
    assert tilt(data) < 2


@pytest.mark.parametrize("name", OTHERS)
def test_another_robot_meets_the_wall_with_its_footprint_and_that_is_counted(name):
    met = alone(robot=name, sensors=(), pose=(9.0, 3.0, 0.0))
    half = met.config.robot.half_length
    for _ in range(15):
        met.step([0], [[met.config.robot.max_speed, 0.0]])
    assert met.collisions_wall[0] > 10
    assert met.pose[0, 0] == pytest.approx(10.0 - half, abs=0.01)
    assert met.model.geom("robot/hull").size[:2] == pytest.approx([half, met.config.robot.half_width])


def test_numbers_of_the_task_reach_the_hull_and_the_command():
    changed = alone(robot={"name": "diffbot", "half_length": 0.3, "max_speed": 0.5}, sensors=())
    assert changed.model.geom("robot/hull").size[:2] == pytest.approx([0.3, 0.175])
    for _ in range(10):
        changed.step([0], [[9.0, 0.0]])
    assert changed.velocity[0, 0] == pytest.approx(0.5, rel=0.02)


@pytest.mark.parametrize("name", OTHERS)
def test_scanners_of_another_robot_see_the_walls_and_the_floor_but_not_the_robot(name):
    still = alone(robot=name)
    height = {"diffbot": 0.357 + 0.0352, "courier": 0.585}[name]
    x, y, yaw = still.pose[0]
    level = np.stack([np.cos(yaw + Lidar2D().angles), np.sin(yaw + Lidar2D().angles)], axis=-1)
    walls = geometry.ray_box_distance(np.array([x, y]), level, still.boxes[0]).min(axis=-1)
    np.testing.assert_allclose(still.readings["lidar"][0], walls, atol=0.02)
    floor = height / np.sin(np.radians([15, 13, 11]))
    np.testing.assert_allclose(still.readings["lidar3d"][0][:3], np.tile(floor[:, None], 360), rtol=0.02)


def test_a_mount_may_be_turned(tmp_path):
    text = assets.path("robots", "diffbot.toml").read_text()
    (tmp_path / "diffbot.urdf").write_text(assets.path("robots", "diffbot.urdf").read_text())
    turned = text.replace("[0.0, 0.0, 0.312]", "[0.1, 0.0, 0.312], rpy = [0.0, 0.0, 1.5707963267948966]")
    (tmp_path / "turned.toml").write_text(turned)
    still = alone(robot=str(tmp_path / "turned.toml"))
    x, y, yaw = still.pose[0]
    angles = yaw + math.pi / 2 + Lidar2D().angles
    origin = np.array([x + 0.1 * np.cos(yaw), y + 0.1 * np.sin(yaw)])
    level = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    walls = geometry.ray_box_distance(origin, level, still.boxes[0]).min(axis=-1)
    np.testing.assert_allclose(still.readings["lidar"][0], walls, atol=0.02)


@pytest.mark.parametrize(("name", "height", "up"), [("diffbot", 0.2712, 0.0), ("courier", 0.36, math.radians(10))])
def test_the_camera_of_another_robot_sees_the_floor_where_geometry_has_it(name, height, up):
    if problem := gl.gl_problem():
        pytest.skip(problem)
    camera = DepthCamera()
    still = alone(robot=name, sensors=(camera,))
    falls = camera.directions[..., 2] * math.cos(up) + camera.directions[..., 0] * math.sin(up)  # z of each ray
    floor = height / np.maximum(-falls, 1e-9)
    near = floor < 4.0
    assert near.sum() > 1000 * (name == "diffbot") + 100
    np.testing.assert_allclose(still.readings["depth"][0][near], floor[near], rtol=0.05)


@pytest.mark.parametrize("name", robot.robot_names())
def test_what_is_only_seen_does_not_change_the_motion(name):
    seen = mujoco.MjSpec()
    seen.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[9, 9, 1], contype=4, conaffinity=0)
    description = robot.load_robot(name)
    robot.add_robot(seen, description)
    models = [seen.compile()]
    robot.hide_robot(seen)
    models.append(seen.compile())
    assert models[1].ngeom < models[0].ngeom
    ends = []
    for model in models:
        data = spawn(model, description=description)
        drive(model, data, (1.0, 0.7), 0.5, description)
        ends.append(np.concatenate([data.qpos, data.qvel]))
    assert np.array_equal(*ends)
    body = models[1].geom_bodyid > 0
    assert (models[1].geom_rgba[body, 3] == 0).all() and (models[1].geom_matid[body] < 0).all()


@pytest.mark.parametrize("name", OTHERS)
def test_the_goal_agent_arrives_with_another_robot(name):
    env = gymnasium.make("BSON/LocalLidar2D-v0", robot=name, num_pedestrians=0, map_size=20.0, goal_distance=(6, 9))
    observation, _ = env.reset(seed=1)
    for _ in range(200):
        observation, _, terminated, _, info = env.step(goal(observation).astype(np.float32))
        if terminated:
            break
    assert terminated and info["collisions"] == 0


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_every_environment_takes_another_robot(name):
    if "Camera" in name and (problem := gl.gl_problem()):
        pytest.skip(problem)
    env = gymnasium.make(name, robot="diffbot", num_pedestrians=0)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert env.observation_space["velocity"].high == pytest.approx([4.0, 20.0])


def test_a_wheel_that_is_mounted_the_other_way_round_turns_the_other_way():
    description = robot.load_robot("diffbot")
    assert description.forwards == (1.0, -1.0)
    left, right = robot.wheel_speeds(np.array([0.5, 0.0]), description)
    assert left == -right == pytest.approx(0.5 / description.config.rolling_radius)


URDF = """<robot name="box"><link name="base_footprint"/>
<joint name="up" type="fixed"><parent link="base_footprint"/><child link="base"/><origin xyz="0 0 0.1"/></joint>
<link name="base"><inertial><mass value="5"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><geometry><mesh filename="package://box/meshes/box.obj"/></geometry></visual></link>
<link name="wl"><inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><sphere radius=".1"/></geometry></collision></link>
<link name="wr"><inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><sphere radius=".1"/></geometry></collision></link>
<joint name="l" type="continuous">
<parent link="base"/><child link="wl"/><origin xyz="0 .2 0"/><axis xyz="0 1 0"/></joint>
<joint name="r" type="continuous">
<parent link="base"/><child link="wr"/><origin xyz="0 -.2 0"/><axis xyz="0 1 0"/></joint>
</robot>"""
TOML = """model = "box.urdf"
base = "base_footprint"
spawn_height = 0.0
[drive]
kind = "differential"
left = ["l"]
right = ["r"]
max_speed = 1.0
max_yaw_rate = 1.0
wheel_radius = 0.1
track = 0.4
gain = 5.0
max_torque = 5.0
[footprint]
half_length = 0.2
half_width = 0.25
bottom = 0.02
top = 0.2
[mounts]
lidar = { position = [0.0, 0.0, 0.3] }
lidar3d = { position = [0.0, 0.0, 0.4] }
camera = { position = [0.1, 0.0, 0.3] }
imu = { position = [0.0, 0.0, 0.0] }
"""
OBJ = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"


@pytest.fixture
def box(tmp_path):
    """A function that writes a description and its model, changed as said, and gives its file's name."""

    def write(toml=("", ""), urdf=("", "")):
        assert toml[0] in TOML and urdf[0] in URDF
        (tmp_path / "box.obj").write_text(OBJ)
        (tmp_path / "box.urdf").write_text(URDF.replace(*urdf))
        (tmp_path / "box.toml").write_text(TOML.replace(*toml))
        return str(tmp_path / "box.toml")

    return write


def test_a_file_of_ones_own_is_a_robot_with_its_meshes(box):
    description = robot.load_robot(box())
    model = world(description=description)
    assert model.nmesh == 1
    assert (description.config.rolling_radius, description.config.effective_track) == (0.1, 0.4)
    assert after_a_second(model, (0.5, 0.5), description) == pytest.approx([0.5, 0.5], rel=0.1)


def test_a_whole_number_stays_whole(box):
    assert (
        repr(robot.load_robot(box(toml=("max_speed = 1.0", "max_speed = 1"))).config.max_speed) == "1"
    )  # as in digests


def test_what_xacro_has_expanded_is_read(box):
    robot.load_robot(box(urdf=('<robot name="box">', '<robot name="box" xmlns:xacro="http://www.ros.org/wiki/xacro">')))


def test_a_changed_model_is_read_again(box):
    first = robot.load_robot(box())
    second = robot.load_robot(
        box(urdf=('origin xyz="0 .2 0"/><axis xyz="0 1 0"', 'origin xyz="0 .2 0"/><axis xyz="0 -1 0"'))
    )
    assert (first.forwards, second.forwards) == ((1.0, 1.0), (-1.0, 1.0))
    assert first.digest != second.digest


@pytest.mark.parametrize(
    ("toml", "urdf", "told"),
    [
        (('base = "base_footprint"', 'base = "chassis"'), ("", ""), "no body 'chassis'.*base_footprint, base, wl, wr"),
        (('["l"]', '["left"]'), ("", ""), "no joint 'left'.*joints are l, r"),
        (("", ""), ('name="l" type="continuous"', 'name="l" type="prismatic"'), "no free-running hinge"),
        (("", ""), ('<axis xyz="0 1 0"/></joint>', '<axis xyz="1 0 0"/></joint>'), "axle of wheel 'l' does not lie"),
        (('left = ["l"]\nright = ["r"]', 'left = ["r"]\nright = ["l"]'), ("", ""), "'r' is on the right"),
        (("", ""), ("</robot>", ""), "MuJoCo can't read 'box.urdf'"),
        (("", ""), ('value="5"', 'value="-5"'), "mass"),
        (("box.urdf", "bin.urdf"), ("", ""), "no model file.*bin.urdf"),
        (("gain = 5.0\nmax_torque = 5.0\n", ""), ("", ""), "give drive.gain and drive.max_torque"),
        (("max_torque = 5.0\n", ""), ("", ""), "both of gain and max_torque"),
        (("bottom = 0.02\ntop = 0.2\n", ""), ("", ""), "footprint.bottom and footprint.top"),
        (("bottom = 0.02", "bottom = 0.5"), ("", ""), "rising order"),
        (
            ("", ""),
            ('<collision><geometry><sphere radius=".1"/>', '<collision name="hull"><geometry><sphere radius=".1"/>'),
            "must be a box",
        ),
        (("imu =", "imu2 ="), ("", ""), "no place for the sensor 'imu'"),
        (("0.0, 0.0, 0.3] }", "0.0, 0.3] }"), ("", ""), "mounts.lidar.position': it must be three numbers"),
        (('"differential"', '"ackermann"'), ("", ""), "one of differential, skid-steer"),
        (('"differential"', '"skid-steer"'), ("", ""), "needs drive.effective_track"),
        (("wheel_radius", "wheel_diameter"), ("", ""), "unknown key 'wheel_diameter'.*wheel_radius"),
        (("track = 0.4", "track = 0.4\nwheels = 2"), ("", ""), "unknown key 'wheels'.*effective_track, gain"),
        (("[footprint]", "[outline]"), ("", ""), "unknown key 'outline'.*footprint"),
        (
            ("max_speed = 1.0", "max_speed = 0.0"),
            ("", ""),
            "max_speed': it must be a number above 0, from 0.01 to 5 m/s, not 0.0",
        ),
        (("max_speed = 1.0", "max_speed = 20.0"), ("", ""), "from 0.01 to 5 m/s, not 20.0"),
        (("half_length = 0.2", "half_length = 2.0"), ("", ""), "from 0.02 to 0.8 m, not 2.0"),
        (("half_length = 0.2", "half_length = 0.79"), ("", ""), "at most 0.8 m"),
        (("half_width = 0.25\n", ""), ("", ""), "'footprint': missing 'half_width'"),
        (("wheel_radius = 0.1", "wheel_radius = 1e-12"), ("", ""), "wheel_radius': it must be .*, not 1e-12"),
        (("", ""), ('mass value="5"', 'mass value="1e300"'), "mass"),
        (
            ("", ""),
            ('ixx=".1" iyy=".1" izz=".1"', 'ixx="1e-12" iyy="1e-12" izz="1e-12"'),
            "body 'base.* radii of gyration",
        ),
        (
            ("", ""),
            ('sphere radius=".1"', 'sphere radius="1e-12"'),
            "body 'w[lr]' touches with a shape of radius 1e-12",
        ),
        (("", ""), ('<link name="base_footprint"/>', 3000 * "<link>" + 3000 * "</link>"), "recursion|nested|deep"),
        (("box.urdf", "box.urdf.xacro"), ("", ""), "xacro FILE.urdf.xacro > FILE.urdf"),
        (("", ""), ('<robot name="box">', '<robot name="box"><xacro:property name="a" value="1"/>'), "xacro's macros"),
        (("", ""), ("meshes/box.obj", "meshes/box.dae"), "can't read the mesh .*box.dae'.*obj or .stl"),
        (("gain = 5.0", "gain = -5.0"), ("", ""), "drive.gain': it must be a number above 0"),
        (("track = 0.4", "track = "), ("", ""), "is not TOML"),
    ],
)
def test_what_is_wrong_in_a_robots_files_is_told(toml, urdf, told, box):
    with pytest.raises(ValueError, match=f"(?s){told}") as caught:
        robot.load_robot(box(toml, urdf))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("place", ["", "parts"])
@pytest.mark.parametrize("asks", ['<include file="{}"/>', '<asset><mesh file="{}" name="m"/></asset>'])
def test_what_a_model_names_is_a_file_of_a_bounded_size(asks, place, box, tmp_path):
    (tmp_path / place).mkdir(exist_ok=True)
    (tmp_path / place / "odd.xml").write_bytes(b"")
    named = {"": "odd.xml", "parts": "parts/odd.xml"}[place]
    for kind in ("endless", "long", "folder"):
        part = tmp_path / place / "odd.xml"
        if kind == "endless":
            part.unlink()
            part.symlink_to("/dev/zero")
        elif kind == "long":
            part.unlink()
            with part.open("wb") as file:
                file.truncate(1 << 40)  # a hole, which fills no disk
        else:
            part.unlink()
            part.mkdir()
        description = box(('model = "box.urdf"', 'model = "box.xml"'))
        (tmp_path / "box.xml").write_text(f"<mujoco>{asks.format(named)}</mujoco>")
        with pytest.raises(ValueError, match="odd.xml'? (is no regular file|has 1,099,511,627,776 bytes)"):
            robot.load_robot(description)


def test_a_model_that_includes_itself_is_refused(box, tmp_path):
    description = box(('model = "box.urdf"', 'model = "box.xml"'))
    (tmp_path / "box.xml").write_text('<mujoco><include file="box.xml"/></mujoco>')
    with pytest.raises(ValueError, match="nested more than 16 deep"):
        robot.load_robot(description)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("arm.urdf.xacro", "Expand it first: `xacro"),
        ("arm.urdf", "needs a .toml description"),
        ("arm.dae", "part of a model"),
    ],
)
def test_a_model_for_a_description_is_told_what_to_do(name, told):
    with pytest.raises(ValueError, match=f"Unknown robot '{name}'.*{told}"):
        robot.load_robot(name)


@pytest.mark.parametrize(
    "changes", [{"wheel_radius": 1e-12}, {"track": 1e300}, {"max_yaw_rate": float("nan")}, {"half_width": 0}]
)
def test_numbers_that_no_robot_has_are_refused_in_a_task_too(changes):
    with pytest.raises(ValueError, match=f"{next(iter(changes))} must be a number above 0, from"):
        TaskConfig(robot=changes)
