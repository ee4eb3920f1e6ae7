"""What a training has in its folder beside its policy: its configuration, its curve and its checkpoint."""

import dataclasses
import json
import os
import pathlib
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from macid import arrays
from macid.documents import convert, read_document
from macid.files import UsageError, check_folder, output_folder, write_bytes, write_json

CHECKPOINT = "checkpoint.npz"  # arrays, and training.json: no pickle, which would run code
FILES = ("config.json", "curve.csv", CHECKPOINT, "policy.npz", "policy.json")  # of a training
OLD_CHECKPOINT = "checkpoint.pkl"  # of earlier versions
_NOTED = "training"  # the document in a checkpoint
_BOARD = "tensorboard"  # the folder of TensorBoard's logs


def plain(config: Any) -> dict[str, Any]:
    """A configuration (a dataclass) as JSON has it: dicts, lists, numbers and strings."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def completed(saved: dict[str, Any], config: Any) -> dict[str, Any]:
    """The configuration `saved`, in the form that `plain` gives; fields that it lacks, since they came later, get their
    defaults. config: a configuration (a dataclass) of the kind."""
    whole = dict(saved)
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            if isinstance(whole.get(field.name), dict):
                whole[field.name] = {**plain(type(value)()), **whole[field.name]}
        elif field.default is not dataclasses.MISSING:
            whole.setdefault(field.name, json.loads(json.dumps(field.default)))
    return whole


def training_folder(path: str | os.PathLike[str], config: Any, resume: bool) -> pathlib.Path:
    """`path` as the folder of a training: it gets config.json.

    config: a dataclass. resume: whether the training may go on there. Raises UsageError where the folder has a policy
    or a checkpoint of another configuration, or, without `resume`, of this one: no training is overwritten.
    """
    folder, noted = output_folder(path), plain(config)
    if any((folder / name).exists() for name in (CHECKPOINT, OLD_CHECKPOINT, "policy.npz", "policy.json")):
        before = completed(read_config(folder), config) if (folder / "config.json").exists() else noted
        if changed := sorted(name for name in {*before, *noted} if before.get(name) != noted.get(name)):
            told = ", ".join(f"{name} is {before.get(name)}, not {noted.get(name)}" for name in changed)
            raise UsageError(
                f"What is in '{folder}' is of another configuration: {told}. Use another --out, or delete it."
            )
        if not resume:
            raise UsageError(
                f"This training is in '{folder}' already: --resume goes on with it. Or use another --out, or delete it."
            )
    write_json(folder / "config.json", noted)
    return folder


def read_config(folder: pathlib.Path) -> dict[str, Any]:
    """config.json of the training in `folder`, a dict. Where it is damaged, UsageError says what to do."""
    try:
        return read_document(folder / "config.json", dict, "configuration")
    except UsageError as error:
        raise UsageError(
            f"{str(error).rstrip('.')}. The training in '{folder}' can't be told from another: delete the folder, or "
            "use another --out."
        ) from None


def write_checkpoint(folder: pathlib.Path, found: Mapping[str, np.ndarray], noted: Mapping[str, Any]) -> None:
    """Writes the checkpoint of the training in `folder`, all or nothing: the arrays `found`, {name: array}, and
    `noted`, a value of JSON."""
    write_bytes(pathlib.Path(folder) / CHECKPOINT, arrays.pack(found, {_NOTED: noted}))


def read_checkpoint(folder: pathlib.Path, schema: Any) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
    """({name: array}, what was noted) of the checkpoint in `folder`; None where there is none.

    schema: the msgspec type of what was noted. Raises UsageError, which says what to do, where it can't be read.
    """
    path = pathlib.Path(folder) / CHECKPOINT
    if not path.exists():
        if (old := path.with_name(OLD_CHECKPOINT)).exists():
            raise UsageError(
                f"'{old}' is of an earlier version and can't be read: a pickle may run code. Delete it to begin anew."
            )
        return None
    try:
        found, documents = arrays.unpack(path, path.stat().st_size)  # nothing in it is packed
        if documents.keys() != {_NOTED}:
            raise ValueError(f"it must hold {_NOTED}.json")
        convert(documents[_NOTED], schema, f"{_NOTED}.json")
    except (OSError, ValueError) as error:
        raise damaged(path, error) from None
    return found, documents[_NOTED]


def damaged(path: str | os.PathLike[str], reason: Any) -> UsageError:
    """The UsageError for a checkpoint that is there, but does not belong to this training."""
    told = getattr(reason, "strerror", None) or str(reason).rstrip(".")
    return UsageError(f"'{path}' is damaged or of another version ({told}): delete it to begin anew.")


def check_arrays(found: Mapping[str, np.ndarray], wanted: Mapping[str, np.ndarray]) -> None:
    """Raises ValueError unless the arrays `found` have the names, shapes and types of `wanted`, {name: array}."""
    if odd := sorted(found.keys() ^ wanted.keys()):
        raise ValueError(f"{odd[0]!r} is {'missing' if odd[0] in wanted else 'nothing that it has'}")
    for name, array in wanted.items():
        if (found[name].shape, found[name].dtype) != (array.shape, array.dtype):
            raise ValueError(
                f"{name!r} has {found[name].dtype} {found[name].shape}, not {array.dtype} {tuple(array.shape)}"
            )


def thin(rows: Sequence[Any], most: int) -> list[Any]:
    """At most `most` of `rows`, evenly spread, the first and the last among them."""
    return [rows[i] for i in np.unique(np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int))]


def write_curve(path: str | os.PathLike[str], rows: Sequence[dict[str, float]]) -> None:
    """Writes `rows`, dicts of numbers of the same keys, as a csv file; no file where there are no rows."""
    if not rows:
        return
    lines = [",".join(rows[0])] + [",".join(f"{value:.6g}" for value in row.values()) for row in rows]
    write_bytes(path, ("\n".join(lines) + "\n").encode())


class Board:
    """The curve of the training in `folder` as TensorBoard reads it, in the folder's folder `tensorboard`; in a `with`.

    A row's first value is its step, the others are scalars. curve: the rows that a training which goes on has; they are
    logged if there is no log yet. done: its steps, by default the last row's; what the log has of later ones is struck
    out. Nothing is written before the first row. Raises UsageError where the folder can't be written.
    """

    def __init__(
        self, folder: str | os.PathLike[str], curve: Sequence[dict[str, float]] = (), done: float | None = None
    ):
        self._folder, self._curve = check_folder(pathlib.Path(folder) / _BOARD), list(curve)
        self._writer: Any = None
        self._done = (next(iter(curve[-1].values())) if curve else 0) if done is None else done

    def __enter__(self):
        return self

    def __exit__(self, *error):
        if self._writer is not None:
            self._writer.close()

    def write(self, row: dict[str, float]) -> None:
        """Adds `row`, {name: number}, and writes it to the disk."""
        if not self._writer:
            self._open()
        self._add(row)
        self._writer.flush()

    def _open(self):
        EventFileWriter, Event, _, SessionLog = _tensorboard()
        begun = any(self._folder.glob("events.*"))
        self._writer = EventFileWriter(str(self._folder))
        if begun:
            strike = SessionLog(status=SessionLog.START)
            self._writer.add_event(Event(wall_time=time.time(), step=int(self._done) + 1, session_log=strike))
        else:
            for row in self._curve:
                self._add(row)

    def _add(self, row):
        _, Event, Summary, _ = _tensorboard()
        (_, step), *figures = row.items()
        values = [Summary.Value(tag=name, simple_value=float(value)) for name, value in figures]
        self._writer.add_event(Event(wall_time=time.time(), step=int(step), summary=Summary(value=values)))


def check_tensorboard() -> None:
    """Raises UsageError, which says what to install, where TensorBoard isn't."""
    _tensorboard()


def _tensorboard():
    """TensorBoard's writer of files, and what goes into them."""
    try:
        # Protocol buffers make these classes as their modules load, where no type checker sees them.
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog  # pyright: ignore[reportAttributeAccessIssue]
        from tensorboard.compat.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]
        from tensorboard.summary.writer.event_file_writer import EventFileWriter
    except ModuleNotFoundError:
        raise UsageError("--tensorboard needs tensorboard: pip install 'bson-macid[tensorboard]'.") from None
    return EventFileWriter, Event, Summary, SessionLog
