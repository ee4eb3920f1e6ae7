"""What an engine gives: physics, rays and pictures of many worlds of one MuJoCo model. Nothing else asks which runs.

`ids` are numbers of worlds, an integer array (n,) in ascending order; what an engine does in a world depends on nothing
in any other. An engine that keeps worlds elsewhere, on a GPU, moves these arrays to and fro.
"""

from typing import Any, Protocol

import mujoco
import numpy as np


class Engine(Protocol):
    """`nworld` worlds of `model`. The arrays are the worlds' state: what is written there holds from the next call on,
    and a call leaves there what comes of it. World frame; metres, seconds, radians."""

    model: mujoco.MjModel
    nworld: int
    about: str  #: what runs it, in words
    qpos: np.ndarray  #: (nworld, nq)
    qvel: np.ndarray  #: (nworld, nv)
    ctrl: np.ndarray  #: (nworld, nu)
    mocap_pos: np.ndarray  #: (nworld, nmocap, 3)
    mocap_quat: np.ndarray  #: (nworld, nmocap, 4)
    sensordata: np.ndarray  #: (nworld, nsensordata), of the last `forward`; only read

    def reset(self, ids: np.ndarray) -> None:
        """Puts worlds back to the model's default state, without warnings."""
        ...

    def step(self, ids: np.ndarray, steps: int) -> np.ndarray:
        """Goes on by `steps` physics steps; the record of qpos after each: (n, steps, nq)."""
        ...

    def forward(self, ids: np.ndarray) -> None:
        """Computes what rays, pictures and sensordata show, from the present state."""
        ...

    def warnings(self, ids: np.ndarray) -> dict[int, str]:
        """What failed in which worlds since their reset: {place in ids: in words}."""
        ...

    def add_rays(self, site: int, directions: np.ndarray) -> int:
        """Gets rays ready that go out from the model's site number `site` along `directions` (R, 3), unit vectors in
        the site's frame; their number, for `rays`. They pass through the body that carries the site."""
        ...

    def rays(self, ids: np.ndarray, number: int) -> np.ndarray:
        """How far each of the rays goes until it meets something [m], infinity where it doesn't: (n, R)."""
        ...

    def add_camera(self, name: str) -> int:
        """Gets the model's camera `name` ready; its number, for `pictures`. Raises macid.drawing.Unavailable where
        nothing can be drawn."""
        ...

    def pictures(self, ids: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
        """What a camera sees: RGB (n, H, W, 3) uint8, and depth (n, H, W) float32 [m] along the optical axis."""
        ...

    def data(self, index: int) -> mujoco.MjData:
        """The state of one world as plain MuJoCo has it, a copy; what is derived needs mujoco.mj_forward."""
        ...

    def save(self) -> Any:
        """All that the next calls depend on, for `restore`."""
        ...

    def restore(self, saved: Any) -> None:
        """Goes back to what `save` gave, of this engine or of another of the same model and number of worlds."""
        ...

    def close(self) -> None:
        """Frees all that it holds; closing twice does no harm."""
        ...


class MakeEngine(Protocol):
    """Makes an Engine: its class, mostly."""

    def __call__(self, model: mujoco.MjModel, nworld: int, nthread: int = 0) -> Engine:
        """nthread: how many threads it may use, 0 for as many as there are processors."""
        ...
