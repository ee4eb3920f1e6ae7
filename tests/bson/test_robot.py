"""The Jackal does what it is told, stays upright, and is the robot that Clearpath describes."""

import mujoco
import numpy as np
import pytest

from bson import robot

STEP = 0.02  # [s]


def world(pedestrian=None, wall_x=None):
    """A floor and a Jackal; a pedestrian at (x, y) [m], or a wall whose face is at `wall_x` [m]."""
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
    robot.add_robot(spec)
    return spec.compile()


def spawn(model, yaw=0.0):
    data = mujoco.MjData(model)
    data.joint("robot").qpos[:] = robot.spawn_qpos(0.0, 0.0, yaw)
    return data


def tilt(data):
    """Angle [deg] between the robot's z axis and the vertical."""
    _, x, y, _ = data.joint("robot").qpos[3:]
    return np.degrees(np.arccos(np.clip(1 - 2 * (x**2 + y**2), -1, 1)))


def pose(data):
    return robot.planar_pose(data.joint("robot").qpos)


def drive(model, data, command, seconds):
    """Drive for `seconds`: (velocities (steps, 2), the largest tilt [deg])."""
    data.ctrl[-4:] = robot.wheel_speeds(np.array(command))
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


def after_a_second(model, command):
    """Velocity (2,), the mean over 0.2 s that begin 1 s after the start from rest."""
    return drive(model, spawn(model), command, 1.2)[0][-10:].mean(axis=0)


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


@pytest.mark.parametrize("name", robot.WHEELS)
def test_wheels_are_where_they_belong_and_touch_the_floor_only(model, name):
    body, tyre = model.body(f"robot/{name}"), model.geom(f"robot/{name.removesuffix('_wheel')}_tyre")
    sign = np.array([1 if "front" in name else -1, 1 if "left" in name else -1, 1])
    assert body.pos * sign == pytest.approx([0.131, 0.187795, 0.0345])
    assert body.mass == pytest.approx(0.477)
    assert body.inertia == pytest.approx([0.0013, 0.0024, 0.0013])
    assert (tyre.contype, tyre.conaffinity) == (0, 4)


def test_only_hull_and_tyres_collide(model):
    colliding = [model.geom(i).name for i in range(model.ngeom) if model.geom_contype[i] | model.geom_conaffinity[i]]
    tyres = [f"robot/{name.removesuffix('_wheel')}_tyre" for name in robot.WHEELS]
    assert sorted(colliding) == sorted(["floor", "robot/hull", *tyres])
    assert model.geom("robot/hull").conaffinity == 6


def test_hull_is_the_footprint(model):
    config, hull = robot.RobotConfig(), model.geom("robot/hull")
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
    assert [crowded.actuator(i).name for i in range(3, 7)] == [f"robot/{name}" for name in robot.WHEELS]


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
    assert data.joint("robot").qpos[2] == pytest.approx(robot.RobotConfig().spawn_height, abs=5e-4)
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
    config = robot.RobotConfig()
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
