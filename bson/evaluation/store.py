"""Episodes on disk: those of an unfinished evaluation, so that an evaluation that was killed can go on from there, and
others that are to be kept, such as people's."""

import dataclasses
import hashlib
import io
import json
import os
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from bson.episodes.record import Episode
from bson.episodes.tracks import make_track, sensor_settings
from bson.evaluation.play import versions
from macid import assets
from macid.documents import parse, read_bytes
from macid.files import (
    UsageError,
    check_file,
    check_folder,
    named,
    output_folder,
    remove_leftovers,
    write_bytes,
    write_json,
)
from macid.pedestrians import is_learned
from macid.policy import load_policy
from macid.registry import code_file

_MOST_BASIS = 1 << 28  # bytes of basis.json, which holds the settings of every cell
_SEAL = hashlib.sha256().digest_size  # bytes at the end of an episode's file


def _digest(contents):
    """A hash of `contents`, pieces of bytes: 12 hexadecimal digits."""
    digest = hashlib.sha256()
    for content in contents:
        digest.update(content)
    return digest.hexdigest()[:12]


def files_digest(basis: dict[str, Any]) -> str:
    """A hash of the settings, maps, robots and pedestrians' weights behind results with this `basis`."""
    content = json.dumps([basis["cells"], basis["pedestrians"]], sort_keys=True)
    return _digest([content.encode()])


def _agent_files(name):
    """The files of the loaded agent `name`: its file, its module's or its weights; none where the agent is only code of
    this package."""
    path = code_file(name) or pathlib.Path(name)
    return [file for file in (path, assets.root() / "agents" / f"{name}.npz") if file.is_file()]


def basis(agent: str, track: tuple[str, Any], cells: Sequence[Any], paired: bool) -> dict[str, Any]:
    """Everything from which the episodes of an evaluation follow, beside their seeds, as far as it can be known.

    agent: its name, or "module:name" for an agent that was given as an object; track: (track, sensor) as for
    `make_track`.
    """
    models = {name for cell in cells for name in cell.config.model_shares}
    policies = [load_policy(name) for name in sorted(filter(is_learned, models))]
    rules = [file for name in sorted(models) if not is_learned(name) and (file := code_file(name))]
    content = {
        "agent": [agent, _digest(file.read_bytes() for file in _agent_files(agent))],
        "track": [track[0], track[1] if isinstance(track[1], str) else sensor_settings(make_track(*track).sensors)],
        "paired": paired,
        "cells": [cell.content for cell in cells],
        "pedestrians": _digest(
            [weights.tobytes() for policy in policies for layer in policy.layers for weights in layer]
            + [file.read_bytes() for file in rules]
        ),
        "versions": versions(),
    }
    return json.loads(json.dumps(content, default=np.ndarray.tolist))


class Stored:
    """A folder with an .npz for each episode that ended, and basis.json, from which they all follow.

    The folder is made when the first episode is saved. Each file ends in a seal, a hash of the basis and of the file's
    content. A file that was cut short, or follows from another basis, is ignored.
    """

    _refusal = "The episodes in '{folder}' follow from something else: {changed} changed. Name another folder."
    _cure = "Name another folder."

    def __init__(self, folder: pathlib.Path, basis: dict[str, Any], resume: bool):
        """resume: keeps the episodes that are there. Raises UsageError where they follow from another basis."""
        self._folder, self._basis = check_folder(folder), basis
        self._key = json.dumps(basis, sort_keys=True).encode()
        began = self._folder / "basis.json"
        check_file(began)
        for path in self._folder.glob("*.npz"):
            if not path.is_file():
                check_file(path)
        remove_leftovers(self._folder)
        self._goes_on = resume and os.path.lexists(began)
        if self._goes_on:
            before = read_basis(began, self._cure)
            if changed := [name for name in basis if before.get(name) != basis[name]]:
                raise UsageError(self._refusal.format(changed=" and ".join(changed), folder=self._folder.parent))

    def _path(self, cell, seed):
        return self._folder / f"{cell.slug}-{seed}.npz"

    def _seal(self, content):
        return hashlib.sha256(self._key + content).digest()

    def save(self, cell: Any, episode: Episode, more: dict[str, np.ndarray] | None = None) -> None:
        """Saves an episode of `cell`; replaces it if it is there. more: further arrays that are kept with it."""
        if not self._goes_on:
            self.discard()
            output_folder(self._folder)
            write_json(self._folder / "basis.json", self._basis)
            self._goes_on = True
        fields: dict[str, Any] = {field.name: getattr(episode, field.name) for field in dataclasses.fields(episode)}
        content = io.BytesIO()
        kept: dict[str, Any] = fields | (more or {})
        np.savez(content, **{name: value for name, value in kept.items() if value is not None})
        write_bytes(self._path(cell, episode.seed), content.getvalue() + self._seal(content.getvalue()))

    def load(self, cell: Any, seed: int) -> Episode | None:
        """The Episode `seed` of `cell` as it was saved, or None."""
        fields = self._fields(self._path(cell, seed))
        return None if fields is None else self._episode(fields)

    def _episode(self, fields):
        """The Episode of a file's arrays."""
        known = {field.name for field in dataclasses.fields(Episode)}
        return Episode(
            **{name: value if value.ndim else value.item() for name, value in fields.items() if name in known}
        )

    def _fields(self, path):
        """The arrays in the file `path` as they were saved, or None."""
        if not self._goes_on or not path.is_file():
            return None
        sealed = path.read_bytes()
        content, seal = sealed[:-_SEAL], sealed[-_SEAL:]
        if seal != self._seal(content):
            return None
        with np.load(io.BytesIO(content)) as fields:
            return dict(fields)

    def seeds(self, cell: Any) -> list[int]:
        """The seeds of the episodes of `cell` that are there, in order."""
        names = [path.stem.removeprefix(f"{cell.slug}-") for path in self._folder.glob(f"{cell.slug}-*.npz")]
        return sorted(int(name) for name in names if self._goes_on and name.isdecimal())

    def discard(self) -> None:
        """Removes the folder and everything in it."""
        remove_leftovers(self._folder)
        if not self._folder.is_dir():
            return
        for path in [*self._folder.glob("*.npz"), self._folder / "basis.json"]:
            if path.is_file() or path.is_symlink():
                path.unlink()
        if not self._folder.is_symlink() and not any(self._folder.iterdir()):
            self._folder.rmdir()


class Unfinished(Stored):
    """The folder `out`/unfinished of an evaluation."""

    _refusal = (
        "The evaluation in '{folder}' can't go on: {changed} changed since it began. "
        "Give the command that began it, or leave out --resume to begin anew."
    )
    _cure = "Delete it, or leave out --resume, to begin anew."

    def __init__(self, out: pathlib.Path, basis: dict[str, Any], resume: bool):
        """resume: keeps the episodes that are there. Raises UsageError where they follow from another basis."""
        super().__init__(out / "unfinished", basis, resume)


def read_basis(path: pathlib.Path, cure: str) -> dict[str, Any]:
    """The content of basis.json. Raises UsageError, with the `cure`, for content that no evaluation writes."""
    try:
        basis = parse(path, "basis", read_bytes(path, "basis", _MOST_BASIS))
        if isinstance(basis, dict):
            return basis
        problem = "it is no object"
    except UsageError as error:
        problem = str(error).rstrip(".")
    raise UsageError(f"{named(path)} is damaged ({problem}). {cure}")
