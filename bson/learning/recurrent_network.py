"""The torch twin of bson.recurrent, for learning by imitation (bson.learning.dagger) and by SAC and TAC
(bson.learning.recurrent_sac)."""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch

from bson import guided, recurrent
from bson.learning.algorithms import linear_layers
from bson.learning.attention import PeopleAttention
from bson.recurrent import CHANNELS, EYE, HEAD, MEMORY, PICTURE, SEEN, UNITS


class Encoder(torch.nn.Module):
    """Eye and memory, without a head. eye: one of bson.recurrent.EYES."""

    def __init__(self, eye: str):
        super().__init__()
        self.picture = eye == "picture"
        self.eye: Any = torch.nn.Module() if self.picture else torch.nn.Identity()
        if self.picture:
            first, second = CHANNELS
            self.eye.first = torch.nn.Conv2d(1, first, 3, 2, 1)
            self.eye.second = torch.nn.Conv2d(first, second, 3, 2, 1)
            self.eye.third = torch.nn.Linear(second * (PICTURE[0] // 4) * (PICTURE[1] // 4), SEEN)
        elif eye == "people":
            self.eye = PeopleAttention(gymnasium.spaces.Box(-10.0, 10.0, (guided.SIZE,), np.float32))
        self.memory = torch.nn.GRU(recurrent.shapes(eye)[MEMORY][0][0], UNITS)

    def encode(self, vector: torch.Tensor, pictures: torch.Tensor | None, state: Any = None) -> Any:
        """(the unit's states (T, N, UNITS), the last one (1, N, UNITS)) of vectors (T, N, ...) and pictures
        (T, N, *PICTURE); state: the one before (1, N, UNITS), None: nothing remembered."""
        if pictures is None:
            x = self.eye(vector)
        else:
            seen = torch.relu(self.eye.first(pictures.flatten(0, 1)[:, None]))
            seen = torch.relu(self.eye.second(seen)).permute(0, 2, 3, 1).flatten(1)  # rows, columns, channels
            seen = torch.relu(self.eye.third(seen))
            x = torch.cat([vector, seen.unflatten(0, vector.shape[:2])], dim=-1)
        return self.memory(x, state)

    def take(self, parts: Mapping[str, Any]) -> None:
        """Takes the weights of a network as bson.recurrent has it."""
        if self.picture:
            *kernels, last = parts[EYE]
            for layer, (weight, bias) in zip((self.eye.first, self.eye.second), kernels, strict=True):
                rows, columns = layer.kernel_size
                kernel = weight.reshape(rows, columns, -1, weight.shape[-1]).transpose(3, 2, 0, 1)
                _put(layer.weight, kernel)
                _put(layer.bias, bias)
            _take([self.eye.third], [last])
        else:
            _take(self.eye.modules(), parts[EYE])
        (weight, bias), (other, its) = parts[MEMORY]
        memory = self.memory
        _put(memory.weight_ih_l0, weight.T)
        _put(memory.bias_ih_l0, bias)
        _put(memory.weight_hh_l0, other.T)
        _put(memory.bias_hh_l0, its)


class Network(Encoder):
    """The whole network: the encoder, and the head that decides."""

    def __init__(self, eye: str):
        super().__init__(eye)
        self.head = torch.nn.Sequential(torch.nn.Linear(UNITS, UNITS), torch.nn.ReLU(), torch.nn.Linear(UNITS, 2))

    def forward(self, vector: torch.Tensor, pictures: torch.Tensor | None, state: Any = None) -> Any:
        """(actions (T, N, 2) before clipping, the last state) of vectors (T, N, ...) and pictures (T, N, *PICTURE)."""
        states, last = self.encode(vector, pictures, state)
        return self.head(states), last

    def take(self, parts: Mapping[str, Any]) -> None:
        """Takes the weights of a network as bson.recurrent has it."""
        super().take(parts)
        _take(self.head, parts[HEAD])

    def parts(self) -> dict[str, list[tuple[np.ndarray, np.ndarray]]]:
        """The network as bson.recurrent takes it."""

        def array(tensor):
            return tensor.detach().numpy().copy()

        def kernel(layer):
            weight = layer.weight.permute(2, 3, 1, 0)  # rows, columns, in, out
            return array(weight.reshape(-1, weight.shape[-1])), array(layer.bias)

        def linear(layer):
            return array(layer.weight.T), array(layer.bias)

        if self.picture:
            eye = [kernel(self.eye.first), kernel(self.eye.second), linear(self.eye.third)]
        else:
            eye = linear_layers(self.eye)
        memory = self.memory
        gates = [
            (array(memory.weight_ih_l0.T), array(memory.bias_ih_l0)),
            (array(memory.weight_hh_l0.T), array(memory.bias_hh_l0)),
        ]
        return {EYE: eye, MEMORY: gates, HEAD: [linear(self.head[0]), linear(self.head[2])]}


def _take(modules, layers):
    """Gives the linear ones of `modules`, in order, the weights of `layers`."""
    linear = [module for module in modules if isinstance(module, torch.nn.Linear)]
    for module, (weight, bias) in zip(linear, layers, strict=True):
        _put(module.weight, weight.T)
        _put(module.bias, bias)


def _put(parameter, array):
    with torch.no_grad():
        parameter.copy_(torch.from_numpy(np.ascontiguousarray(array)))
