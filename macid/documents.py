"""Documents that a user names (TOML, JSON, YAML): all are read within a bound, parsed, and checked against a schema.

Whatever is wrong with a document is a UsageError of one line that names the file, the key and what is allowed there.
"""

import collections
import json
import math
import numbers
import os
import pathlib
import re
import reprlib
import tomllib
import types
import typing
from collections.abc import Callable
from typing import Any, NoReturn, TypeVar

import msgspec
import yaml

from macid.files import UsageError

T = TypeVar("T")

MOST_BYTES = 1 << 20  # of a map, a robot, a suite [bytes]
MOST_NUMBER = 1e18  # in any field, beside whole numbers, which may fill 64 bits
_SHOWN = 60  # characters of a value in a message
_SHOWN_PATH = 120  # characters of a file's name in a message
_MOST_DEEP = 100  # brackets in brackets of YAML
_MOST_PARTS = 64  # parts of a dotted key: tomllib's time grows with their square


def number(description: str, **bounds: Any) -> Any:
    """The type of a number within `bounds` (as msgspec.Meta has them), for which messages say `description`. A whole
    number stays whole, as digests have it."""
    rounded = {key: math.ceil(bound) if key in ("ge", "lt") else math.floor(bound) for key, bound in bounds.items()}
    whole, real = ({"description": description, **each} for each in (rounded, bounds))
    return typing.Annotated[int, msgspec.Meta(**whole)] | typing.Annotated[float, msgspec.Meta(**real)]


def shown(value: Any) -> str:
    """`value` as a message shows it: short, and printable on any terminal."""
    text = reprlib.repr(value) if isinstance(value, dict | list | tuple) else repr(value)
    text = text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."
    return text.encode("ascii", "backslashreplace").decode()


def shown_path(path: Any) -> str:
    """`path` as a message shows it: in quotes, on one line, printable on any terminal; of a long one the end."""
    text = repr(str(path)).encode("ascii", "backslashreplace").decode()
    return text if len(text) <= _SHOWN_PATH else f"'...{text[4 - _SHOWN_PATH :]}"


def is_number(value: Any, least: float = -MOST_NUMBER, most: float = MOST_NUMBER) -> bool:
    """Whether `value`, Python's or NumPy's, is a number from `least` to `most`: not NaN, not infinite, and no bool."""
    if not isinstance(value, numbers.Real) or isinstance(value, bool):
        return False
    return bool(value <= most and not value < least)


def read_bytes(path: str | os.PathLike[str], what: str, most: int = MOST_BYTES) -> bytes:
    """The content of the file `path`, which a user named as a `what` ("map"). Raises UsageError where it is no regular
    file, can't be read, or has more than `most` bytes."""
    path = check_readable(path, what, most)
    try:
        with path.open("rb") as file:
            return file.read(most)
    except OSError as error:
        raise _unreadable(path, what, error) from None


def check_readable(path: str | os.PathLike[str], what: str, most: int = MOST_BYTES) -> pathlib.Path:
    """The pathlib.Path of the file `path`, which a user named as a `what`. Raises UsageError as read_bytes does, but
    does not read the file."""
    path = pathlib.Path(path)
    try:
        if not path.exists():
            raise UsageError(f"There is no {what} file {shown_path(path)}.")
        if not path.is_file():
            raise UsageError(f"{shown_path(path)} is no regular file, so no {what}.")
        size = path.stat().st_size
    except (OSError, ValueError) as error:  # ValueError: a null byte in the name
        if isinstance(error, UsageError):
            raise
        raise _unreadable(path, what, error) from None
    if size > most:
        raise UsageError(f"{what} {shown_path(path)} has {size:,} bytes; at most {most:,} are read.")
    return path


def _unreadable(path, what, error):
    return UsageError(f"Can't read the {what} {shown_path(path)}: {getattr(error, 'strerror', error)}.")


def _twice(keys):
    """The first of `keys` that stands there twice, or None."""
    return next((key for key, count in collections.Counter(keys).items() if count > 1), None)


class _Yaml(yaml.SafeLoader):
    """YAML without aliases, which can expand without end, and with `1e-1` as a number, as YAML 1.2 has it."""

    def compose_node(self, parent, index):
        if self.check_event(yaml.events.AliasEvent):
            raise yaml.YAMLError("aliases (*name) are not supported")
        return super().compose_node(parent, index)

    def fetch_flow_collection_start(self, TokenClass):
        if self.flow_level >= _MOST_DEEP:  # before PyYAML looks ahead in time that grows with the square
            raise yaml.YAMLError("it is nested too deeply")
        super().fetch_flow_collection_start(TokenClass)

    def construct_mapping(self, node, deep=False):
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if twice := _twice(keys):
            raise yaml.YAMLError(f"the key {shown(twice)} stands twice")
        return super().construct_mapping(node, deep)


_Yaml.yaml_implicit_resolvers = {key: list(found) for key, found in yaml.SafeLoader.yaml_implicit_resolvers.items()}
_Yaml.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$"), list("-+.0123456789")
)


def _no_twins(pairs):
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError(f"the key {shown(_twice(key for key, _ in pairs))} stands twice")
    return found


_KEY_PARTS = re.compile(r"""[\w-]+|"(?:[^"\\\n]|\\.)*"?|'[^'\n]*'?|\.|[^\S\n]+|.|\n""")


def _toml(text):
    """TOML, without keys of so many parts (a.b.c...) that reading them would take minutes. Raises ValueError."""
    if text.count(".") > _MOST_PARTS:
        parts, dotted = 0, False
        for token in _KEY_PARTS.finditer(text):
            first = token[0][0]
            if first == ".":
                dotted = True
            elif first.isalnum() or first in "_-\"'":
                parts, dotted = parts + 1 if dotted else 1, False
                if parts > _MOST_PARTS:
                    raise ValueError(f"a key has more than {_MOST_PARTS} parts")
            elif first == "\n" or not first.isspace():
                parts, dotted = 0, False
    return tomllib.loads(text)


_PARSERS = {
    ".toml": ("TOML", _toml),
    ".json": ("JSON", lambda text: json.loads(text, object_pairs_hook=_no_twins)),
    ".yaml": ("YAML", lambda text: yaml.load(text, _Yaml)),
    ".yml": ("YAML", lambda text: yaml.load(text, _Yaml)),
}


def parse(path: str | os.PathLike[str], what: str, content: bytes, ending: str | None = None) -> Any:
    """The document in `content` (bytes), parsed as the ending of `path`, or `ending`, says: dicts, lists, numbers,
    text. Raises UsageError."""
    ending = pathlib.Path(path).suffix if ending is None else ending
    if ending not in _PARSERS:
        raise UsageError(f"{what} {shown_path(path)} must end in {', '.join(_PARSERS)}.")
    language, parser = _PARSERS[ending]
    try:
        return parser(content.decode("utf-8-sig"))
    except RecursionError:
        problem = "it is nested too deeply"
    except (ValueError, yaml.YAMLError, ArithmeticError, AttributeError, LookupError, TypeError) as error:
        # PyYAML raises the last four for odd scalars, such as `!!int ""` and `1:1:...:1.5`
        problem = " ".join(str(error).split())
    problem = problem.encode("ascii", "backslashreplace").decode()[:300]
    raise UsageError(f"{what} {shown_path(path)} is not {language}: {problem}")


def check_values(
    document: Any, tell: Callable[[str, str], object], described: Callable[[str], str] = lambda key: ""
) -> None:
    """Refuses values that are valid in no field: numbers that are not finite or beyond MOST_NUMBER, text that no
    encoding has, keys that are no text. tell(key, problem): raises the error. described(key): what a number has to be
    there, or ""."""

    def refuse_number(key, wanted, found):
        said = described(key)
        tell(key, f"it must be {said}, not {found}" if said else f"{wanted} is wanted, not {found}")

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
            refuse_number(key, f"a number from -{MOST_NUMBER:g} to {MOST_NUMBER:g}", f"{value:g}")
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            refuse_number(key, "a whole number of 64 bits", "one beyond")
        elif isinstance(value, str) and not value.isascii() and any("\ud800" <= c <= "\udfff" for c in value):
            tell(key, f"text is wanted, not half a character: {shown(value)}")


def convert(document: Any, schema: type[T], name: str) -> T:
    """`document` as the msgspec type `schema`. name: how messages call it ("map 'hall.toml'"). Raises UsageError.

    What is allowed follows from the types; where a `description` of a msgspec.Meta says it better, messages have that.
    """

    def tell(key: str, problem: str) -> NoReturn:
        where = f", key {shown(key)}" if key else ""
        raise UsageError(f"{name}{where}: {problem}.")

    def described(key):
        try:
            return _description(_place(document, schema, f"$.{key}")[2])
        except (LookupError, TypeError):  # a key that the schema doesn't have
            return ""

    check_values(document, tell, described)
    try:
        return msgspec.convert(document, schema, strict=True)
    except msgspec.ValidationError as error:
        tell(*_explained(document, schema, str(error)))
    except RecursionError:
        tell("", "it is nested too deeply")


_STEP = re.compile(r"\.(\w+)|\[(\d+)\]|\[(\.\.\.)\]")
_WORDS = {
    "float": "a number",
    "int": "a whole number",
    "str": "text",
    "bool": "true or false",
    "object": "a table of keys",
    "array": "a list",
}


def _alternatives(kinds):
    """The types that the annotations `kinds` allow, each with its msgspec.Meta or None: [(type, Meta or None)]."""
    found = []
    for kind in kinds:
        meta, origin = None, typing.get_origin(kind)
        if origin is typing.Annotated:
            kind, meta = typing.get_args(kind)[:2]
            origin = typing.get_origin(kind)
        if origin in (typing.Union, types.UnionType):
            found += _alternatives(typing.get_args(kind))
        else:
            found.append((kind, meta))
    return found


def _fits(value, kind):
    try:
        msgspec.convert(value, kind, strict=True)
    except msgspec.ValidationError:
        return False
    return True


def _place(document, schema, path):
    """Where msgspec's `path` ("$.mounts[...].position") leads in `document`: the key, the value, the types allowed, and
    the last description (msgspec.Meta) on the way, or ""."""
    key, value, kinds, around = "", document, [schema], ""
    for name, index, _ in _STEP.findall(path):
        allowed = [kind for kind, _ in _alternatives(kinds)]
        around = _description(kinds) or around
        if name:
            key, value = f"{key}.{name}" if key else name, value[name]
            kinds = [typing.get_type_hints(kind, include_extras=True)[name] for kind in allowed if hasattr(kind, name)]
        elif index:
            key, value = f"{key}[{index}]", value[int(index)]
            kinds = [
                args[min(int(index), len(args) - 1) if args[-1] is not ... else 0]
                for kind in allowed
                if typing.get_origin(kind) in (list, tuple) and (args := typing.get_args(kind))
            ]
        else:  # msgspec doesn't say which of a table's values it is
            kinds = [typing.get_args(kind)[1] for kind in allowed if typing.get_origin(kind) is dict]
            wrong = [each for each in value.items() if kinds and not _fits(each[1], kinds[0])]
            if not wrong:
                break
            key, value = f"{key}.{wrong[0][0]}" if key else wrong[0][0], wrong[0][1]
    return key, value, kinds, around


def _description(kinds):
    return next((meta.description for _, meta in _alternatives(kinds) if meta is not None and meta.description), "")


def _range(meta):
    """What a number's or a list's Meta allows, in words."""
    if meta.min_length is not None and meta.min_length == meta.max_length:
        return f"of {meta.min_length}"
    sized = meta.min_length is not None or meta.max_length is not None
    least, most = (meta.min_length, meta.max_length) if sized else (meta.ge, meta.le)
    words = ["" if least is None else f"of at least {least:g}", "" if most is None else f"of at most {most:g}"]
    if meta.gt is not None:
        words[0] = f"above {meta.gt:g}"
    if meta.lt is not None:
        words[1] = f"below {meta.lt:g}"
    return " and ".join(filter(None, words))


def _explained(document, schema, text):
    """msgspec's message `text` about `document`: (key, problem), with the value and what is allowed."""
    problem, _, path = text.partition(" - at `$")
    key, value, kinds, around = _place(document, schema, path)
    allowed = _alternatives(kinds)
    fields = [name for kind, _ in allowed for name in getattr(kind, "__struct_fields__", ())]
    if found := re.fullmatch(r"Object missing required field `(.*)`", problem):
        return key, f"missing '{found[1]}'. Its keys are {', '.join(fields)}"
    if found := re.fullmatch(r"(?s)Object contains unknown field `(.*)`", problem):
        return key, f"unknown key {shown(found[1])}. Choose among {', '.join(fields)}"
    choices = [choice for kind, _ in allowed if typing.get_origin(kind) is typing.Literal for choice in kind.__args__]
    if choices:
        return key, f"it must be one of {', '.join(map(str, choices))}, not {shown(value)}"
    if said := _description(kinds):
        return key, f"it must be {said}, not {shown(value)}"
    around = f" ({around})" if around else ""
    ranges = [words for _, meta in allowed if meta is not None and (words := _range(meta))]
    if found := re.match(r"Expected `([^`]*)`(, got `[^`]*`)?(.*)", problem):
        wanted = " or ".join(_WORDS.get(word, word) for word in found[1].split(" | ") if word != "null")
        lengths = [len(typing.get_args(kind)) for kind, _ in allowed if typing.get_origin(kind) is tuple]
        if lengths and typing.get_args(allowed[0][0])[-1] is not ...:
            ranges = [f"of {lengths[0]}"]
        rest = f" {ranges[0]}" if ranges and len(allowed) == 1 else "" if found[2] else found[3]
        return key, f"it must be {wanted}{rest}, not {shown(value)}{around}"
    return key, f"{problem.replace('`', chr(39))[:300]}, not {shown(value)}{around}"


def read_document(path: str | os.PathLike[str], schema: type[T], what: str, most: int = MOST_BYTES) -> T:
    """The document in the file `path` (.toml, .json, .yaml or .yml) as the msgspec type `schema`.

    what: how messages call it ("map"). Raises UsageError, one line that names the file, the key and what is allowed.
    """
    content = read_bytes(path, what, most)
    return convert(parse(path, what, content), schema, f"{what} {shown_path(path)}")
