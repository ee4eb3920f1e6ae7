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


def completed(saved, config):
    """A configuration that was `saved`, as `plain` has it, with the fields that it lacks, since they came later, at their
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


def training_folder(path, config, resume):
    """`path` as the folder of a training: it gets config.json.

    config: a dataclass. Raises UsageError where another configuration's policy or checkpoint is there, or, if it isn't
    to go on, this one's: nothing is trained over.
    """
    folder, noted = output_folder(path), plain(config)
    if any((folder / name).exists() for name in ("checkpoint.pkl", "policy.npz", "policy.json")):
        before = json.loads((folder / "config.json").read_text()) if (folder / "config.json").exists() else noted
        before = completed(before, config)
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


def read_checkpoint(path):
    """What was pickled to `path`; None where there is nothing. Raises UsageError where it can't be read."""
    path = pathlib.Path(path)
    try:
        return pickle.loads(path.read_bytes()) if path.exists() else None
    except (EOFError, pickle.UnpicklingError, AttributeError, ImportError, TypeError) as error:
        raise UsageError(f"'{path}' is damaged or of another version ({error!r}): delete it to begin anew.") from None


def thin(rows, most):
    """At most `most` of `rows`, evenly spread, the first and the last among them."""
    return [rows[i] for i in np.unique(np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int))]


def write_curve(path, rows):
    """`rows`, dicts of numbers of the same keys, as a csv file."""
    lines = [",".join(rows[0])] + [",".join(f"{value:.6g}" for value in row.values()) for row in rows]
    write_bytes(path, ("\n".join(lines) + "\n").encode())
