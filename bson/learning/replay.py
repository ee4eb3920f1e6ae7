"""Replay of pieces of episodes, for off-policy learning with a memory.

After R2D2 (Kapturowski et al., "Recurrent experience replay in distributed reinforcement learning", ICLR 2019): each
piece has the memory that the networks had before it, as it was when the robot drove, and some steps more before those
that are learned from, so that newer networks come to a memory of their own ("burn-in"). Pieces follow each other
through an episode, and each control step is learned from in one of them; a piece ends with its episode.
"""

from typing import Any, NamedTuple

import numpy as np


class Batch(NamedTuple):
    """B pieces of P control steps, of which an episode's last piece may have fewer, after `burn` others."""

    warm: np.ndarray  #: (burn, B, size): what was seen in the steps before
    states: np.ndarray  #: (networks, B, units): the memories before those
    begins: np.ndarray  #: (B,) bool: whether the piece begins its episode; there are no steps before, nor memories then
    x: np.ndarray  #: (P + 1, B, size): what was seen in the steps, and after the last
    action: np.ndarray  #: (P, B, actions)
    reward: np.ndarray  #: (P, B)
    there: np.ndarray  #: (P, B) bool: whether there is such a step
    terminal: np.ndarray  #: (P, B) bool: whether nothing follows the step; not so where an episode was cut off


class Replay:
    """The last pieces, at most `capacity`: when it is full, a new piece takes the place of the oldest.

    size: of what is seen in a step; units: of each of the `networks`' memories; dtype: in which what is seen is kept.
    """

    def __init__(
        self,
        capacity: int,
        piece: int,
        burn: int,
        size: int,
        units: int,
        networks: int = 2,
        actions: int = 2,
        dtype: Any = np.float32,
    ):
        self.capacity, self.piece, self.burn = capacity, piece, burn
        self.added = 0  #: pieces so far
        self._rows = {  # the system gives memory to these zeros only as they are written
            "x": np.zeros((capacity, burn + piece + 1, size), dtype),
            "action": np.zeros((capacity, piece, actions), np.float32),
            "reward": np.zeros((capacity, piece), np.float32),
            "states": np.zeros((capacity, networks, units), np.float32),
            "count": np.zeros(capacity, np.int32),
            "begins": np.zeros(capacity, bool),
            "terminal": np.zeros(capacity, bool),
        }

    def __len__(self) -> int:
        """The pieces that are kept."""
        return min(self.added, self.capacity)

    def add(self, **piece: Any) -> None:
        """Adds a piece: x (burn + count + 1, size), action (count, actions), reward (count,), states (networks, units)
        before x's first row, count, begins, and terminal: whether nothing follows its last step."""
        place = self.added % self.capacity
        for name, rows in self._rows.items():
            value = np.asarray(piece[name])
            if value.ndim and len(value) < len(rows[place]):
                rows[place, len(value) :] = 0
                rows[place, : len(value)] = value
            else:
                rows[place] = value
        self.added += 1

    def sample(self, rng: np.random.Generator, batch: int) -> Batch:
        """`batch` pieces, each of those kept with equal chances: so has each control step."""
        chosen = rng.integers(len(self), size=batch)
        rows = {name: each[chosen] for name, each in self._rows.items()}
        x = rows["x"].astype(np.float32).swapaxes(0, 1)
        now, count = np.arange(self.piece)[:, None], rows["count"]
        return Batch(
            warm=x[: self.burn],
            states=rows["states"].swapaxes(0, 1),
            begins=rows["begins"],
            x=x[self.burn :],
            action=rows["action"].swapaxes(0, 1),
            reward=rows["reward"].T,
            there=now < count,
            terminal=(now == count - 1) & rows["terminal"],
        )

    def collect(self) -> dict[str, np.ndarray]:
        """The kept pieces, {name: array}."""
        return {name: rows[: len(self)] for name, rows in self._rows.items()}

    def wanted(self, added: int) -> dict[str, np.ndarray]:
        """Arrays of the names, shapes and types that `collect` would give with so many `added`."""
        return {name: rows[: min(added, self.capacity)] for name, rows in self._rows.items()}

    def restore(self, found: dict[str, np.ndarray], added: int) -> None:
        """Puts back what `collect` gave when so many were `added`. Raises ValueError for counts that are none."""
        count = found["count"]
        if ((count < 1) | (count > self.piece)).any():
            raise ValueError("its replay has pieces of no length")
        self.added = added
        for name, rows in self.collect().items():
            rows[:] = found[name]


class Recorder:
    """The piece that is under way in each of `number` worlds; those that end go into `replay`."""

    def __init__(self, replay: Replay, number: int):
        self._replay = replay
        shapes = {name: each.shape[1:] for name, each in replay.wanted(1).items()}
        self._x = np.zeros((number, *shapes["x"]), np.float32)
        self._states = np.zeros((number, replay.burn + replay.piece, *shapes["states"]), np.float32)
        self._action = np.zeros((number, *shapes["action"]), np.float32)
        self._reward = np.zeros((number, *shapes["reward"]), np.float32)
        self._count, self._begins = np.zeros(number, int), np.ones(number, bool)

    def begin(self, x: np.ndarray, worlds: Any = slice(None)) -> None:
        """Episodes begin in `worlds` with what is seen there, x (worlds, size)."""
        self._count[worlds], self._begins[worlds] = 0, True
        self._x[worlds, : self._replay.burn], self._states[worlds, : self._replay.burn] = 0.0, 0.0
        self._x[worlds, self._replay.burn] = x

    def note(
        self, states: Any, action: np.ndarray, reward: np.ndarray, x: np.ndarray, done: np.ndarray, terminal: np.ndarray
    ) -> None:
        """A control step of all worlds: the networks' memories before it, states (networks, N, units), the actions
        (N, actions), rewards (N,), what was seen after it, x (N, size), and whether the episode was over then, done
        (N,), and not cut off, terminal (N,). Where it was over, `begin` follows."""
        every, burn, piece = np.arange(len(self._count)), self._replay.burn, self._replay.piece
        self._states[every, burn + self._count] = np.swapaxes(states, 0, 1)
        self._action[every, self._count], self._reward[every, self._count] = action, reward
        self._count += 1
        self._x[every, burn + self._count] = x
        for world in np.flatnonzero(done | (self._count == piece)):
            self._end(world, bool(terminal[world]))
            if not done[world]:  # the next piece of the episode begins
                self._x[world, : burn + 1] = self._x[world, piece:].copy()
                self._states[world, :burn] = self._states[world, piece:].copy()
                self._count[world], self._begins[world] = 0, False

    def cut(self) -> None:
        """Ends all that is under way: the worlds begin anew."""
        for world in np.flatnonzero(self._count):
            self._end(world, False)
        self._count[:] = 0

    def _end(self, world, terminal):
        count = self._count[world]
        self._replay.add(
            x=self._x[world, : self._replay.burn + count + 1],
            action=self._action[world, :count],
            reward=self._reward[world, :count],
            states=self._states[world, 0],
            count=count,
            begins=self._begins[world],
            terminal=terminal,
        )
