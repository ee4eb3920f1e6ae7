"""The sensors of many worlds: when each is read, and its noise."""

import copy
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bson.sensors import Sensor


class Senses:
    """`sensors` in each of `nworld` worlds. readings: {a sensor's key: its last readings (nworld, ...)}.

    Raises ValueError for two sensors of one key.
    """

    def __init__(self, sensors: Sequence[Sensor], nworld: int):
        self._sensors = tuple(sensors)
        if len({sensor.key for sensor in self._sensors}) < len(self._sensors):
            raise ValueError(f"Two sensors share a key: {', '.join(sensor.key for sensor in self._sensors)}.")
        self.readings = {
            sensor.key: np.zeros((nworld, *sensor.space.shape), sensor.space.dtype) for sensor in self._sensors
        }
        self._noise: list[list[Any]] = [[None] * nworld for _ in self._sensors]  # Generators, new ones each episode
        self._every: list[int] = []
        self._readers: list[Callable] = []

    def configure(self, period: float) -> None:
        """Sets the control period `period` [s]. Raises ValueError for a sensor whose rate does not fit."""
        self._every = [sensor.every(period) for sensor in self._sensors]  # control steps

    def bind(self, world: Any) -> None:
        """Gets the sensors ready to read `world`. Raises the error of a sensor that can't work."""
        self._readers = [sensor.bind(world) for sensor in self._sensors]

    def begin(self, index: int, seed: int) -> None:
        """Begins the noise of the episode `seed` in world `index`."""
        for sensor, generators in zip(self._sensors, self._noise, strict=True):
            generators[index] = sensor.generator(seed) if sensor.noise else None

    def read(self, world: Any, ids: np.ndarray, fail: Callable, draws: Callable) -> None:
        """Takes the readings of the worlds `ids` that are due: all of them, or none where an error is raised.

        fail(index, what): called for a reading that is not finite, which is not taken; draws(rng): called before noise
        is drawn from the Generator `rng`.
        """
        taken = []
        for sensor, every, reader, noise in zip(self._sensors, self._every, self._readers, self._noise, strict=True):
            due = ids[world.steps[ids] % every == 0]
            if not len(due):
                continue
            readings = reader(world, due)
            finite = np.isfinite(readings).reshape(len(due), -1).all(axis=-1)
            for index in due[~finite]:
                fail(index, f"the reading '{sensor.key}' is not finite")
            due, readings = due[finite], readings[finite]
            if sensor.noise:
                for row, index in enumerate(due):
                    draws(noise[index])
                    readings[row] = sensor.noisy(readings[row], noise[index])
            taken.append((sensor.key, due, readings))
        for key, due, readings in taken:  # only once nothing can fail any more
            self.readings[key][due] = readings

    def follow(self, other: "Senses", memo: dict) -> None:
        """Goes on from where `other`, of the same sensors, is (memo: copy.deepcopy's)."""
        self._noise = copy.deepcopy(other._noise, memo)
        for key, values in other.readings.items():
            self.readings[key][:] = values

    def save(self) -> list:
        """The Generators of the noise, without their states, for `restore`."""
        return [list(generators) for generators in self._noise]

    def restore(self, saved: list) -> None:
        """Goes back to a state from `save`."""
        self._noise = saved
