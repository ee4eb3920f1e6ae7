"""Layout -> MjSpec: floor, walls, obstacles, and cylinder pedestrians on velocity actuators.

A pedestrian has two slides (world x, y) and a yaw hinge, and a velocity actuator for each; pedestrians come first, so
the first 3 K entries of qpos, qvel and ctrl are theirs, (K, 3) after a reshape. Among themselves and with walls they
touch through a hidden sphere of their radius: the same planar contact as the upright cylinder's, at a third of its
cost, and MJX has it. The visible cylinder is what rays, cameras and a robot meet.
"""

import dataclasses
from typing import Any

import mujoco
import numpy as np

from macid.documents import is_number, shown
from macid.layout import Layout
from macid.state import HEIGHT, PHYSICS_STEP, RADII, RADIUS, RESPONSE

# Contact bits: (contype, conaffinity) of each shape. Two shapes touch where one's type meets the other's affinity.
BIT_PERSON, BIT_SOLID, BIT_FLOOR = 1, 2, 4
PROXY_CONTACT = (BIT_PERSON, BIT_PERSON)  # people with people and walls
CYLINDER_CONTACT = (BIT_SOLID, 0)  # people with a robot
WALL_CONTACT = (BIT_PERSON | BIT_SOLID, BIT_PERSON)
FLOOR_CONTACT = (BIT_FLOOR, 0)

WALL_HEIGHT = 1.2  # [m]
OUTER_WALL_HEIGHT = 1.6  # [m]
CAMERA_NEAR = 0.005  # a camera sees nothing closer; a robot's camera lies less than 2 cm behind its front [m]
_PROXY_HEIGHT = 0.5  # height of the sphere's centre: below every wall's top [m]

FLOOR_RGBA = (0.80, 0.81, 0.82, 1.0)
WALL_RGBA = (0.93, 0.93, 0.91, 1.0)
OBSTACLE_RGBA = (0.60, 0.54, 0.47, 1.0)
PERSON_RGBA = (0.36, 0.62, 0.40, 1.0)


@dataclasses.dataclass(frozen=True)
class PersonConfig:
    """A pedestrian's body. The actuators reach a commanded velocity with the time constant `response`, as long as they
    need no more than `max_force` for it; Unity, the paper's engine, sets velocities at once. Raises ValueError for a
    radius outside RADII."""

    mass: float = 75.0  # [kg]
    response: float = RESPONSE  # [s]
    max_force: float = 400.0  # of each slide's actuator [N]: as hard as a person can push
    friction: float = 0.4  # sliding, with people and walls
    radius: float = RADIUS  # of everybody [m]; real shoulders are nearer 0.2

    def __post_init__(self):
        check_radius("radius", self.radius)


def check_radius(name: str, radius: Any) -> None:
    """Raises ValueError, about `name`, unless `radius` [m] is one that people may have."""
    if not is_number(radius, *RADII):
        raise ValueError(f"{name} must be a number from {RADII[0]:g} to {RADII[1]:g} m, not {shown(radius)}.")


PERSON = PersonConfig()  #: a person where nothing else is said


def base_spec(size: float) -> mujoco.MjSpec:
    """An empty world with the project's physics options, lights, sky and a floor of side `size` [m]."""
    spec = mujoco.MjSpec()
    spec.modelname = "crowd"
    spec.option.timestep = PHYSICS_STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.stat.extent = size / 2
    spec.stat.center = [0, 0, 0.5]
    spec.visual.map.znear = CAMERA_NEAR / (size / 2)
    spec.visual.map.zfar = 4.0 * size / (size / 2)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1920, 1080
    spec.visual.quality.shadowsize = 4096
    spec.visual.headlight.ambient = [0.48, 0.48, 0.50]
    spec.visual.headlight.diffuse = [0.30, 0.30, 0.30]
    spec.visual.headlight.specular = [0.05, 0.05, 0.05]
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.75, 0.83, 0.92],
        rgb2=[0.96, 0.97, 0.98],
        width=128,
        height=768,
    )
    spec.add_texture(
        name="tiles",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        mark=mujoco.mjtMark.mjMARK_EDGE,
        rgb1=[0.60, 0.61, 0.62],
        rgb2=[0.65, 0.66, 0.67],
        markrgb=[0.53, 0.54, 0.55],
        width=256,
        height=256,
    )
    tiles = spec.add_material(name="tiles", reflectance=0.0, specular=0.1, shininess=0.1)
    tiles.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    tiles.texrepeat = [1.0, 1.0]  # a plane of 2 m holds four tiles: a tile is a metre
    tiles.texuniform = True
    for name, rgba in (("wall", WALL_RGBA), ("obstacle", OBSTACLE_RGBA)):
        spec.add_material(name=name, rgba=rgba, specular=0.1, shininess=0.1)
    world = spec.worldbody
    world.add_light(
        name="sun",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[0, 0, size],
        dir=[0.35, 0.25, -0.9],
        diffuse=[0.46, 0.45, 0.42],
        specular=[0.1, 0.1, 0.1],
        castshadow=True,
    )
    world.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[size / 2 + 1.0] * 3,  # the third is how finely it is drawn: one square, as lit from afar it is all alike
        material="tiles",
        contype=FLOOR_CONTACT[0],
        conaffinity=FLOOR_CONTACT[1],
    )
    return spec


def add_people(spec: mujoco.MjSpec, number: int, config: PersonConfig = PersonConfig()) -> None:
    """Adds `number` pedestrians, `person0` first, to a spec that has no joint yet. They start at the origin."""
    if spec.joints:
        raise ValueError("Pedestrians come first: add them before anything else that has joints.")
    radius = config.radius
    inertia = config.mass * radius**2 / 2
    sway = config.mass * (3 * radius**2 + HEIGHT**2) / 12
    for index in range(number):
        name = f"person{index}"
        body = spec.worldbody.add_body(name=name, pos=[0, 0, HEIGHT / 2])
        body.mass, body.inertia, body.explicitinertial = config.mass, [sway, sway, inertia], True
        body.ipos, body.iquat = [0, 0, 0], [1, 0, 0, 0]
        for axis, kind, direction, gain, limit in (
            ("x", mujoco.mjtJoint.mjJNT_SLIDE, [1, 0, 0], config.mass / config.response, config.max_force),
            ("y", mujoco.mjtJoint.mjJNT_SLIDE, [0, 1, 0], config.mass / config.response, config.max_force),
            ("yaw", mujoco.mjtJoint.mjJNT_HINGE, [0, 0, 1], inertia / config.response, None),
        ):
            body.add_joint(name=f"{name}/{axis}", type=kind, axis=direction)
            motor = spec.add_actuator(
                name=f"{name}/{axis}",
                target=f"{name}/{axis}",
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                gaintype=mujoco.mjtGain.mjGAIN_FIXED,
                biastype=mujoco.mjtBias.mjBIAS_AFFINE,
                gainprm=[gain] + [0.0] * 9,
                biasprm=[0.0, 0.0, -gain] + [0.0] * 7,
            )
            if limit is not None:
                motor.forcelimited, motor.forcerange = True, [-limit, limit]
        body.add_geom(
            name=f"{name}/cylinder",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[radius, HEIGHT / 2, 0],
            rgba=PERSON_RGBA,
            contype=CYLINDER_CONTACT[0],
            conaffinity=CYLINDER_CONTACT[1],
            friction=[config.friction, 0.005, 0.0001],
        )
        body.add_geom(
            name=f"{name}/proxy",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[radius, 0, 0],
            pos=[0, 0, _PROXY_HEIGHT - HEIGHT / 2],
            rgba=[0, 0, 0, 0],  # invisible, to rays too
            group=3,
            contype=PROXY_CONTACT[0],
            conaffinity=PROXY_CONTACT[1],
            friction=[config.friction, 0.005, 0.0001],
        )


def add_boxes(spec: mujoco.MjSpec, boxes: np.ndarray, movable: bool = False) -> None:
    """Adds `boxes` (B, 5), the first four as outer walls, each in a body of its own: `box0`, `box1`, ...

    movable: as mocap bodies, whose pose is part of the state (a static geom that moves at run time would leave
    MuJoCo's bounding volumes stale).
    """
    for index, (x, y, half_x, half_y, yaw) in enumerate(np.asarray(boxes, dtype=float)):
        half_z = (OUTER_WALL_HEIGHT if index < 4 else WALL_HEIGHT) / 2
        body = spec.worldbody.add_body(
            name=f"box{index}", pos=[x, y, half_z], quat=[np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)], mocap=movable
        )
        body.add_geom(
            name=f"box{index}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[half_x, half_y, half_z],
            material="wall" if index < 4 else "obstacle",
            contype=WALL_CONTACT[0],
            conaffinity=WALL_CONTACT[1],
            friction=[0.0, 0.005, 0.0001],  # MuJoCo takes the greater of a pair's: here the person's or the robot's
        )


def crowd_spec(layout: Layout, number: int, config: PersonConfig = PersonConfig()) -> mujoco.MjSpec:
    """The scene of a crowd alone: `number` pedestrians on `layout`, whose boxes stand still.

    Solver limits are for MJX, which unrolls its iterations and keeps a row for each possible contact; MuJoCo's own
    solver converges well below them.
    """
    spec = base_spec(layout.size)
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    spec.option.iterations, spec.option.ls_iterations = 8, 8
    add_people(spec, number, config)
    add_boxes(spec, layout.boxes)
    for name in ("max_contact_points", "max_geom_pairs"):
        spec.add_numeric(name=name, data=[max(16, 8 * number)])
    return spec
