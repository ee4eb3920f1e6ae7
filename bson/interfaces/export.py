"""An episode's scene as MJCF files that MuJoCo, its viewer, MJX and MJX-Warp load without this project."""

import dataclasses
import pathlib

import mujoco
import numpy as np

from bson import robot
from bson.episodes.tracks import GlobalTrack, LocalTrack, sensor_documents
from bson.simulation.data import MAP_RESOLUTION
from bson.simulation.renderer import draw_plainly
from bson.simulation.scene import build_spec
from bson.simulation.world import World
from bson.task import TaskConfig
from macid.export import PACKAGES, box_notes, people_notes, stand_at, write_scene
from macid.files import versions, whole_folder, write_bytes, write_json
from macid.geometry import yaw_quaternion
from macid.state import HEIGHT, PHYSICS_STEP

_FRICTIONLESS = 1e-5  # the least sliding friction that MuJoCo accepts
_ROBOT = "robot"  # the name that bson.robot.add_robot uses


def export(
    config: TaskConfig,
    track: LocalTrack,
    seed: int,
    out: str | pathlib.Path,
    command: str | None = "bson.interfaces.export.export()",
) -> pathlib.Path:
    """Writes the episode `seed` of `config`, with the sensors of `track`, to the folder `out`, which is new or empty:

    scene.xml, the scene as it moves and is sensed, with a rangefinder for each beam of the LIDARs; scene_mjx.xml, the
    same for MJX on JAX; view.xml, the scene as it looks; episode.json; README.md, which tells how to read them. Returns
    the folder.

    command: the command that made the folder, for people to read. Readings have no noise. Raises UsageError,
    NoFreeSpace.
    """
    world = World(config)  # no sensors: a World with cameras needs OpenGL
    try:
        world.reset([0], [seed])
        with whole_folder(out) as folder:
            _write(folder, world, track, seed, command)
    finally:
        world.close()
    return pathlib.Path(out)


def _write(folder, world, track, seed, command):
    """Writes all files of the episode at whose start `world` (nworld = 1) is."""
    config, sources = world.config, robot.describe(world.config.robot).model.parent
    scene = build_spec(config, track.sensors, hidden=True)
    readings = _mount(scene, track.sensors)
    model = write_scene(scene, folder / "scene.xml", _start(scene, world), sources)
    scene = build_spec(config, track.sensors, hidden=True)
    _mount(scene, track.sensors)
    _suit_mjx(scene)
    write_scene(scene, folder / "scene_mjx.xml", _start(scene, world), sources)
    scene = build_spec(config, track.sensors)
    scene.modelname = "bson"
    start = _start(scene, world)
    stand_at(scene, world.people[0], world.lcf[0])
    base = scene.joint(_ROBOT).parent
    base.pos, base.quat = start["qpos"][3 * config.people :][:3], start["qpos"][3 * config.people :][3:7]
    write_scene(scene, folder / "view.xml", start, sources)
    for reading in readings.values():
        if reading.get("read_as") == "beams":
            reading["address"] = int(model.sensor(reading["first"]).adr[0])
    content = {
        "command": command,
        "versions": versions(*PACKAGES),
        "seed": seed,
        "config": dataclasses.asdict(config),
        "sensors": sensor_documents(track.sensors),
        "physics_step": PHYSICS_STEP,
        "steps_per_decision": config.substeps,
        "decisions_per_control": config.decisions,
        "sizes": {name: int(getattr(model, name)) for name in ("nq", "nv", "nu", "nsensordata", "nmocap")},
        "robot": _robot_notes(model, world),
        "people": people_notes(
            world.people[0], world.destinations(0), world.lcf[0], config.person_radius, world.traits(0)
        )
        | {
            "waypoints": world.people_goals[0].tolist(),
            "models": [list(config.model_shares)[number] for number in world.models[0]],
        },
        "boxes": box_notes(world.boxes[0]),
        "readings": readings,
    }
    if isinstance(track, GlobalTrack):
        rows = ["".join(map(str, row.astype(int))) for row in world.occupancy(0)]
        content["map"] = {"resolution": MAP_RESOLUTION, "origin": [-config.map_size / 2] * 2, "rows": rows}
    write_json(folder / "episode.json", content)
    write_bytes(folder / "README.md", _readme(content).encode())


def _mount(scene, sensors):
    """Adds to `scene`, in which `sensors` are mounted, MuJoCo's own sensors with the same readings. Returns {key: notes
    on the reading}."""
    scene.modelname = "bson"
    look = scene.visual
    draw_plainly(look.quality)
    for camera in scene.cameras:
        width, height = camera.resolution
        look.global_.offwidth = max(look.global_.offwidth, int(width))
        look.global_.offheight = max(look.global_.offheight, int(height))
    return {
        sensor.key: {"kind": type(sensor).__name__, "shape": list(sensor.space.shape), **sensor.export(scene, _ROBOT)}
        for sensor in sensors
    }


def _suit_mjx(scene):
    """Replaces in `scene` the features that MJX on JAX lacks: contacts of cylinders with boxes, and contacts without
    friction."""
    for geom in scene.geoms:
        if geom.name.startswith("person") and geom.type == mujoco.mjtGeom.mjGEOM_CYLINDER:
            geom.type = mujoco.mjtGeom.mjGEOM_CAPSULE  # as long, and round beyond: equal along the cylinder's height
        elif geom.condim == 1:
            geom.condim, geom.friction = 3, [_FRICTIONLESS] * 3


def _start(scene, world):
    """Adds the keyframe of the start of `world`'s episode."""
    boxes = world.boxes[0]
    for number, box in enumerate(boxes):  # boxes are right without the keyframe, too
        scene.body(f"box{number}").pos[:2], scene.body(f"box{number}").quat = box[:2], yaw_quaternion(box[4])
    height = [scene.body(f"box{number}").pos[2] for number in range(len(boxes))]
    places = np.concatenate([boxes[:, :2], np.reshape(height, (-1, 1))], axis=-1)
    return {"qpos": world.qpos[0].copy(), "mpos": places.ravel(), "mquat": yaw_quaternion(boxes[:, 4]).ravel()}


def _robot_notes(model, world):
    """The robot's part of episode.json."""
    described, config = robot.describe(world.config.robot), world.config.robot
    first = 3 * world.config.people
    actuators = robot.wheel_actuators(model, described)
    wheels = [
        {
            "joint": f"{_ROBOT}/{wheel}",
            "ctrl": int(ctrl),
            "side": "left" if wheel in described.left else "right",
            "sign": sign,
        }
        for wheel, ctrl, sign in zip(described.wheels, actuators, described.forwards, strict=True)
    ]
    return {
        "name": config.name,
        "body": model.body(model.jnt_bodyid[model.joint(_ROBOT).id]).name,
        "start": world.pose[0].tolist(),
        "goal": world.goal[0].tolist(),
        "qpos": [first, first + 7],
        "qvel": [first, first + 6],
        "wheels": wheels,
        "max_speed": config.max_speed,
        "max_yaw_rate": config.max_yaw_rate,
        "effective_track": config.effective_track,
        "rolling_radius": config.rolling_radius,
    }


_README = """\
# {title}

Written by `{command}`; `episode.json` tells of it all. Units are metres, radians and seconds.

- `scene.xml`: as the project simulates and senses it, for MuJoCo and MJX-Warp. No sensor sees the robot, so it is not
  drawn.
- `scene_mjx.xml`: the same for MJX on JAX, which has no contact of cylinders with boxes: people are capsules, as long
  as the cylinders, and round beyond.
- `view.xml`: as it looks, from the episode's start, for the viewer: `python -m mujoco.viewer --mjcf=view.xml`. It has
  no beams: they would see the robot.

All have the same `qpos`, `ctrl` and keyframe `start`. People are cylinders of radius {radius} m and height {height} m
on velocity actuators. They touch each other and walls through a hidden sphere, the robot with the cylinder.

```python
import json
import mujoco
import numpy as np

episode = json.load(open("episode.json"))
model = mujoco.MjModel.from_xml_path("scene.xml")
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
mujoco.mj_forward(model, data)  # makes sensordata current


unmarked = mujoco.MjvOption()  # MuJoCo would draw the beams of rangefinders into pictures
unmarked.flags[mujoco.mjtVisFlag.mjVIS_RANGEFINDER] = False


def read():
    reading = {{}}
{reading}    return reading


def drive(v, w):  # speed ahead and yaw rate
    robot = episode["robot"]
    for wheel in robot["wheels"]:
        side = -1 if wheel["side"] == "left" else 1
        speed = v + side * w * robot["effective_track"] / 2
        data.ctrl[wheel["ctrl"]] = wheel["sign"] * speed / robot["rolling_radius"]


def walk(velocity):  # of each person: x, y [m/s] in the world frame, and the yaw rate
    data.ctrl[: 3 * episode["people"]["number"]] = np.ravel(velocity)


first = read()
drive(1.0, 0.0)
for _ in range(episode["decisions_per_control"]):  # people decide more often than the robot, if this is above 1
    walk(np.zeros((episode["people"]["number"], 3)))
    mujoco.mj_step(model, data, nstep=episode["steps_per_decision"])
mujoco.mj_forward(model, data)
after = read()
```

{notes}
"""
_READING = {
    "beams": """\
    of = episode["readings"]["{key}"]
    beams = data.sensordata[of["address"] :][: of["sensors"]].reshape(of["shape"])
    reading["{key}"] = np.where(beams < 0, of["range_max"], np.maximum(beams, of["range_min"]))  # -1: nothing was hit
""",
    "imu": """\
    of = episode["readings"]["{key}"]
    reading["{key}"] = np.concatenate([data.sensor(of[kind]).data for kind in ("accelerometer", "gyro")])
""",
    "picture": """\
    of = episode["readings"]["{key}"]
    with mujoco.Renderer(model, of["height"], of["width"]) as renderer:  # without a display it needs MUJOCO_GL=egl
        renderer.update_scene(data, of["camera"], unmarked)
        reading["{key}"] = renderer.render()
""",
    "depth": """\
    of = episode["readings"]["{key}"]
    with mujoco.Renderer(model, of["height"], of["width"]) as renderer:
        renderer.enable_depth_rendering()
        renderer.update_scene(data, of["camera"], unmarked)
        reading["{key}"] = renderer.render().clip(of["range_min"], of["range_max"])  # along the optical axis
""",
}
_NOTES = {
    "beams": "`robot/KEY/...` are the beams: for each a site, whose z axis looks along it, and a rangefinder there, "
    "which reads [m] up to range_max, and -1 where nothing is hit. In 2D the first is the rightmost; in 3D they are "
    "rows, from the lowest, of columns, from straight back over the robot's right. Where `model.opt.disableflags` has "
    "`mujoco.mjtDisableBit.mjDSBL_SENSOR` during mj_step, and not in mj_forward, steps are quick.",
    "imu": "`robot/imu_accelerometer` and `robot/imu_gyro`: in the robot's frame, x ahead, y left, z up.",
    "picture": "Cameras have their resolution, field and near plane in the files. Row 0 of a picture is the highest. "
    "`scene.xml` has no shadows and no anti-aliasing, as the project's cameras draw.",
}
_NOTES["depth"] = _NOTES["picture"]


def _readme(content):
    """The README.md of a folder, as text. content: its episode.json."""
    kinds = {key: reading.get("read_as") for key, reading in content["readings"].items()}
    notes = {_NOTES[kind]: None for kind in kinds.values() if kind}
    if own := [key for key, kind in kinds.items() if kind is None]:
        notes[f"Only the project itself reads {', '.join(own)}."] = None
    notes["Readings have no noise; a sensor's `noise` is what the project adds, a standard deviation."] = None
    people, size = content["people"]["number"], content["config"]["map_size"]
    where = f"among {people} people on {size:g} x {size:g} m"
    return _README.format(
        title=f"A robot, {content['robot']['name']}, {where}, seed {content['seed']}",
        command=content["command"],
        radius=content["people"]["radius"],
        height=HEIGHT,
        reading="".join(_READING[kind].format(key=key) for key, kind in kinds.items() if kind),
        notes="\n\n".join(notes),
    )
