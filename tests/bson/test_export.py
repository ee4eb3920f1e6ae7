"""A folder of bson export, read and driven by a process with MuJoCo and NumPy alone, is the episode that bson plays."""

import json
import math
import os
import re
import shutil
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from bson import cli
from bson.episodes.tracks import make_track
from bson.evaluation.suites import load_suite
from bson.interfaces.export import export
from bson.sensors import DepthCamera, Imu, Lidar2D, Lidar3D, RgbCamera
from bson.simulation.world import World
from bson.task import TaskConfig
from macid.drawing.colours import lcf_colour
from macid.drawing.gl import gl_problem
from macid.geometry import wrap_angle

draws = gl_problem() is None
SEED = 3
STEPS = 20
TURNED = Lidar2D(key="turned", beams=90, position=(-0.1, 0.05, 0.5), yaw=2.5, pitch=0.2, range_min=0.5, range_max=2.0)
SENSORS = (Imu(), Lidar2D(), Lidar3D(columns=90), TURNED, *((RgbCamera(), DepthCamera()) if draws else ()))
SMALL = {"map_size": 16.0, "goal_distance": (6.0, 12.0)}
CASES = {
    "a crowd": (TaskConfig(num_pedestrians=30, map_size=12.0, goal_distance=(4.0, 10.0)), "local", SENSORS),
    "a maze": (TaskConfig(robot="courier", num_pedestrians=4, obstacle_density=0.6, **SMALL), "local", SENSORS),
    "routes": (TaskConfig(robot="diffbot", map="corridor-flow", goal_distance=(10.0, 19.0)), "local", SENSORS),
    "an image": (TaskConfig(map="office", num_pedestrians=3, goal_distance=(3.0, 12.0)), "global", "lidar2d"),
    "nobody": (TaskConfig(num_pedestrians=0), "global", "lidar3d"),
}
ALONE = "import sys\nsys.modules.update(bson=None, macid=None, jax=None)  # to import one is an error\n"
REPLAY = """
mujoco.mj_resetDataKeyframe(model, data, 0)
mujoco.mj_forward(model, data)
qpos = []
for control in np.load(sys.argv[1]):
    data.ctrl[:] = control
    mujoco.mj_step(model, data, nstep=episode["steps_per_decision"])
    mujoco.mj_forward(model, data)
    qpos.append(data.qpos.copy())
assert not [name for name in sys.modules if name.split(".")[0] in ("bson", "macid") and sys.modules[name]]
last = {f"last_{key}": value for key, value in read().items()}
np.savez(sys.argv[2], qpos=qpos, start=model.key("start").qpos, driven=after.get("imu", 0), **first, **last)
"""


def replay(folder, controls, work):
    """What the README's own code reads at the start, and after `controls` (steps, nu), in a process of its own."""
    (code,) = re.findall(r"```python\n(.*?)```", (folder / "README.md").read_text(), re.DOTALL)
    (work / "replay.py").write_text(ALONE + code + REPLAY)
    np.save(work / "controls.npy", controls)
    words = [sys.executable, "-I", str(work / "replay.py"), str(work / "controls.npy"), str(work / "read.npz")]
    ran = subprocess.run(words, cwd=folder, capture_output=True, text=True, env={**os.environ, "MUJOCO_GL": "egl"})
    assert ran.returncode == 0, ran.stderr
    return np.load(work / "read.npz")


def chase(world, step):
    """A command (1, 2) that drives at the nearest person, or meanders where nobody is."""
    offset = world.people[0, :, :2] - world.pose[0, :2]
    if not len(offset):
        return np.array([[1.5, math.sin(step)]])
    x, y = offset[(offset**2).sum(axis=-1).argmin()]
    return np.array([[1.5, 2.0 * wrap_angle(math.atan2(y, x) - world.pose[0, 2])]])


def agree(sensor, found, reading):
    """Asserts that an exact reading is the float32 one of the project."""
    assert found.shape == reading.shape
    if isinstance(sensor, RgbCamera):
        np.testing.assert_array_equal(found, reading)
    else:  # mujoco.Renderer makes metres of a depth in float32
        step = np.spacing(np.float32(np.abs(reading).max()))  # 8e-6 m for what is 64 m away
        within = 1e-3 if isinstance(sensor, DepthCamera) else max(1e-6, step)
        assert np.abs(found - reading).max() <= within, sensor.key


@pytest.fixture(scope="module", params=CASES)
def exported(request, tmp_path_factory):
    """A case's name, its folder and its config."""
    config, track, sensors = CASES[request.param]
    folder = tmp_path_factory.mktemp("export") / "scene"
    export(config, make_track(track, sensors), SEED, folder)
    return request.param, folder, config


def test_what_mujoco_alone_reads_and_where_it_drives_are_what_the_project_does(exported, tmp_path):
    name, folder, config = exported
    track = make_track(*CASES[name][1:])
    world = World(config, 1, track.sensors)
    world.reset([0], [SEED])
    start, first = world.qpos[0].copy(), {key: values[0].copy() for key, values in world.readings.items()}
    controls, way = [], []
    for step in range(STEPS):
        world.step([0], chase(world, step))
        controls.append(world.engine.ctrl[0].copy())
        way.append(world.qpos[0].copy())
    found = replay(folder, controls, tmp_path)
    np.testing.assert_array_equal(found["start"], start)
    np.testing.assert_array_equal(found["qpos"], way)
    for sensor in track.sensors:
        agree(sensor, found[sensor.key], first[sensor.key])
        agree(sensor, found[f"last_{sensor.key}"], world.readings[sensor.key][0])
    if name == "nobody":
        assert (first["lidar3d"] == 100.0).any()  # -1 in the file
    if name == "a crowd":
        assert (first["turned"] == 2.0).any()
        assert world.collisions[0] > 0
    world.close()


def test_an_episode_s_json_tells_of_the_episode(exported):
    name, folder, config = exported
    content = json.loads((folder / "episode.json").read_text())
    world = World(config)
    world.reset([0], [SEED])
    people, robot = content["people"], content["robot"]
    assert (content["seed"], content["sizes"]["nq"]) == (SEED, world.qpos.shape[1])
    assert people["number"] == config.people == len(people["lcf"]) == len(people["models"])
    for key, value in (("start", world.people), ("lcf", world.lcf), ("waypoints", world.people_goals)):
        np.testing.assert_array_equal(np.reshape(people[key], value[0].shape), value[0])
    np.testing.assert_array_equal(np.reshape(people["goals"], (-1, 2)), world.destinations(0))
    np.testing.assert_array_equal(robot["goal"], world.goal[0])
    np.testing.assert_array_equal(content["boxes"]["rows"], world.boxes[0])
    assert ("map" in content) == (CASES[name][1] == "global")
    if "map" in content:
        np.testing.assert_array_equal([list(map(int, row)) for row in content["map"]["rows"]], world.occupancy(0))
    world.close()


def test_a_viewer_opens_the_episode_s_start_with_the_robot_in_it(exported):
    _, folder, _ = exported
    model = mujoco.MjModel.from_xml_path(str(folder / "view.xml"))
    opened, start = mujoco.MjData(model), mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, start, model.key("start").id)
    for data in (opened, start):
        mujoco.mj_forward(model, data)
    np.testing.assert_allclose(opened.qpos, start.qpos, rtol=0, atol=1e-12)
    np.testing.assert_allclose(opened.geom_xpos, start.geom_xpos, rtol=0, atol=1e-9)
    content = json.loads((folder / "episode.json").read_text())
    np.testing.assert_allclose(opened.body(content["robot"]["body"]).xpos[:2], content["robot"]["start"][:2])
    for index, lcf in enumerate(content["people"]["lcf"]):
        np.testing.assert_allclose(opened.body(f"person{index}").xpos[:2], content["people"]["start"][index][:2])
        np.testing.assert_allclose(model.geom(f"person{index}/cylinder").rgba[:3], lcf_colour(lcf), atol=1e-6)
    of_robot = model.body_rootid[model.geom_bodyid] == model.body(content["robot"]["body"]).id
    assert (model.geom_rgba[of_robot, 3] > 0).any()
    hidden = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    of_robot = hidden.body_rootid[hidden.geom_bodyid] == hidden.body(content["robot"]["body"]).id
    assert of_robot.any()
    assert not hidden.geom_rgba[of_robot, 3].any()


def test_mjx_loads_its_scene_and_that_moves_as_the_other(exported):
    from mujoco import mjx

    _, folder, config = exported
    models = [mujoco.MjModel.from_xml_path(str(folder / file)) for file in ("scene.xml", "scene_mjx.xml")]
    ends = []
    for model in models:
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.ctrl[: 3 * config.people] = np.tile([0.7, -0.4, 0.1], config.people)
        data.ctrl[3 * config.people :] = 8.0 * np.sign(models[0].actuator_gear[3 * config.people :, 0])
        mujoco.mj_step(model, data, nstep=50)
        ends.append(data.qpos.copy())
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=2e-3)
    on_device = mjx.put_model(models[1])
    mjx.put_data(models[1], mujoco.MjData(models[1]))
    assert (on_device.nq, on_device.nsensordata) == (models[0].nq, models[0].nsensordata)


@pytest.mark.slow
@pytest.mark.parametrize(("impl", "file"), [("jax", "scene_mjx.xml"), ("warp", "scene.xml")])
def test_mjx_reads_the_same_beams(tmp_path, impl, file):
    import jax
    from mujoco import mjx

    if impl == "warp":
        pytest.importorskip("warp")
    config = TaskConfig(num_pedestrians=6, **SMALL)
    export(config, make_track("local", (Imu(), Lidar2D(beams=90))), SEED, tmp_path / "scene")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene" / file))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    rows = {"naconmax": 200, "njmax": 400} if impl == "warp" else {}
    put = mjx.put_data(model, data, impl=impl, **rows)
    after = jax.jit(mjx.forward)(mjx.put_model(model, impl=impl), put)
    np.testing.assert_allclose(after.sensordata, data.sensordata, atol=2e-3)


def test_mjx_warp_loads_the_scene(tmp_path):
    pytest.importorskip("warp")
    from mujoco import mjx

    export(TaskConfig(num_pedestrians=2), make_track("local", "lidar2d"), SEED, tmp_path / "scene")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene" / "scene.xml"))
    assert mjx.put_model(model, impl="warp").nsensordata == model.nsensordata


def test_noise_is_noted_and_not_in_the_readings(tmp_path):
    noisy = (Imu(noise=1.0), Lidar2D(beams=8, noise=2.0))
    folder = export(TaskConfig(num_pedestrians=0), make_track("local", noisy), SEED, tmp_path / "scene")
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    assert model.sensor_noise.tolist() == [0.005] * 2 + [0.002] * 8
    assert model.sensor_cutoff[:2].tolist() == [Imu().max_force, Imu().max_rate]


MESHED = """<mujoco>
  <compiler meshdir="parts" texturedir="parts"/>
  <default>
    <default class="look"><geom type="mesh" mesh="box" material="paint" contype="0" conaffinity="0"/></default>
  </default>
  <asset>
    <mesh file="box.obj"/><texture name="paint" type="2d" file="paint.png"/><material name="paint" texture="paint"/>
  </asset>
  <worldbody><body name="base">
    <inertial pos="0 0 .1" mass="5" diaginertia=".1 .1 .1"/><geom class="look"/>
    <site name="lidar" pos="0 0 .3"/><site name="lidar3d" pos="0 0 .4"/>
    <site name="camera" pos=".1 0 .3"/><site name="imu"/>
    <body pos="0 .2 .1"><joint name="l" axis="0 1 0"/><geom type="sphere" size=".1" mass="1"/></body>
    <body pos="0 -.2 .1"><joint name="r" axis="0 1 0"/><geom type="sphere" size=".1" mass="1"/></body>
  </body></worldbody>
</mujoco>"""
DESCRIPTION = """model = "box.xml"
base = "base"
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
"""
OBJ = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"


@pytest.fixture
def meshed(tmp_path):
    """The file of a robot with a mesh and a texture."""
    from PIL import Image

    parts = tmp_path / "robot" / "parts"
    parts.mkdir(parents=True)
    (parts / "box.obj").write_text(OBJ)
    Image.new("RGB", (4, 4), (200, 10, 10)).save(parts / "paint.png")
    (tmp_path / "robot" / "box.xml").write_text(MESHED)
    (tmp_path / "robot" / "box.toml").write_text(DESCRIPTION)
    return tmp_path / "robot" / "box.toml"


def test_a_robot_s_meshes_and_textures_go_with_it(meshed, tmp_path):
    config = TaskConfig(robot=str(meshed), num_pedestrians=1, **SMALL)
    export(config, make_track("local", "lidar2d"), SEED, tmp_path / "scene")
    (tmp_path / "scene").rename(tmp_path / "elsewhere")
    shutil.rmtree(meshed.parent)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "elsewhere" / "view.xml"))
    geom = int(np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)[0])
    assert model.mesh(model.geom_dataid[geom]).vertnum == 4
    assert model.mat(model.geom_matid[geom]).name == "robot/paint"
    assert sorted(os.listdir(tmp_path / "elsewhere" / "assets")) == ["box.obj", "paint.png"]


def test_a_command_writes_one_folder_and_leaves_nothing_beside_it(tmp_path, capsys):
    out = tmp_path / "new" / "scene"
    words = ["export", "--suite", "scenarios", "--cell", "doorway", "--seed", "4", "--set", "num_pedestrians=1"]
    assert cli.main([*words, "--out", str(out)]) == 0
    assert str(out) in capsys.readouterr().out
    assert os.listdir(out.parent) == ["scene"]
    assert sorted(os.listdir(out)) == ["README.md", "episode.json", "scene.xml", "scene_mjx.xml", "view.xml"]
    content = json.loads((out / "episode.json").read_text())
    (cell,) = (cell for cell in load_suite("scenarios").cells if cell.name == "doorway")
    assert (content["config"]["map"], content["people"]["number"]) == (cell.config.map, 1)
    assert cli.main([*words, "--out", str(out)]) == 2
    assert "There are files in" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--suite", "scenarios"], "Suite 'scenarios' needs a --cell. Choose one of 'frontal', "),
        (["--suite", "scenarios", "--cell", "window"], "Suite 'scenarios' has no cell 'window'. Choose one of "),
        (["--cell", "frontal"], "--cell is one of a suite: give --suite, too."),
        (["--set", "map_size=10.0", "--set", "num_pedestrians=400"], "free"),
        (["--set", "horizon=0"], "horizon must be"),
    ],
)
def test_what_is_wrong_is_told_and_nothing_is_written(tmp_path, capsys, words, told):
    assert cli.main(["export", *words, "--out", str(tmp_path / "new" / "scene")]) == 2
    assert told in capsys.readouterr().err
    assert os.listdir(tmp_path) == []
