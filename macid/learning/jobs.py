"""Trainings as jobs of an executor: each in a folder of the worker's, whose files come here as they are written.

A checkpoint that came is what a training goes on from when its worker was lost, and after `--resume`, wherever that
runs.
"""

import contextlib
import dataclasses
import os
import pathlib
import tempfile
import threading
from collections.abc import Callable, Sequence
from typing import Any

from macid.executors import Carried, Executor
from macid.files import lock_folder, write_bytes
from macid.learning.curves import FILES, training_folder

_LOOK = 1.0  # between looks at what a training has written [s]


@dataclasses.dataclass(frozen=True)
class Group:
    """Trainings that run at once in one job: of one, or of as many as one checkpoint is of.

    train: a module's function train(configs, out, show), which goes on from what is in `out` and writes each
    configuration's FILES in the folder `out`/NAME-SEED; show(figures...) is for whoever waits. configs: dataclasses
    with `name` and `seed`.
    """

    train: Callable[[Sequence[Any], pathlib.Path, Callable[..., None]], Any]
    configs: tuple[Any, ...]


@dataclasses.dataclass(frozen=True)
class _Left:
    """A Group and the files that it has: {"NAME-SEED/FILE": content}."""

    group: Group
    files: dict[str, bytes]


def folder_of(config: Any) -> str:
    """NAME-SEED, what a training's folder is called."""
    return f"{config.name}-{config.seed}"


def train_groups(
    executor: Executor,
    groups: Sequence[Group],
    out: str | os.PathLike,
    resume: bool,
    show: Callable[..., None],
    is_done: Callable[[Any, pathlib.Path], bool],
    carried: Carried | None = None,
) -> list[pathlib.Path]:
    """Runs trainings; returns their folders `out`/NAME-SEED, which are locked meanwhile.

    show: called with a training's configuration and what it tells. is_done: of a configuration and its folder. Raises
    UsageError as macid.learning.curves.training_folder does, before any begins.
    """
    out = pathlib.Path(out)
    every = [config for group in groups for config in group.configs]
    paths = [out / folder_of(config) for config in every]
    with contextlib.ExitStack() as held:
        for path in paths:
            held.enter_context(lock_folder(path, FILES, alone=("config.json",)))
        for config, path in zip(every, paths, strict=True):
            training_folder(path, config, resume)

        def job(group):
            if all(is_done(config, out / folder_of(config)) for config in group.configs):
                return None
            files = [f"{folder_of(config)}/{name}" for config in group.configs for name in FILES]
            return _Left(group, {file: (out / file).read_bytes() for file in files if (out / file).is_file()})

        def receive(index, piece):
            kind, content = piece
            if kind == "file":
                write_bytes(out / content[0], content[1])
            else:
                show(groups[index].configs[0], *content)

        executor.run(train_here, [lambda group=group: job(group) for group in groups], receive, carried or Carried())
    return paths


def train_here(left: _Left, send: Callable[[Any], None]) -> None:
    """The work of a Group: trains in a folder for it, and sends ("file", (name, content)) of what was written and
    ("show", what it tells)."""
    ended, sent = threading.Event(), {}
    with tempfile.TemporaryDirectory() as root:
        out = pathlib.Path(root)
        for file, content in left.files.items():
            (out / file).parent.mkdir(exist_ok=True)
            (out / file).write_bytes(content)
            sent[file] = _stamp(out / file)

        def look():
            while not ended.wait(_LOOK):
                _send_new(out, left.group, sent, send)

        looking = threading.Thread(target=look, daemon=True)
        looking.start()
        try:
            left.group.train(left.group.configs, out, lambda *told: send(("show", told)))
        finally:
            ended.set()
            looking.join()
            _send_new(out, left.group, sent, send)


def _send_new(out, group, sent, send):
    """Sends the files in `out` that are not as they were `sent`. Each is whole, since it is renamed into its place."""
    for config in group.configs:
        for name in FILES:
            file = f"{folder_of(config)}/{name}"
            if (stamp := _stamp(out / file)) is not None and sent.get(file) != stamp:
                content = (out / file).read_bytes()
                sent[file] = stamp
                send(("file", (file, content)))


def _stamp(path):
    """What changes when the file `path` is replaced; None where it isn't there."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size
