"""Arrays, and JSON beside them, in one zip file, as numpy.savez lays it out.

There is no pickle in such a file, so that reading it runs no code. Memory is taken only once it is known that all sizes
which the file declares are within bounds.
"""

import io
import json
import math
import os
import re
import zipfile
import zlib
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np

MOST_NAMES = 4096  # arrays and documents in a file
# What numpy writes before an array's numbers. Kinds: bool, signed and unsigned whole numbers, floats.
_HEADER = re.compile(
    rb"\{'descr': '([<>|][biuf][1248])', 'fortran_order': (True|False), 'shape': \(((?:\d{1,18}, ?)*\d{0,18})\), \} *\n"
)
_MAGIC, _MOST_HEADER = b"\x93NUMPY", 65_536  # bytes


class DamagedError(ValueError):
    """A file holds something else than arrays and JSON, or more than was asked for; the message says what."""


def pack(arrays: Mapping[str, np.ndarray], documents: Mapping[str, Any] | None = None) -> bytes:
    """The content (bytes) of a file that holds `arrays`, {name: array}, and `documents`, {name: a value of JSON}."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, document in (documents or {}).items():
            with archive.open(f"{name}.json", "w", force_zip64=True) as member:
                member.write(json.dumps(document, allow_nan=False).encode())
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)
    return buffer.getvalue()


def unpack(file: BinaryIO | str | os.PathLike[str], most: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """What `pack` or numpy.savez wrote to `file` (a path, or an open binary file): ({name: array}, {name: document}).

    most: the bytes that all arrays and documents may have together, unpacked. Raises DamagedError, and OSError where
    the file can't be read.
    """
    arrays, documents = {}, {}
    try:
        with zipfile.ZipFile(file) as archive:
            for member in _members(archive, most):
                name, _, kind = member.filename.rpartition(".")
                with archive.open(member) as stream:
                    if kind == "npy":
                        arrays[name] = _array(name, stream, member.file_size)
                    else:
                        documents[name] = _document(name, stream.read())
    except (zipfile.BadZipFile, zlib.error, EOFError, UnicodeDecodeError, NotImplementedError, OverflowError) as error:
        raise DamagedError(f"it is no sound zip file ({' '.join(str(error).split()) or 'it ends too early'})") from None
    return arrays, documents


def _members(archive, most):
    """The zip's members, once it is known that they may be read."""
    members = archive.infolist()
    if len(members) > MOST_NAMES:
        raise DamagedError(f"it holds {len(members):,} arrays; at most {MOST_NAMES:,} are read")
    if (declared := sum(member.file_size for member in members)) > most:
        raise DamagedError(f"it unpacks to {declared:,} bytes; at most {most:,} are read")
    if len({member.filename for member in members}) < len(members):
        raise DamagedError("a name stands twice in it")
    for member in members:
        if not member.filename.endswith((".npy", ".json")):
            raise DamagedError(f"{member.filename[:60]!r} in it is neither an array (.npy) nor JSON")
        if member.flag_bits & 0x1 or member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise DamagedError(f"{member.filename[:60]!r} in it is encrypted, or packed otherwise than by deflating")
    return members


def _array(name, stream, size):
    """The array of `size` bytes, its header included, that `stream` gives."""
    start = stream.read(8)
    width = {1: 2, 2: 4}.get(start[6], 0) if start[:6] == _MAGIC and len(start) == 8 else 0
    length = int.from_bytes(stream.read(width), "little")
    header = stream.read(length) if width and length <= _MOST_HEADER else b""
    found = _HEADER.fullmatch(header)
    if not found:
        raise DamagedError(f"{name[:60]!r} in it is no array of numbers")
    kind, shape = np.dtype(found[1].decode()), tuple(map(int, re.findall(rb"\d+", found[3])))
    wanted = size - 8 - width - length
    if len(shape) > 32 or math.prod(shape) * kind.itemsize != wanted:
        declared = "x".join(map(str, shape[:8]))
        raise DamagedError(f"{name[:60]!r} in it declares {declared} numbers, but has {wanted:,} bytes")
    content = stream.read(wanted + 1)
    if len(content) != wanted:
        raise EOFError
    order = "F" if found[2] == b"True" else "C"
    return np.frombuffer(content, kind).reshape(shape, order=order).astype(kind.newbyteorder("="), copy=True)


def _document(name, content):
    try:
        return json.loads(content)
    except (ValueError, RecursionError) as error:
        raise DamagedError(f"{name[:60]!r} in it is no JSON ({type(error).__name__})") from None
