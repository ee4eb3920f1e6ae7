"""The engine on MuJoCo's own threaded batch simulator. Worlds equal the same worlds run alone, bit for bit."""

import functools

import mujoco
import mujoco.batch
import numpy as np

from bson.simulation.renderer import Renderer
from bson.simulation.scene import joint_at
from macid.threads import physics_threads

_STATE = {  # the state on which the next step depends: attributes, and fields of MuJoCo's
    "qpos": "qpos",
    "qvel": "qvel",
    "_act": "act",
    "ctrl": "ctrl",
    "_warmstart": "qacc_warmstart",
    "_time": "time",
    "mocap_pos": "mocap_pos",
    "mocap_quat": "mocap_quat",
}
_ADDRESSES = {  # of joints, by the addresses that MuJoCo's warnings count
    mujoco.mjtWarning.mjWARN_BADQPOS: "jnt_qposadr",
    mujoco.mjtWarning.mjWARN_BADQVEL: "jnt_dofadr",
    mujoco.mjtWarning.mjWARN_BADQACC: "jnt_dofadr",
}


class NativeEngine:
    """An Engine; bson.simulation.engines.base documents its calls."""

    qpos: np.ndarray
    qvel: np.ndarray
    ctrl: np.ndarray
    mocap_pos: np.ndarray
    mocap_quat: np.ndarray

    def __init__(self, model: mujoco.MjModel, nworld: int, nthread: int = 0):
        self.model, self.nworld = model, nworld
        self._batch = mujoco.batch.Batch(model, nworld, nthread or physics_threads())
        self.about = f"{self._batch.nthread} MuJoCo threads"
        for name, field in _STATE.items():
            setattr(self, name, self._batch.bind(field))
        self.sensordata = self._batch.bind("sensordata")
        # Sensors are computed in `forward`, not in every physics step.
        self._sensors_on = int(model.opt.disableflags)
        self._sensors_off = self._sensors_on | int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        self._flags = self._batch.expand("opt.disableflags")
        self._flags[:] = self._sensors_off
        self._rays = []  # for each: a site, its body, its directions' components ahead, left and up
        self._site_places = self._site_frames = np.empty(0)  # bound once there are rays
        self._forwards = 0

    def reset(self, ids: np.ndarray) -> None:
        """As Engine.reset."""
        self._batch.reset(ids, stage=int(mujoco.mjtStage.mjSTAGE_NONE))

    def step(self, ids: np.ndarray, steps: int) -> np.ndarray:
        """As Engine.step."""
        return self._batch.rollout(steps, record=("qpos",), ids=ids)["qpos"]

    def forward(self, ids: np.ndarray) -> None:
        """As Engine.forward."""
        self._flags[ids] = self._sensors_on
        self._batch.forward(ids)
        self._flags[ids] = self._sensors_off
        self._forwards += 1

    def warnings(self, ids: np.ndarray) -> dict[int, str]:
        """As Engine.warnings."""
        # MuJoCo puts a state that is not finite back to the model's default and goes on from there: only its count of
        # warnings tells.
        counts = self._batch.warning[ids, :, 1]
        return {
            int(row): self._in_words(ids[row], mujoco.mjtWarning(int(counts[row].argmax())))
            for row in np.flatnonzero(counts.any(axis=-1))
        }

    def _in_words(self, index, warning):
        number = int(self._batch.warning[index, warning, 0])
        words = mujoco.mju_warningText(warning, number).split(". ")[0]
        if warning in _ADDRESSES:
            words += f", {joint_at(self.model, _ADDRESSES[warning], number)}"
        return words

    def add_rays(self, site: int, directions: np.ndarray) -> int:
        """As Engine.add_rays."""
        self._site_places, self._site_frames = self._batch.bind("site_xpos"), self._batch.bind("site_xmat")
        self._rays.append((site, int(self.model.site_bodyid[site]), *np.ascontiguousarray(directions.T)))
        return len(self._rays) - 1

    def rays(self, ids: np.ndarray, number: int) -> np.ndarray:
        """As Engine.rays."""
        site, body, ahead, left, up = self._rays[number]
        frame = self._site_frames[ids, site].reshape(-1, 3, 3, 1)
        rays = np.empty((len(ids), ahead.size, 3))
        for axis in range(3):  # by hand, as a matrix product may round otherwise for one world than for many
            x, y, z = frame[:, axis].swapaxes(0, 1)
            rays[..., axis] = ahead * x + left * y + up * z
        distance, _ = self._batch.ray(self._site_places[ids, site][:, None], rays, bodyexclude=body, ids=ids)
        distance[distance < 0] = np.inf
        return distance

    @functools.cached_property
    def renderer(self) -> Renderer:
        """The renderer of cameras' pictures. Raises macid.drawing.gl.Unavailable without OpenGL."""
        return Renderer(self.model, self.nworld)

    def add_camera(self, name: str) -> int:
        """As Engine.add_camera."""
        return self.renderer.view(name)

    def pictures(self, ids: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
        """As Engine.pictures."""
        return self.renderer.look(number, ids, self._batch.get_data, self._forwards)

    def data(self, index: int) -> mujoco.MjData:
        """As Engine.data."""
        return self._batch.get_data(index)

    def save(self) -> dict[str, np.ndarray]:
        """As Engine.save."""
        return {name: getattr(self, name).copy() for name in _STATE}

    def restore(self, saved: dict[str, np.ndarray]) -> None:
        """As Engine.restore."""
        for name, array in saved.items():
            getattr(self, name)[...] = array

    def close(self) -> None:
        """As Engine.close."""
        if "renderer" in vars(self):
            self.renderer.close()
        for name in (*_STATE, "sensordata", "_site_places", "_site_frames", "_flags", "_batch", "renderer"):
            vars(self).pop(name, None)
