"""What is refused of a robot's model: files that MuJoCo can't read, and bodies that no real robot has."""

import pathlib
from xml.etree import ElementTree

import mujoco
import numpy as np

from bson.robot.description import Robot
from bson.robot.model import add_robot
from macid.documents import check_readable, read_bytes, shown, shown_path
from macid.scene import base_spec

MODEL_BYTES = 1 << 24  # of a model's file, at most
EXPAND = (
    " Expand it first: `xacro FILE.urdf.xacro > FILE.urdf`, and let a .toml description name FILE.urdf as its model."
)
_MASS = (0.1, 1000.0)  # of a robot [kg]
_GYRATION = (0.0005, 2.0)  # radius of gyration of a body about any of its axes [m]
_SIZE = (0.001, 2.0)  # radius of a shape that touches the floor [m]
_MOST_ASSET = 1 << 28  # of a mesh or texture of a model [bytes]
_MOST_INCLUDES = 16  # levels of includes inside each other
_ASSET_FOLDERS = ("assetdir", "meshdir", "texturedir")  # of an MJCF's <compiler>
_MOST_COPIES = 4096  # of an element of a model, or sides of a texture [pixels]


def refuse_odd_models(content: bytes, folder: pathlib.Path, depth: int = 0) -> None:
    """Raises ValueError for a model (bytes) in `folder`, or a file that it includes, that needs a reader or more room
    than MuJoCo has."""
    if depth > _MOST_INCLUDES:
        raise ValueError(f"its <include>s are nested more than {_MOST_INCLUDES} deep.")
    if b"<xacro:" in content:
        raise ValueError(f"the model has xacro's macros, which MuJoCo can't read.{EXPAND}")
    try:
        tree = ElementTree.fromstring(content)
    except (ElementTree.ParseError, ValueError):  # MuJoCo's own message is better
        return
    places = {"", *(value for each in tree.iter("compiler") for key in _ASSET_FOLDERS if (value := each.get(key)))}
    copies = 1.0
    for element in tree.iter():
        mesh = element.get("filename") or element.get("file") or ""
        named = {mesh, mesh.replace("\\", "/").rpartition("/")[2]} - {""}  # names in a URDF lose their folders
        for file in [folder / place / name for place in sorted(places) for name in sorted(named)]:
            if element.tag == "include" and file.exists():
                refuse_odd_models(read_bytes(file, "included model", MODEL_BYTES), folder, depth + 1)
            elif file.exists():
                check_readable(file, f"<{element.tag}>", _MOST_ASSET)
        if mesh.lower().endswith(".dae"):
            raise ValueError(
                f"MuJoCo can't read the mesh {shown_path(mesh)}: convert it to .obj or .stl (Blender and MeshLab do), "
                "and name that in the model."
            )
        for key in ("width", "height", "nrow", "ncol", "count"):
            for word in (element.get(key) or "").split()[:3]:
                if word.isdigit() and int(word[:9]) > _MOST_COPIES:
                    raise ValueError(f"<{element.tag} {key}=...> is at most {_MOST_COPIES}, not {shown(word)}.")
                if word.isdigit() and key == "count":
                    copies *= max(1, int(word))
    if copies > 10 * _MOST_COPIES:
        raise ValueError(f"the model repeats elements {copies:.3g} times; {10 * _MOST_COPIES} are possible.")


def forwards(robot: Robot) -> tuple[float, ...]:
    """For each wheel 1 where a positive turn of its hinge drives ahead, -1 where it drives back. Raises ValueError for
    a robot that can't be built, or whose wheels are not left and right on axles across it."""
    spec = base_spec(20.0)
    add_robot(spec, robot)
    model = spec.compile()
    _refuse_odd_bodies(model)
    data = mujoco.MjData(model)
    data.qpos[:7] = 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
    mujoco.mj_kinematics(model, data)
    found = []
    for wheel in robot.wheels:
        joint = model.joint(f"robot/{wheel}")
        if joint.type[0] != mujoco.mjtJoint.mjJNT_HINGE or model.jnt_limited[joint.id]:
            raise ValueError(f"joint '{wheel}' is no free-running hinge (URDF: continuous), as a wheel's must be.")
        across, left = data.xaxis[joint.id, 1], data.xanchor[joint.id, 1] > 0
        if abs(across) < 0.99:
            raise ValueError(f"the axle of wheel '{wheel}' does not lie across the robot, along y.")
        if left != (wheel in robot.left):
            raise ValueError(f"wheel '{wheel}' is on the {'left' if left else 'right'}, y being left.")
        found.append(float(np.sign(across)))
    return tuple(found)


def _refuse_odd_bodies(model):
    """Raises ValueError where the bodies of a compiled model, a robot alone in its world, are outside the range of real
    robots."""
    total = float(model.body_mass.sum())
    if not _MASS[0] <= total <= _MASS[1]:
        raise ValueError(f"its mass is {total:g} kg; it must be from {_MASS[0]:g} to {_MASS[1]:g} kg.")
    for index in range(1, model.nbody):
        body, mass = model.body(index).name.removeprefix("robot/"), model.body_mass[index]
        if mass == 0:  # a body that it carries has a mass, or MuJoCo would have refused it
            continue
        gyration = np.sqrt(model.body_inertia[index] / mass)
        if not ((gyration >= _GYRATION[0]) & (gyration <= _GYRATION[1])).all():
            inertia = ", ".join(f"{one:.3g}" for one in model.body_inertia[index])
            raise ValueError(
                f"body '{body}' of {mass:.3g} kg has the inertia {inertia} kg m2; its radii of gyration must be from "
                f"{_GYRATION[0]:g} to {_GYRATION[1]:g} m."
            )
        if not (np.abs(model.body_pos[index]) <= 10.0).all():
            raise ValueError(f"body '{body}' is more than 10 m from what carries it.")
    for index in np.flatnonzero(model.geom_contype | model.geom_conaffinity):
        body, radius = model.geom_bodyid[index], model.geom_rbound[index]
        if body and not _SIZE[0] <= radius <= _SIZE[1]:
            body = model.body(body).name.removeprefix("robot/")
            raise ValueError(
                f"body '{body}' touches with a shape of radius {radius:.3g} m; it must be from {_SIZE[0]:g} to "
                f"{_SIZE[1]:g} m."
            )
    for what in ("dof_damping", "dof_armature", "dof_frictionloss", "jnt_stiffness", "actuator_gainprm"):
        most = np.abs(getattr(model, what)).max(initial=0.0)
        if not most <= 1e6:
            raise ValueError(f"its {what} must be numbers of at most 1e6, not {most:.3g}.")
