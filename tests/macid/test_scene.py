import itertools

import mujoco
import numpy as np
import pytest

from macid import scene
from macid.layout import Layout
from macid.state import HEIGHT, PHYSICS_STEP, RADIUS

LAYOUT = Layout(12.0, [[3.0, 0.0, 0.5, 0.5, 0.3]])
NUMBER = 3
CONFIG = scene.PersonConfig()


@pytest.fixture(scope="module")
def model():
    return scene.crowd_spec(LAYOUT, NUMBER).compile()


def walk(model, places, commands, seconds):
    """qpos and qvel (T, K, 3) of people who start standing at `places` under constant `commands` (K, 3)."""
    data = mujoco.MjData(model)
    data.qpos.reshape(-1, 3)[:, :2] = places
    data.ctrl.reshape(-1, 3)[:] = commands
    qpos, qvel = [], []
    for _ in range(round(seconds / PHYSICS_STEP)):
        mujoco.mj_step(model, data)
        qpos.append(data.qpos.reshape(-1, 3).copy())
        qvel.append(data.qvel.reshape(-1, 3).copy())
    return np.array(qpos), np.array(qvel)


def apart(who):
    """Places where `who` stand as given, the others out of the way: (NUMBER, 2)."""
    rest = np.array([[-4.0, 4.0], [0.0, 4.0], [4.0, 4.0]])
    rest[: len(who)] = who
    return rest


def test_pedestrians_come_first_and_in_order(model):
    names = [f"person{i}/{axis}" for i in range(NUMBER) for axis in ("x", "y", "yaw")]
    assert [model.joint(i).name for i in range(model.njnt)] == names
    assert [model.actuator(i).name for i in range(model.nu)] == names
    assert model.actuator_trnid[:, 0].tolist() == model.jnt_qposadr.tolist() == list(range(3 * NUMBER))
    assert model.nq == model.nv == 3 * NUMBER


def test_a_joint_moves_what_it_is_named_for(model):
    data = mujoco.MjData(model)
    data.qpos[3:6] = [1.0, -2.0, 0.5]
    mujoco.mj_kinematics(model, data)
    body = data.body("person1")
    np.testing.assert_allclose(body.xpos, [1.0, -2.0, HEIGHT / 2])
    np.testing.assert_allclose(body.xquat, [np.cos(0.25), 0, 0, np.sin(0.25)])


def test_bodies(model):
    for i in range(NUMBER):
        body = model.body(f"person{i}")
        assert body.mass[0] == CONFIG.mass
        np.testing.assert_allclose(body.inertia[2], CONFIG.mass * RADIUS**2 / 2)
        np.testing.assert_allclose(body.ipos, 0.0)
        np.testing.assert_allclose(model.geom(f"person{i}/cylinder").size[:2], [RADIUS, HEIGHT / 2])
        np.testing.assert_allclose(model.geom(f"person{i}/proxy").size[0], RADIUS)
        assert model.geom(f"person{i}/proxy").rgba[3] == 0 < model.geom(f"person{i}/cylinder").rgba[3]


def test_boxes_stand_where_the_layout_says(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for i, (x, y, half_x, half_y, yaw) in enumerate(LAYOUT.boxes):
        height = scene.OUTER_WALL_HEIGHT if i < 4 else scene.WALL_HEIGHT
        np.testing.assert_allclose(model.geom(f"box{i}").size, [half_x, half_y, height / 2])
        np.testing.assert_allclose(data.geom(f"box{i}").xpos, [x, y, height / 2])
        along = data.geom(f"box{i}").xmat.reshape(3, 3)[:2, 0]
        np.testing.assert_allclose(along, [np.cos(yaw), np.sin(yaw)], atol=1e-9)


def test_who_can_touch_whom(model):
    def kind(geom):
        name = model.geom(geom).name
        return name.split("/")[-1] if "/" in name else name.rstrip("0123456789")

    touching = set()
    for a, b in itertools.combinations(range(model.ngeom), 2):
        meet = (model.geom_contype[a] & model.geom_conaffinity[b]) | (model.geom_contype[b] & model.geom_conaffinity[a])
        if meet and model.geom_bodyid[a] != model.geom_bodyid[b]:
            touching.add(tuple(sorted((kind(a), kind(b)))))
    assert touching - {("box", "box")} == {("proxy", "proxy"), ("box", "proxy")}  # boxes stand still anyway


def test_contacts_that_come_about(model):
    data = mujoco.MjData(model)
    data.qpos.reshape(-1, 3)[:, :2] = [[2.3, 0.0], [1.7, 0.3], [-5.7, 0.0]]
    mujoco.mj_forward(model, data)
    pairs = {tuple(sorted(model.geom(g).name for g in contact.geom)) for contact in data.contact}
    assert pairs == {("box4", "person0/proxy"), ("person0/proxy", "person1/proxy"), ("box1", "person2/proxy")}


@pytest.mark.parametrize(("affinity", "met"), [(scene.BIT_SOLID, {"box4", "person0/cylinder"}), (0, set())])
def test_a_robot_meets_cylinders_and_boxes_by_the_solid_bit(affinity, met):
    spec = scene.crowd_spec(LAYOUT, 1)
    robot = spec.worldbody.add_body(name="robot", pos=[2.2, 0.0, 0.4])
    robot.add_freejoint()
    robot.add_geom(name="hull", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.4, 0.2, 0.1], contype=0, conaffinity=affinity)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:2] = [1.6, 0.0]
    mujoco.mj_forward(model, data)
    assert {model.geom(g).name for c in data.contact for g in c.geom} - {"hull"} == met


def test_people_come_before_other_joints():
    spec = scene.base_spec(10.0)
    spec.worldbody.add_body().add_joint(type=mujoco.mjtJoint.mjJNT_HINGE)
    with pytest.raises(ValueError, match="Pedestrians come first"):
        scene.add_people(spec, 1)


@pytest.mark.parametrize("command", [(0.5, 0.0, 0.0), (-0.4, 0.5, 1.0), (0.0, 0.0, -1.0)])
def test_a_commanded_velocity_is_reached_within_five_time_constants(model, command):
    commands = np.zeros((NUMBER, 3))
    commands[0] = command
    pushing = np.linalg.norm(command[:2]) * CONFIG.mass / CONFIG.max_force  # as long as its strength needs
    _, qvel = walk(model, apart([[0.0, 0.0]]), commands, 5 * CONFIG.response + pushing + PHYSICS_STEP / 2)
    assert abs(qvel[-1, 0] - command).max() <= 0.05 * abs(np.array(command)).max()
    np.testing.assert_allclose(qvel[:, 1:], 0.0, atol=1e-9)


def test_nobody_pushes_harder_than_its_strength(model):
    commands = np.zeros((NUMBER, 3))
    commands[0, 0] = 1.5
    _, qvel = walk(model, apart([[-3.0, 0.0]]), commands, 2.0)
    gain = np.diff(qvel[:, 0, 0], prepend=0.0) / PHYSICS_STEP
    assert gain.max() == pytest.approx(CONFIG.max_force / CONFIG.mass, rel=1e-6)
    assert qvel[-1, 0, 0] == pytest.approx(1.5, rel=1e-3)


@pytest.mark.parametrize("aside", [0.0, 0.05, 0.4])
def test_two_who_walk_into_each_other_stay_two_radii_apart(model, aside):
    commands = np.array([[1.5, 0, 0], [-1.5, 0, 0], [0, 0, 0]])
    qpos, _ = walk(model, apart([[-2.0, -4.0], [2.0, -4.0 + aside]]), commands, 4.0)
    distance = np.linalg.norm(qpos[:, 0, :2] - qpos[:, 1, :2], axis=-1)
    assert 0.63 < distance.min() < 0.72  # a closing speed of 3 m/s is stopped within 7 cm
    assert distance[-1] >= 0.69


@pytest.mark.parametrize(
    ("start", "command", "axis", "stop"),
    [
        ((-4.0, 0.0), (-1.5, 0.0, 0.0), 0, -6.0 + RADIUS),
        ((0.0, -4.0), (0.0, -1.5, 0.0), 1, -6.0 + RADIUS),
        ((-3.0, -5.6), (0.0, -1.5, 0.0), 1, -6.0 + RADIUS),
    ],
)
def test_who_walks_into_a_wall_stops_there(model, start, command, axis, stop):
    commands = np.zeros((NUMBER, 3))
    commands[0] = command
    qpos, qvel = walk(model, apart([start]), commands, 4.0)
    assert qpos[:, 0, axis].min() > stop - 0.035  # the blow itself
    assert qpos[-1, 0, axis] == pytest.approx(stop, abs=0.005)
    assert abs(qvel[-1, 0, :2]).max() < 0.01


def test_people_rub_along_walls():
    commands = np.array([[1.0, -1.0, 0.0]])
    speed = []
    for friction in (0.0, 0.4):
        model = scene.crowd_spec(Layout(12.0, []), 1, scene.PersonConfig(friction=friction)).compile()
        speed.append(walk(model, [[-3.0, -5.6]], commands, 3.0)[1][-1, 0, 0])
    assert speed[1] < speed[0] - 0.05
