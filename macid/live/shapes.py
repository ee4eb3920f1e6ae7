"""What a MuJoCo model looks like, in a page: its own shapes, people's figures and goals as films have them.

Shapes of one kind are one node of the page with many copies, each with its own place, turn, size and colour: a crowd of
200 is four nodes. Places are in the world's frame, under the node WORLD, which is moved so that a camera follows.
"""

from typing import Any

import mujoco
import numpy as np
import trimesh
import trimesh.visual
from scipy.spatial.transform import Rotation

from macid import geometry
from macid.drawing.colours import GOAL_RGB
from macid.drawing.figures import GOAL, figure

WORLD = "/world"
_GONE = -1000.0  # height at which what is not there is put [m]
_PLANE, _SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX, _MESH = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"))
    for kind in ("PLANE", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH")
)
_GROUPS = 3  # MuJoCo draws the groups below it
_DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)  # of a geom that leaves its colour to its material


def _unit(kind: int) -> trimesh.Trimesh:
    """The shape that a scale makes to any of its kind: half lengths, or radius and half length, of 1 m."""
    if kind == _BOX:
        return trimesh.creation.box(extents=(2, 2, 2))
    if kind in (_SPHERE, _ELLIPSOID):
        return trimesh.creation.icosphere(subdivisions=2)
    if kind == _CYLINDER:
        return trimesh.creation.cylinder(radius=1, height=2, sections=24)
    raise ValueError(f"There is no shape for MuJoCo's kind of geom {kind}.")


def _scale(kind: int, sizes: np.ndarray) -> np.ndarray:
    """The scales (N, 3) of `_unit` for geoms with the `sizes` (N, 3) as MuJoCo has them."""
    if kind == _SPHERE:
        return np.repeat(sizes[:, :1], 3, axis=1)
    return sizes[:, [0, 0, 1]] if kind == _CYLINDER else sizes


class Batch:
    """`number` copies of a shape in a page.

    scene: viser's, of the page. name: the node's, under WORLD. mesh: the shape. scales, colours (number, 3), alphas
    (number,).
    """

    def __init__(
        self,
        scene: Any,
        name: str,
        mesh: trimesh.Trimesh,
        scales: np.ndarray,
        colours: np.ndarray,
        alphas: np.ndarray | None = None,
        flat: bool = False,
        shadow: bool = True,
    ):
        number = len(scales)
        self.node = scene.add_batched_meshes_simple(
            f"{WORLD}/{name}",
            np.asarray(mesh.vertices, np.float32),
            np.asarray(mesh.faces, np.uint32),
            np.tile(np.array([1.0, 0, 0, 0], np.float32), (number, 1)),
            np.tile(np.array([0, 0, _GONE], np.float32), (number, 1)),
            batched_scales=np.asarray(scales, np.float32),
            batched_colors=_bytes(colours),
            batched_opacities=None if alphas is None or np.all(alphas == 1.0) else np.asarray(alphas, np.float32),
            lod="off",
            flat_shading=flat,
            cast_shadow=shadow,
            receive_shadow=False,
        )

    def place(self, places: np.ndarray, turns: np.ndarray | None = None) -> None:
        """Puts the copies at `places` (N, 3) [m], turned by the quaternions `turns` (N, 4), where given."""
        self.node.batched_positions = np.asarray(places, np.float32)
        if turns is not None:
            self.node.batched_wxyzs = np.asarray(turns, np.float32)

    def paint(self, colours: np.ndarray) -> None:
        """Gives the copies the `colours` (N, 3) in [0, 1]."""
        self.node.batched_colors = _bytes(colours)


def _bytes(colours):
    return np.rint(255 * np.clip(np.asarray(colours, float), 0, 1)).astype(np.uint8)


class Model:
    """The shapes of `model` in a page, but people, whose Figures stand for them.

    The floor and the boxes lie still in an episode (`still`); the rest follows in `move`.
    """

    def __init__(self, scene: Any, model: mujoco.MjModel):
        self.model, self.data = model, mujoco.MjData(model)
        names = [model.body(body).name for body in range(model.nbody)]
        person = np.array([name.startswith("person") for name in names])
        box = np.array([name.startswith("box") for name in names])
        self._boxes = np.flatnonzero(box)
        body = model.geom_bodyid
        seen = (geom_rgba(model)[:, 3] > 0) & (model.geom_group < _GROUPS) & ~person[body]
        for geom in np.flatnonzero(seen & (model.geom_type == _PLANE)):
            _add_floor(scene, model, geom)
        seen &= model.geom_type != _PLANE
        self._still = list(self._batches(scene, "still", np.flatnonzero(seen & box[body])))
        self._moving = list(self._batches(scene, "moving", np.flatnonzero(seen & ~box[body])))

    def _batches(self, scene, name, geoms):
        """(Batch, its geoms) for each kind of shape among `geoms`."""
        model, rgba = self.model, geom_rgba(self.model)
        kinds, sizes = model.geom_type[geoms], model.geom_size[geoms]
        keys = {}
        for geom, kind, size in zip(geoms, kinds.tolist(), sizes, strict=True):
            if kind == _MESH:
                key = kind, int(model.geom_dataid[geom])
            else:  # a capsule of other proportions is another shape
                key = (kind, *size[:2]) if kind == _CAPSULE else (kind,)
            keys.setdefault(key, []).append(geom)
        for number, (key, chosen) in enumerate(keys.items()):
            kind, scales = key[0], np.ones((len(chosen), 3))
            if kind == _MESH:
                mesh = _mesh(model, key[1])
            elif kind == _CAPSULE:
                mesh = trimesh.creation.capsule(radius=key[1], height=2 * key[2])
                mesh.apply_translation([0, 0, -mesh.bounds.mean(axis=0)[2]])
            elif kind in (_BOX, _SPHERE, _ELLIPSOID, _CYLINDER):
                mesh, scales = _unit(kind), _scale(kind, model.geom_size[chosen])
            else:  # heights and signed distances, which no robot or room here is made of
                continue
            colours = rgba[chosen]
            yield Batch(scene, f"{name}{number}", mesh, scales, colours[:, :3], colours[:, 3], kind == _BOX), chosen

    def still(self, boxes: np.ndarray) -> None:
        """Puts the boxes (B, 5) where an episode has them."""
        if self.model.nmocap:
            self.data.mocap_pos[:, :2] = boxes[:, :2]
            self.data.mocap_pos[:, 2] = self.model.body_pos[self._boxes, 2]
            self.data.mocap_quat[:] = geometry.yaw_quaternion(boxes[:, 4])
        mujoco.mj_kinematics(self.model, self.data)
        self._place(self._still)

    def move(self, qpos: np.ndarray) -> None:
        """Puts the bodies where `qpos` (nq,) has them."""
        if not self._moving:
            return
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        self._place(self._moving)

    def _place(self, batches):
        for batch, geoms in batches:
            turns = Rotation.from_matrix(self.data.geom_xmat[geoms].reshape(-1, 3, 3)).as_quat(scalar_first=True)
            batch.place(self.data.geom_xpos[geoms], turns)


def geom_rgba(model: mujoco.MjModel) -> np.ndarray:
    """The colours (ngeom, 4) of a model's geoms in [0, 1], as MuJoCo draws them: the material's, unless the geom has
    one of its own."""
    rgba = model.geom_rgba.astype(float)
    for geom in np.flatnonzero(model.geom_matid >= 0):
        if np.allclose(rgba[geom], _DEFAULT_RGBA):
            rgba[geom] = model.mat_rgba[model.geom_matid[geom]]
    return rgba


def _mesh(model, number):
    """A mesh of the model."""
    vertices = model.mesh_vert[model.mesh_vertadr[number] :][: model.mesh_vertnum[number]]
    faces = model.mesh_face[model.mesh_faceadr[number] :][: model.mesh_facenum[number]]
    return trimesh.Trimesh(vertices, faces, process=False)


def _add_floor(scene, model, geom):
    """The floor: a plane with its material's picture, or its colour."""
    half_x, half_y = (side or 100.0 for side in model.geom_size[geom][:2])  # 0: without an end
    corners = np.array([[-half_x, -half_y, 0], [half_x, -half_y, 0], [half_x, half_y, 0], [-half_x, half_y, 0]])
    plane = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    material = model.geom_matid[geom]
    texture = -1 if material < 0 else model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB]
    if texture < 0:
        plane.visual = trimesh.visual.ColorVisuals(plane, face_colors=_bytes(geom_rgba(model)[geom]))
    else:
        from PIL import Image

        width, height, channels = model.tex_width[texture], model.tex_height[texture], model.tex_nchannel[texture]
        first = model.tex_adr[texture]
        pixels = model.tex_data[first : first + width * height * channels].reshape(height, width, channels)
        repeat = model.mat_texrepeat[material] / 2  # a plane of 2 m has the picture so often
        finish = trimesh.visual.material.PBRMaterial(
            baseColorTexture=Image.fromarray(pixels[::-1].astype(np.uint8)), metallicFactor=0.0, roughnessFactor=1.0
        )
        plane.visual = trimesh.visual.TextureVisuals(uv=corners[:, :2] * repeat, material=finish)
    scene.add_mesh_trimesh(f"{WORLD}/floor{geom}", plane, cast_shadow=False, receive_shadow=0.3)


class Figures:
    """`number` people of `radius` [m] in a page, drawn as in films. clicked(person): called where somebody is
    clicked."""

    def __init__(self, scene: Any, number: int, radius: float, clicked: Any):
        self._number, self._batches = number, []
        for index, part in enumerate(figure(radius) if number else ()):
            scales = np.tile(_scale(int(part.kind), np.array([part.size])), (number, 1))
            colours = part.colour(np.full((number, 3), 0.5))
            kind = int(part.kind)
            batch = Batch(scene, f"people{index}", _unit(kind), scales, colours, flat=kind == _BOX)
            batch.node.on_click(lambda event: clicked(event.instance_index))
            self._batches.append((part, batch))

    def place(self, poses: np.ndarray, here: np.ndarray) -> None:
        """Puts people at `poses` (K, 3), x, y [m] and yaw [rad], those who are `here` (K,)."""
        ahead = geometry.heading(poses[:, 2]) if self._number else None
        for part, batch in self._batches:
            places = np.column_stack([poses[:, :2] + part.place[0] * ahead, np.where(here, part.place[2], _GONE)])
            batch.place(places, geometry.yaw_quaternion(poses[:, 2]) if part.place[0] else None)

    def paint(self, colours: np.ndarray) -> None:
        """Gives people the `colours` (K, 3) in [0, 1]."""
        for part, batch in self._batches:
            if part.shade:
                batch.paint(part.colour(colours))


class Goal:
    """A goal in a page, drawn as in films."""

    def __init__(self, scene: Any):
        self._batches = []
        for index, part in enumerate(GOAL):
            kind, alphas = int(part.kind), np.array([part.alpha])
            scales, colours = _scale(kind, np.array([part.size])), part.colour(np.array([GOAL_RGB]))
            batch = Batch(scene, f"goal{index}", _unit(kind), scales, colours, alphas, kind == _BOX, part.alpha == 1.0)
            self._batches.append((part, batch))

    def place(self, goal: np.ndarray | None) -> None:
        """Puts the goal at `goal` (2,) [m]; None: it is not there."""
        for part, batch in self._batches:
            x, y, z = part.place
            where = (0, 0, _GONE) if goal is None else (goal[0] + x, goal[1] + y, z)
            batch.place(np.array([where]))
