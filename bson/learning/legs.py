"""What trainings of robots with a memory share: updates of so many control steps, in legs, between which they rest."""

from typing import Any


class Legs:
    """Counts the updates of a training of `steps` control steps of all worlds of `env` together.

    config: has `rollout`, the control steps of each world in an update, and `leg`, the updates between two rests.
    """

    def __init__(self, env: Any, steps: int, config: Any):
        self._env, self._config = env, config
        self._per = env.num_envs * config.rollout  # steps in an update
        self.number = max(1, -(-steps // self._per))  #: updates of the whole training
        self.updates = 0  #: done

    @property
    def steps(self) -> int:
        """The control steps done."""
        return self.updates * self._per

    @property
    def done(self) -> bool:
        """Whether the training is over."""
        return self.updates >= self.number

    @property
    def rests(self) -> bool:
        """Whether a checkpoint may be written: the worlds begin anew with the next update, or there is none."""
        return self.done or self.updates % self._config.leg == 0

    def _go_on_after(self, updates):
        """Takes a checkpoint's number of `updates`. Raises ValueError for one that was not written at rest."""
        self.updates = updates
        if not self.rests:
            raise ValueError(f"it was written after {self.updates} updates, within a leg")
