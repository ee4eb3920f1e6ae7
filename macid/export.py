"""Scenes as MJCF files that MuJoCo, its viewer and MJX load without this project, and what else a folder tells.

`write_scene` is for any scene; `export` writes a crowd's. A file has the scene to the last bit: what MuJoCo reads from
it is compared with what it was written from.
"""

import contextlib
import ctypes
import dataclasses
import functools
import os
import pathlib
import re
import shutil
from xml.etree import ElementTree

import jax
import mujoco
import numpy as np

from macid.crowd import Crowd, CrowdConfig
from macid.drawing.colours import lcf_colour
from macid.files import UsageError, named, versions, whole_folder, write_bytes, write_json
from macid.geometry import rotate
from macid.layout import Layout
from macid.scene import crowd_spec
from macid.state import HEIGHT, PAPER_TRAITS, PHYSICS_STEP, RADIUS, RESPONSE, Traits

START = "start"  # the keyframe in each file
ASSETS = "assets"  # the folder beside the files, for meshes and textures
PACKAGES = ("bson-macid", "mujoco")  # whose versions a folder notes
_DIGITS = 17  # that tell a float64 from all others
_NUMBER = re.compile(r"-?\d+\.\d+(e[-+]\d+)?")
_KINDS = (  # of elements whose values may be a class's
    *("bodies", "joints", "geoms", "sites", "cameras", "lights", "materials", "meshes", "textures"),
    *("actuators", "tendons", "equalities", "pairs"),
)
_UNWRITTEN = (  # without effect: sizes that a shape does not have (others are in geom_aabb), and where files are
    *("site_size", "geom_size"),
    *("paths", "mesh_pathadr", "tex_pathadr", "hfield_pathadr", "skin_pathadr"),
)
_FILES = {"mesh": "meshdir", "hfield": "meshdir", "texture": "texturedir"}  # elements that name files, and their folder


def write_scene(
    spec: mujoco.MjSpec, file: str | os.PathLike[str], start: dict, sources: str | os.PathLike[str] | None = None
) -> mujoco.MjModel:
    """Writes the scene `spec` as the MJCF `file` and returns its model; `spec` is no longer of use then.

    start: the fields of the keyframe START, as MjSpec.add_key has them. sources: the folder of the model that names
    meshes and textures; what it names is copied to the folder ASSETS beside `file`. Raises UsageError where MuJoCo does
    not read the same scene from the file.
    """
    file = pathlib.Path(file)
    spec.add_key(name=START, **start)
    for element in (each for kind in _KINDS for each in getattr(spec, kind) if each != spec.worldbody):
        element.classname = spec.default  # a class has the names of a robot's materials without the robot's
    model = spec.compile()
    with _all_digits():
        tree = ElementTree.fromstring(spec.to_xml())
    for element in tree.iter():
        for key, value in element.items():
            if key.startswith("file") and element.tag in _FILES:
                value = _copied(spec, element, value, sources, file.parent / ASSETS)
            elif key != "name":
                value = " ".join(map(_shortest, value.split()))
            element.set(key, value)
    write_bytes(file, ElementTree.tostring(tree))
    try:
        read = mujoco.MjModel.from_xml_path(str(file))
    except ValueError as error:
        raise UsageError(f"MuJoCo can't write this scene as MJCF: {error}") from None
    if different := differences(model, read):
        fields = ", ".join(different)
        raise UsageError(f"MuJoCo {mujoco.__version__} reads another scene from its MJCF: {fields} differ.")
    return read


def differences(model: mujoco.MjModel, other: mujoco.MjModel) -> list[str]:
    """The fields in which two models differ by more than the last bits."""
    found = []
    for field in dir(model):
        value, its = (getattr(each, field) for each in (model, other))
        if isinstance(value, np.ndarray) and field not in _UNWRITTEN and not field.startswith("_"):
            same = value.shape == its.shape and np.allclose(value, its, rtol=1e-12, atol=1e-12, equal_nan=True)
            found += [] if same else [field]
    return found


@contextlib.contextmanager
def _all_digits():
    """Within, MuJoCo writes numbers whole; it writes six digits otherwise, and offers no other way to say so."""
    library = ctypes.CDLL(mujoco._functions.__file__)
    if not hasattr(library, "_mjPRIVATE__set_xml_precision"):
        raise UsageError(f"MuJoCo {mujoco.__version__} can't write a scene whole: use 3.17.")
    before = library._mjPRIVATE__get_xml_precision()
    library._mjPRIVATE__set_xml_precision(_DIGITS)
    try:
        yield
    finally:
        library._mjPRIVATE__set_xml_precision(before)


def _shortest(word):
    """`word`, or the fewest digits that are the same number, if it is one of many digits."""
    return repr(float(word)) if len(word) >= _DIGITS and _NUMBER.fullmatch(word) else word


def _copied(spec, element, value, sources, folder):
    """The file `value` that an asset names, copied to `folder`: its name there."""
    kind = element.tag
    there = getattr(getattr(spec, kind)(element.get("name")).compiler, _FILES[kind])
    places = [pathlib.Path(sources or ".", there, name) for name in (value, pathlib.PurePath(value).name)]
    source = next((place for place in places if place.is_file()), None)
    if source is None:
        raise UsageError(f"The {kind} '{element.get('name')}' needs the file {named(places[0])}, and there is none.")
    folder.mkdir(exist_ok=True)
    number, content = 0, source.read_bytes()
    target = folder / source.name
    while target.exists() and target.read_bytes() != content:  # another file of this name
        number += 1
        target = folder / f"{number}-{source.name}"
    shutil.copyfile(source, target)
    return f"{ASSETS}/{target.name}"


def stand_at(spec: mujoco.MjSpec, people: np.ndarray, lcf: np.ndarray) -> None:
    """Makes the poses `people` (K, 3) [m, m, rad] those in which a viewer finds people when it opens `spec`, and
    colours them by their `lcf` (K,). What qpos means stays as it was."""
    for index, ((x, y, yaw), colour) in enumerate(zip(people, lcf_colour(lcf), strict=True)):
        name = f"person{index}"
        spec.body(name).pos = [x, y, HEIGHT / 2]
        spec.body(name).quat = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
        spec.geom(f"{name}/cylinder").rgba = [*colour, 1.0]
        spec.joint(f"{name}/yaw").ref = np.rad2deg(yaw) if spec.compiler.degree else yaw
        for axis, place, direction in (("x", x, [1.0, 0.0]), ("y", y, [0.0, 1.0])):
            joint = spec.joint(f"{name}/{axis}")
            joint.ref = place
            joint.axis = [*rotate(np.array(direction), np.array(-yaw)), 0.0]  # the world's, in the turned body's frame


def people_notes(
    people: np.ndarray, goals: np.ndarray, lcf: np.ndarray, radius: float = RADIUS, traits: Traits = PAPER_TRAITS
) -> dict:
    """What an episode's JSON says of people: at `people` (K, 3), on their way to `goals` (K, 2), with `lcf` (K,),
    everybody's `radius` [m], and `traits` (K,), of which what is the paper's is left out."""
    own = {name: getattr(traits, name) for name in ("preferred_speed", "max_speed", "group")}
    return {
        "number": len(people),
        "bodies": "person{k}",
        "qpos": "qpos[3 k : 3 k + 3] of person k: x, y [m], yaw [rad]; qvel: as many, [m/s] and [rad/s]; world frame",
        "ctrl": "ctrl[3 k : 3 k + 3] of person k: velocity x, y [m/s] in the world frame, yaw rate [rad/s]",
        "response": RESPONSE,
        "radius": radius,
        "height": HEIGHT,
        "start": _numbers(people),
        "goals": _numbers(goals),
        "lcf": _numbers(lcf),
        **{name: np.asarray(value).tolist() for name, value in own.items() if value is not None},
    }


def box_notes(boxes: np.ndarray) -> dict:
    """What an episode's JSON says of `boxes` (B, 5)."""
    return {
        "bodies": "box{b}; the first four are the outer walls",
        "columns": "x, y, half x, half y, yaw",
        "rows": _numbers(boxes),
    }


def _numbers(array):
    return np.asarray(array, float).tolist()


_README = """\
# {title}

Written by `{command}`; `episode.json` tells of it all. Units are metres, radians and seconds.

- `scene.xml`: as the project simulates it.
- `view.xml`: as it looks, from the episode's start, for the viewer: `python -m mujoco.viewer --mjcf=view.xml`.

Each has the keyframe `start` and loads in MJX. People are cylinders of radius {radius} m and height {height} m on
velocity actuators. They touch each other, walls and obstacles through a hidden sphere.

```python
import json
import mujoco
import numpy as np

episode = json.load(open("episode.json"))
model = mujoco.MjModel.from_xml_path("scene.xml")
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
mujoco.mj_forward(model, data)
people = data.qpos[: 3 * episode["people"]["number"]].reshape(-1, 3)  # x, y, yaw: a view, current after each step
walk = data.ctrl[: 3 * episode["people"]["number"]].reshape(-1, 3)  # velocity x, y and yaw rate, world frame
towards = np.array(episode["people"]["goals"]) - people[:, :2]
walk[:, :2] = 1.3 * towards / np.linalg.norm(towards, axis=1, keepdims=True)
```

Until the next decision, {period} s later, `ctrl` stays as it is: `mujoco.mj_step(model, data, nstep={steps})`.
"""


def export(
    layout: Layout,
    config: CrowdConfig,
    seed: int | tuple[int, ...],
    out: str | pathlib.Path,
    command: str = "macid.export.export()",
) -> pathlib.Path:
    """Writes the crowd of `config` on `layout`, as `seed` draws its episode, to the folder `out`, which is new or
    empty: scene.xml, view.xml, episode.json, README.md. Returns the folder.

    seed: of a numpy Generator: a number, or several. command: that made it, for people to read. Raises UsageError,
    NoFreeSpace.
    """
    with whole_folder(out) as folder:
        crowd = Crowd(layout, config)
        episode = crowd.reset(np.random.default_rng(seed))
        qpos = np.asarray(episode.physics.qpos[0], float)
        people, goals, lcf = qpos.reshape(-1, 3), np.asarray(episode.goals[0]), np.asarray(episode.lcf[0])
        traits = jax.tree.map(lambda leaf: np.asarray(leaf[0]), episode.traits)
        spec = functools.partial(crowd_spec, layout, config.number, config.person)
        model = write_scene(spec(), folder / "scene.xml", {"qpos": qpos})
        view = spec()
        stand_at(view, people, lcf)
        write_scene(view, folder / "view.xml", {"qpos": qpos})
        content = {
            "command": command,
            "versions": versions(*PACKAGES),
            "seed": np.asarray(seed).tolist(),
            "config": dataclasses.asdict(config),
            "map": {"name": layout.name, "size": layout.size},
            "physics_step": PHYSICS_STEP,
            "steps_per_decision": config.substeps,
            "sizes": {name: int(getattr(model, name)) for name in ("nq", "nv", "nu", "nsensordata")},
            "people": people_notes(people, goals, lcf, config.person.radius, traits),
            "boxes": box_notes(layout.boxes),
        }
        text = _README.format(
            title=f"{config.number} people on the map '{layout.name}', seed {np.ravel(seed)[0]}",
            command=command,
            radius=config.person.radius,
            height=HEIGHT,
            period=config.period,
            steps=config.substeps,
        )
        write_json(folder / "episode.json", content)
        write_bytes(folder / "README.md", text.encode())
    return pathlib.Path(out)
