"""Agents that were trained: an MLP on `bson.features`, run by NumPy alone.

One is kept by macid.policy.write_network: NAME.npz (weights, no pickle) and NAME.json (how it was made, how it scores, and
"output": "clip" or "tanh"). Those that are shipped lie in assets/agents.
"""

import pathlib

import numpy as np

from bson.features import FEATURES, Features
from macid import assets
from macid.files import UsageError
from macid.policy import read_network

ACTIONS = 2
_OUTPUTS = {"clip": lambda x: np.clip(x, -1.0, 1.0), "tanh": np.tanh}


class Learned:
    """An agent for one world on the Local track with the 2D LIDAR; stateful, since it remembers its last scans.

    layers: [(weight (in, out), bias (out,)), ...] with ReLU between; output: "clip" or "tanh", what makes an action of
    the last layer's output.
    """

    track, sensor = "local", "lidar2d"

    def __init__(self, layers, output):
        self.layers, self.output = layers, output
        self._output = _OUTPUTS[output]
        self._features, self._begun = Features(1), False

    def reset(self, seed):
        """Begins an episode."""
        self._begun = False

    def __call__(self, observation):
        """The action (2,) in [-1, 1] for one world's observation."""
        batched = {name: np.asarray(observation[name])[None] for name in ("goal", "velocity", "lidar")}
        look = self._features.step if self._begun else self._features.begin
        self._begun = True
        return self.act(look([0], batched))[0]

    def act(self, x):
        """Actions (N, 2) for features (N, FEATURES)."""
        with np.errstate(over="ignore", invalid="ignore"):  # whoever acts by it refuses what is not finite
            for weight, bias in self.layers[:-1]:
                x = np.maximum(x @ weight + bias, 0.0)
            weight, bias = self.layers[-1]
            return self._output(x @ weight + bias)


def names():
    """Names of the shipped agents."""
    return assets.names("agents", ".npz")


def load(name):
    """A factory of the agent `name`: a shipped one, or a .npz file. Raises UsageError (a ValueError) for what is none."""
    path = pathlib.Path(name) if name.endswith(".npz") else assets.path("agents", f"{name}.npz")
    layers, recipe = read_network(path)
    output = recipe.get("output")
    if not isinstance(output, str) or output not in _OUTPUTS:
        raise UsageError(
            f"'{path}' is no robot's policy, as bson train makes them: its json has no \"output\" of {', '.join(_OUTPUTS)}."
        )
    for given, wanted, does in ((layers[0][0].shape[0], FEATURES, "takes"), (layers[-1][0].shape[1], ACTIONS, "gives")):
        if given != wanted:
            raise UsageError(f"'{path}' is no robot's policy: it {does} {given} numbers, not {wanted}.")

    def factory():
        return Learned(layers, output)

    factory.track, factory.sensor = Learned.track, Learned.sensor
    return factory
