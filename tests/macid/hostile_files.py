"""Files as they should not be: strategies of hypothesis that change a good one, for the tests of both packages."""

import copy
import io
import json
import warnings
import zipfile

import numpy as np
from hypothesis import strategies as st

_ODD_TEXT = ["", "nan", "a\nb", "a\x85b", "\u2028", "\x1b[31m", "\udcff", "x" * 5000, "../..", "'\"`", "é", "|", "%s{}"]
_ODD_TEXT += ["\x00"]
_ODD_NUMBERS = [0, -1, 1, 2**53, 2**63, -(2**64), 10**400, 0.5, -0.5, 1e-320, 1e18, 1e19, 1e308, -1e308]
_ODD_NUMBERS += [float("nan"), float("inf"), float("-inf"), True, False]
_words = st.text(max_size=5)
_leaves = st.none() | st.sampled_from(_ODD_NUMBERS) | st.sampled_from(_ODD_TEXT) | st.integers() | st.floats() | _words
values = st.recursive(
    _leaves, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(_words, inner, max_size=3), max_leaves=6
)


@st.composite
def documents(draw, good, most=3):
    """`good`, what JSON has, with up to `most` of its values replaced, removed, renamed or doubled."""
    document = copy.deepcopy(good)
    for _ in range(draw(st.integers(1, most))):
        parent, key, here = None, None, document
        while isinstance(here, dict | list) and here and (parent is None or draw(st.integers(0, 3))):
            keys = list(here) if isinstance(here, dict) else range(len(here))
            parent, key = here, keys[draw(st.integers(0, len(keys) - 1))]
            here = parent[key]
        if parent is None:
            return draw(values)
        kind = draw(st.sampled_from(["replace", "replace", "remove", "rename", "double", "empty"]))
        if kind == "replace":
            parent[key] = draw(values)
        elif kind == "remove":
            del parent[key]
        elif kind == "empty":
            parent[key] = type(here)() if isinstance(here, dict | list | str) else None
        elif isinstance(parent, list):
            parent.insert(key, copy.deepcopy(here))
        else:
            parent[draw(st.sampled_from(_ODD_TEXT + list(parent)))] = here
            if kind == "rename":
                del parent[key]
    return document


@st.composite
def scribbled(draw, content):
    """`content` (bytes) with some cut away, overwritten, put in or doubled."""
    for _ in range(draw(st.integers(1, 3))):
        first = draw(st.integers(0, len(content)))
        last = draw(st.integers(first, min(len(content), first + 64)))
        odd = [b"", b"\x00", b"\xff", b"[", b"NaN", content[first:last] * 2]
        put = draw(st.sampled_from(odd) | st.binary(max_size=8))
        content = draw(st.sampled_from([content[:first] + put + content[last:], content[:first], content[first:]]))
    return content


@st.composite
def json_files(draw, good):
    """The bytes of a JSON file that was `good`."""
    kind = draw(st.integers(0, 9))
    if kind < 6:
        return json.dumps(draw(documents(good))).encode("utf-8", "surrogatepass")
    if kind < 9:
        return draw(scribbled(json.dumps(good).encode()))
    deep = draw(st.sampled_from([50, 500, 3000, 100_000]))
    text = json.dumps(good)
    odd = [
        "[" * deep + "]" * deep,
        '{"a":' * deep + "1" + "}" * deep,
        text.replace("{", '{"deep": ' + "[" * deep + "]" * deep + ",", 1),
        text.replace("{", "{" + text[1 : text.index(":")] + ": 1, ", 1),  # a key twice
        "",
        "null",
    ]
    marked = [text.encode("utf-16"), b"\xef\xbb\xbf" + text.encode()]
    return draw(st.sampled_from([each.encode() for each in odd] + marked))


_DTYPES = ["<f2", "<f4", ">f4", "<f8", "<i4", "<c8", "|b1", "<U3", "|O", "<f16", "<M8[s]", "|V4", "<f3"]
_SHAPES = [(), (0,), (3,), (2, 2), (2, 0), (10**9, 10**9), (2**62, 4), (1,) * 33, (-1, 2), (1, 2, 3)]


@st.composite
def array_files(draw, good):
    """The bytes of an .npz file whose arrays, {name: array}, were `good`."""
    buffer = io.BytesIO()
    if draw(st.integers(0, 3)) == 0:
        np.savez(buffer, **good)
        return draw(scribbled(buffer.getvalue()))
    packing = draw(st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]))
    changed = draw(st.sets(st.sampled_from(sorted(good)), min_size=0, max_size=2))
    with zipfile.ZipFile(buffer, "w", packing) as archive:
        for name, array in good.items():
            content = io.BytesIO()
            kind = draw(st.sampled_from(["value", "type", "shape", "header", "drop", "rename", "scribble", "zeros"]))
            kind = kind if name in changed else "keep"
            if kind == "value" and array.size:
                array = array.copy()
                odd = draw(st.sampled_from([np.nan, np.inf, 3e38, 1e7, -0.0, 1e-45]))
                array.flat[draw(st.integers(0, array.size - 1))] = odd
            elif kind == "type":
                kinds = [np.float16, np.float64, ">f4", int, bool, complex, object, "U4", np.longdouble]
                with np.errstate(over="ignore", invalid="ignore"):
                    array = array.astype(draw(st.sampled_from(kinds)))
            elif kind == "shape":
                others = [array.T, array[:-1], array[None], array.ravel(), array[:0], array[..., ::-1]]
                array = draw(st.sampled_from(others))
            np.lib.format.write_array(content, np.asarray(array), allow_pickle=True)
            content = content.getvalue()
            if kind == "header":
                kinds, shape = draw(st.sampled_from(_DTYPES)), draw(st.sampled_from(_SHAPES))
                header = f"{{'descr': {kinds!r}, 'fortran_order': False, 'shape': {shape!r}, }}\n".encode()
                content = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + content[-16:]
            elif kind == "scribble":
                content = draw(scribbled(content))
            elif kind == "zeros":
                content += bytes(draw(st.sampled_from([1, 100_000])))
            elif kind == "drop":
                continue
            elif kind == "rename":
                name = draw(st.sampled_from(["weight9", "x", "../x", "", "bias0", "weight00", "\u00e9"]))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # of a name that stands twice
                archive.writestr(f"{name}.npy", content)
    content = buffer.getvalue()
    return draw(scribbled(content)) if draw(st.integers(0, 9)) == 0 else content
