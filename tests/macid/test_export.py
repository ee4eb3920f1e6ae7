"""A folder of macid export is the crowd that macid simulates, for a process that has MuJoCo and NumPy alone."""

import json
import os
import re
import subprocess
import sys

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from macid import cli
from macid.crowd import Crowd, CrowdConfig
from macid.evaluate import level_seed
from macid.export import differences, export, write_scene
from macid.files import UsageError
from macid.layout import load_level, random_layout
from macid.maps import load_map

ALONE = "import sys\nsys.modules.update(bson=None, macid=None, jax=None)  # to import one is an error\n"
REPLAY = """
data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = model.key("start").qpos, 0, 0
ways = []
for control in np.load(sys.argv[1]):
    data.ctrl[:] = control
    mujoco.mj_step(model, data, nstep=episode["steps_per_decision"])
    for field in (data.qpos, data.qvel, data.qacc_warmstart):
        field[:] = field.astype(np.float32)  # as the project keeps them
    ways.append(data.qpos.copy())
np.save(sys.argv[2], ways)
"""


def test_a_crowd_goes_the_same_ways_in_mujoco_alone(tmp_path):
    rng = np.random.default_rng(0)
    layout, config = random_layout(rng, 3, size=12.0), CrowdConfig(number=12, period=0.06, goal_distance=(2.0, 9.0))
    folder = export(layout, config, 5, tmp_path / "scene")
    crowd = Crowd(layout, config)
    episode = crowd.reset(np.random.default_rng(5))
    content = json.loads((folder / "episode.json").read_text())
    np.testing.assert_array_equal(content["people"]["goals"], episode.goals[0])
    np.testing.assert_array_equal(content["people"]["lcf"], episode.lcf[0])
    commands = rng.uniform(-1.5, 1.5, (30, 1, 12, 3)).astype(np.float32)  # much of it against each other and walls
    state, ways, touched = episode.physics, [], False
    for command in commands:
        state = crowd.engine.step(state, jnp.asarray(command), nstep=config.substeps)
        ways.append(np.asarray(state.qpos[0]))
        touched |= bool(crowd.engine.read(state).contact.any())
    (code,) = re.findall(r"```python\n(.*?)```", (folder / "README.md").read_text(), re.DOTALL)
    (tmp_path / "replay.py").write_text(ALONE + code + REPLAY)
    np.save(tmp_path / "controls.npy", commands.reshape(30, -1))
    words = [sys.executable, "-I", *(str(tmp_path / name) for name in ("replay.py", "controls.npy", "ways.npy"))]
    ran = subprocess.run(words, cwd=folder, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    np.testing.assert_array_equal(np.load(tmp_path / "ways.npy"), ways)
    assert touched


@pytest.mark.parametrize("place", [["--level", "1"], ["--level", "foyer"], ["--map", "corridor-flow", "--people", "3"]])
def test_the_command_writes_the_episode_that_evaluate_scores(tmp_path, place):
    out = tmp_path / "new" / "scene"
    assert cli.main(["export", *place, "--seed", "4", "--out", str(out)]) == 0
    assert os.listdir(out.parent) == ["scene"]
    assert sorted(os.listdir(out)) == ["README.md", "episode.json", "scene.xml", "view.xml"]
    content = json.loads((out / "episode.json").read_text())
    if place[0] == "--level":
        level = int(place[1]) if place[1].isdecimal() else place[1]
        layout, seed = load_level(level), (4, *level_seed(level))
    else:
        layout, seed = load_map(place[1]), 4
    number = content["people"]["number"]
    assert number == (3 if place[0] == "--map" else layout.pedestrians)
    starts, goals, *_ = Crowd(layout, CrowdConfig(number=number)).draw(np.random.default_rng(seed), 1, (-2.0, 2.0))
    np.testing.assert_allclose(np.array(content["people"]["start"])[:, :2], starts[0], atol=1e-5)
    np.testing.assert_allclose(content["people"]["goals"], goals[0], atol=1e-5)
    np.testing.assert_array_equal(content["boxes"]["rows"], layout.boxes)
    opened = mujoco.MjModel.from_xml_path(str(out / "view.xml"))
    np.testing.assert_allclose(opened.qpos0, opened.key("start").qpos, rtol=0, atol=1e-12)
    assert (opened.key("start").qpos == mujoco.MjModel.from_xml_path(str(out / "scene.xml")).key("start").qpos).all()


def test_mjx_loads_a_crowd(tmp_path):
    from mujoco import mjx

    layout = random_layout(np.random.default_rng(0), 2, size=12.0)
    folder = export(layout, CrowdConfig(number=3), 0, tmp_path / "scene")
    for name in ("scene.xml", "view.xml"):
        assert mjx.put_model(mujoco.MjModel.from_xml_path(str(folder / name))).nq == 9


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--level", "7"], "Unknown level 7"),
        (["--map", "nowhere"], "Unknown map 'nowhere'"),
        (["--map", "hall", "--level", "1"], "--map and --level both say where"),
        (["--people", "0"], "--people must be at least 1"),
        (["--period", "0.03"], "multiple of the physics step"),
        (["--lcf", "0", "3"], "lcf must be a range"),
    ],
)
def test_what_is_wrong_is_told_and_nothing_is_written(tmp_path, capsys, words, told):
    assert cli.main(["export", *words, "--out", str(tmp_path / "new" / "scene")]) == 2
    assert told in capsys.readouterr().err
    assert os.listdir(tmp_path) == []


def test_a_scene_comes_back_to_the_last_bit_whatever_its_numbers(tmp_path):
    rng = np.random.default_rng(1)
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="12.3456789012345678", pos=rng.normal(size=3) / 3)
    body.add_freejoint()
    body.add_geom(size=rng.uniform(0.1, 1.0, 3), mass=1 / 3, friction=rng.uniform(0.0, 1.0, 3))
    model = spec.copy().compile()
    start = np.array([*rng.normal(size=3), 1.0, 0.0, 0.0, 0.0])
    read = write_scene(spec, tmp_path / "scene.xml", {"qpos": start})
    np.testing.assert_array_equal(read.key("start").qpos, start)
    for field in ("body_pos", "body_mass", "body_inertia", "geom_friction", "geom_rbound"):
        np.testing.assert_array_equal(getattr(read, field), getattr(model, field))
    assert read.body(1).name == "12.3456789012345678"
    assert differences(read, read) == []
    read.body_mass[1] += 1e-9
    assert differences(read, mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))) == ["body_mass"]


def test_a_mesh_that_is_not_there_is_named(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n")
    spec = mujoco.MjSpec()
    spec.modelfiledir = str(tmp_path)
    spec.add_mesh(name="a", file="a.obj")
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="a")
    with pytest.raises(UsageError, match=r"The mesh 'a' needs the file '.*elsewhere/a.obj', and there is none"):
        write_scene(spec, tmp_path / "scene.xml", {}, tmp_path / "elsewhere")
