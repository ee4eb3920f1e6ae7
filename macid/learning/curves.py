"""What a training has in its folder beside its policy: its configuration, its curve and its checkpoint."""

import dataclasses
import json
import pathlib
import pickle

import numpy as np

from macid.files import UsageError, output_folder, write_bytes, write_json


def plain(config):
    """A configuration (a dataclass) as JSON has it: dicts, lists, numbers and strings."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def training_folder(path, config, resume):
    """`path` as the folder of a training: it gets config.json, and loses what an earlier one left if it isn't to go on.

    config: a dataclass. Raises UsageError where another configuration's policy or checkpoint is there.
    """
    folder, noted = output_folder(path), plain(config)
    made = [folder / name for name in ("checkpoint.pkl", "policy.npz", "policy.json", "curve.csv")]
    if any(file.exists() for file in made) and (folder / "config.json").exists():
        before = json.loads((folder / "config.json").read_text())
        if changed := sorted(name for name in {*before, *noted} if before.get(name) != noted.get(name)):
            raise UsageError(
                f"What is in '{folder}' is of another configuration: {' and '.join(changed)} differ. "
                "Use another --out, or delete it."
            )
    if not resume:
        for file in made:
            file.unlink(missing_ok=True)
    write_json(folder / "config.json", noted)
    return folder


def read_checkpoint(path):
    """What was pickled to `path`; None where there is nothing. Raises UsageError where it can't be read."""
    path = pathlib.Path(path)
    try:
        return pickle.loads(path.read_bytes()) if path.exists() else None
    except (EOFError, pickle.UnpicklingError, AttributeError, ImportError, TypeError) as error:
        raise UsageError(f"'{path}' is damaged or of another version ({error!r}): leave --resume out.") from None


def thin(rows, most):
    """At most `most` of `rows`, evenly spread, the first and the last among them."""
    return [rows[i] for i in np.unique(np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int))]


def write_curve(path, rows):
    """`rows`, dicts of numbers of the same keys, as a csv file."""
    lines = [",".join(rows[0])] + [",".join(f"{value:.6g}" for value in row.values()) for row in rows]
    write_bytes(path, ("\n".join(lines) + "\n").encode())
