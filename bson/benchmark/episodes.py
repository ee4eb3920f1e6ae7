"""What each call that plays episodes does: it checks that they have room, and shows how far it is."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any


def check_spawn(config: Any, seeds: Sequence[int]) -> None:
    """Draws the episodes `seeds` of a TaskConfig, so that a map without room is refused before anything runs."""
    import numpy as np

    from bson.task import spawn

    for seed in seeds:
        spawn(config, np.random.default_rng(seed))


@contextlib.contextmanager
def cells_bar(
    name: str, several: bool, quiet: bool, cell: str | None, without_robot: bool, total: int, done: int
) -> Iterator[Callable[[int, int], None]]:
    """A progress bar on stderr, for the argument `watch` of play_cells (with the first three arguments given): `done`
    of `total` episodes are there. name: the agent's. several: whether to name the cell, too. quiet: no bar."""
    from tqdm import tqdm

    told = f"{name}: {cell}" if several and cell is not None else name
    if without_robot:
        told += ", without the robot"
    with tqdm(total=total, initial=done, unit="episode", desc=told, file=sys.stderr, smoothing=0, disable=quiet) as bar:
        steps, shown = 0, time.monotonic()

        def progress(control_steps, ended):
            nonlocal steps, shown
            steps += control_steps
            bar.update(ended)
            if not quiet and (ended or time.monotonic() - shown > 0.2):
                shown = time.monotonic()
                bar.set_postfix_str(f"{steps / max(bar.format_dict['elapsed'], 1e-9):,.0f} steps/s", refresh=True)

        yield progress


@contextlib.contextmanager
def episodes_bar(
    name: str, total: int, quiet: bool, cell: str | None = None
) -> Iterator[Callable[[int, object], None]]:
    """The same bar for the argument `progress` of run_episodes."""
    with cells_bar(name, cell is not None, quiet, cell, False, total, 0) as bar:
        yield lambda steps, episode: bar(steps, episode is not None)
