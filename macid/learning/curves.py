"""What a training writes beside its policy: its configuration and its curve."""

import dataclasses
import json

import numpy as np

from macid.files import write_bytes


def plain(config):
    """A configuration (a dataclass) as JSON has it: dicts, lists, numbers and strings."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def thin(rows, most):
    """At most `most` of `rows`, evenly spread, the first and the last among them."""
    return [rows[i] for i in np.unique(np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(int))]


def write_curve(path, rows):
    """`rows`, dicts of numbers of the same keys, as a csv file."""
    lines = [",".join(rows[0])] + [",".join(f"{value:.6g}" for value in row.values()) for row in rows]
    write_bytes(path, ("\n".join(lines) + "\n").encode())
