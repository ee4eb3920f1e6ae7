"""Documents that a user names (TOML, JSON, YAML): read within a bound, parsed, and checked against a schema in one place.

Whatever is wrong with one is a UsageError of one line that names the file, the key and what is allowed there.
"""

import json
import math
import numbers
import pathlib
import re
import tomllib

import msgspec
import yaml

from macid.files import UsageError

MOST_BYTES = 1 << 20  # of a map, a robot, a suite [bytes]
MOST_NUMBER = 1e18  # in any field, beside whole numbers, which may fill 64 bits
_SHOWN = 60  # characters of a value in a message


def shown(value):
    """`value` as a message shows it: short, and printable on any terminal."""
    text = repr(value)
    text = text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."
    return text.encode("ascii", "backslashreplace").decode()


def is_number(value, least=-MOST_NUMBER, most=MOST_NUMBER):
    """Whether `value`, Python's or NumPy's, is a number from `least` to `most`, so neither NaN nor infinite nor a bool."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool) and bool(least <= value <= most)


def read_bytes(path, what, most=MOST_BYTES):
    """The content of the file `path`, a `what` ("map") that a user named. Raises UsageError: no regular file, unreadable, or
    of more than `most` bytes."""
    path = pathlib.Path(path)
    try:
        if not path.exists():
            raise UsageError(f"There is no {what} file {shown(str(path))}.")
        if not path.is_file():
            raise UsageError(f"{shown(str(path))} is no regular file, so no {what}.")
        if (size := path.stat().st_size) > most:
            raise UsageError(f"{what} {shown(str(path))} has {size:,} bytes; at most {most:,} are read.")
        return path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a null byte in the name
        if isinstance(error, UsageError):
            raise
        raise UsageError(f"Can't read the {what} {shown(str(path))}: {getattr(error, 'strerror', error)}.") from None


class _Yaml(yaml.SafeLoader):
    """YAML without aliases, which can expand without end, and with `1e-1` as a number, as YAML 1.2 has it."""

    def compose_node(self, parent, index):
        if self.check_event(yaml.events.AliasEvent):
            raise yaml.YAMLError("aliases (*name) are not supported")
        return super().compose_node(parent, index)

    def construct_mapping(self, node, deep=False):
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if twice := sorted({key for key in keys if keys.count(key) > 1}):
            raise yaml.YAMLError(f"the key '{twice[0]}' stands twice")
        return super().construct_mapping(node, deep)


_Yaml.yaml_implicit_resolvers = {key: list(found) for key, found in yaml.SafeLoader.yaml_implicit_resolvers.items()}
_Yaml.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$"), list("-+.0123456789")
)


def _no_twins(pairs):
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"the key {shown(next(key for key in keys if keys.count(key) > 1))} stands twice")
    return found


_PARSERS = {
    ".toml": ("TOML", tomllib.loads),
    ".json": ("JSON", lambda text: json.loads(text, object_pairs_hook=_no_twins)),
    ".yaml": ("YAML", lambda text: yaml.load(text, _Yaml)),
    ".yml": ("YAML", lambda text: yaml.load(text, _Yaml)),
}


def parse(path, what, content):
    """The document in `content` (bytes), as the ending of `path` has it: dicts, lists, numbers, text. Raises UsageError."""
    path = pathlib.Path(path)
    language, parser = _PARSERS[path.suffix]
    try:
        return parser(content.decode("utf-8-sig"))
    except RecursionError:
        problem = "it is nested too deeply"
    except (ValueError, yaml.YAMLError, AttributeError, TypeError) as error:  # what the parsers raise for odd content
        problem = " ".join(str(error).split())
    problem = problem.encode("ascii", "backslashreplace").decode()[:300]
    raise UsageError(f"{what} {shown(str(path))} is not {language}: {problem}")


def check_values(document, tell):
    """Refuses what no field has: numbers that are not finite or beyond MOST_NUMBER, text that no encoding has, keys that are
    no text. tell(key, problem): raises the error."""
    waiting = [("", document)]
    while waiting:
        key, value = waiting.pop()
        if isinstance(value, dict):
            if odd := [name for name in value if not isinstance(name, str)]:
                tell(key, f"keys are text, not {shown(odd[0])}")
            waiting += [(key, name) for name in value]
            waiting += [(f"{key}.{name}" if key else name, each) for name, each in value.items()]
        elif isinstance(value, list | tuple):
            waiting += [(f"{key}[{index}]", each) for index, each in enumerate(value)]
        elif isinstance(value, float) and not (math.isfinite(value) and abs(value) <= MOST_NUMBER):
            tell(key, f"a number from -{MOST_NUMBER:g} to {MOST_NUMBER:g} is wanted, not {value:g}")
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            tell(key, "a whole number of 64 bits is wanted, not one beyond")
        elif isinstance(value, str) and not value.isascii() and any("\ud800" <= c <= "\udfff" for c in value):
            tell(key, f"text is wanted, not half a character: {shown(value)}")


def convert(document, schema, name):
    """`document` as the msgspec type `schema`. name: how messages call it ("map 'hall.toml'"). Raises UsageError."""

    def tell(key, problem):
        where = f", key {shown(key)}" if key else ""
        raise UsageError(f"{name}{where}: {problem}.")

    check_values(document, tell)
    try:
        return msgspec.convert(document, schema, strict=True)
    except (msgspec.ValidationError, RecursionError) as error:
        problem, _, key = str(error).partition(" - at `$")
        tell(key.rstrip("`").lstrip("."), problem.replace("`", "'")[:300])


def read_document(path, schema, what, most=MOST_BYTES):
    """The document in the file `path` (.toml, .json, .yaml or .yml) as the msgspec type `schema`.

    what: how messages call it ("map"). Raises UsageError, one line that names the file, the key and what is allowed.
    """
    content = read_bytes(path, what, most)
    return convert(parse(path, what, content), schema, f"{what} {shown(str(path))}")
