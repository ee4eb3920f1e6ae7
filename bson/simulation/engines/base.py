"""The interface of an engine: physics, rays and pictures of many worlds of one MuJoCo model. No other code asks which
engine runs.

`ids` are numbers of worlds, an integer array (n,) in ascending order; an engine's results in one world depend on
nothing in another. An engine that keeps its worlds on a GPU copies these arrays there and back.
"""

from typing import Any, Protocol

import mujoco
import numpy as np


class Engine(Protocol):
    """`nworld` worlds of `model`. The arrays are the worlds' state: values written there hold from the next call on,
    and each call leaves its results there. World frame; metres, seconds, radians."""

    model: mujoco.MjModel
    nworld: int
    about: str  #: the engine in words, for people
    qpos: np.ndarray  #: (nworld, nq)
    qvel: np.ndarray  #: (nworld, nv)
    ctrl: np.ndarray  #: (nworld, nu)
    mocap_pos: np.ndarray  #: (nworld, nmocap, 3)
    mocap_quat: np.ndarray  #: (nworld, nmocap, 4)
    sensordata: np.ndarray  #: (nworld, nsensordata), from the last `forward`; read only

    def reset(self, ids: np.ndarray) -> None:
        """Puts worlds back to the model's default state and clears their warnings."""
        ...

    def step(self, ids: np.ndarray, steps: int) -> np.ndarray:
        """Advances worlds by `steps` physics steps; returns qpos after each step: (n, steps, nq)."""
        ...

    def forward(self, ids: np.ndarray) -> None:
        """Makes rays, pictures and sensordata current with the present state."""
        ...

    def warnings(self, ids: np.ndarray) -> dict[int, str]:
        """The failures of physics since each world's reset: {index into ids: in words}."""
        ...

    def add_rays(self, site: int, directions: np.ndarray) -> int:
        """Prepares rays from the model's site number `site` along `directions` (R, 3), unit vectors in the site's
        frame; returns their number, for `rays`. The rays pass through the body that carries the site."""
        ...

    def rays(self, ids: np.ndarray, number: int) -> np.ndarray:
        """The distance (n, R) [m] at which each ray meets something, infinity where it meets nothing."""
        ...

    def add_camera(self, name: str) -> int:
        """Prepares the model's camera `name`; returns its number, for `pictures`. Raises macid.drawing.gl.Unavailable
        where nothing can be drawn."""
        ...

    def pictures(self, ids: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
        """The pictures of a camera: RGB (n, H, W, 3) uint8, and depth (n, H, W) float32 [m] along the optical axis."""
        ...

    def data(self, index: int) -> mujoco.MjData:
        """A copy of one world's state as an MjData; its derived quantities need mujoco.mj_forward."""
        ...

    def save(self) -> Any:
        """The whole state on which the next calls depend, for `restore`."""
        ...

    def restore(self, saved: Any) -> None:
        """Goes back to a state from `save`, of this engine or of another one with the same model and number of
        worlds."""
        ...

    def close(self) -> None:
        """Frees all resources; closing twice does no harm."""
        ...


class MakeEngine(Protocol):
    """A maker of an Engine: usually the engine's class."""

    def __call__(self, model: mujoco.MjModel, nworld: int, nthread: int = 0) -> Engine:
        """nthread: how many threads the engine may use; 0: as many as there are processors."""
        ...
