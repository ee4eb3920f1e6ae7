"""What is changed of a task, as words: of --set on a command line, and as results.json keeps them."""

import ast
import dataclasses
from collections.abc import Iterable, Iterator
from typing import Any

from bson.task import TaskConfig
from macid.documents import check_values, shown
from macid.files import UsageError


def read_overrides(pairs: Iterable[str]) -> dict[str, Any]:
    """`KEY=VALUE` words as a dict of TaskConfig's fields; values are Python literals or plain text. Raises
    UsageError."""
    fields = [field.name for field in dataclasses.fields(TaskConfig)]
    changes = {}
    for key, text in split_pairs("--set", pairs):
        if key not in fields:
            raise UsageError(f"Unknown option {shown(key)}. Choose among {', '.join(fields)}.")
        changes[key] = literal("--set", key, text)
    return changes


def split_pairs(flag: str, pairs: Iterable[str]) -> Iterator[tuple[str, str]]:
    """(KEY, VALUE) of each of the words `KEY=VALUE` of `flag`. Raises UsageError."""
    for pair in pairs:
        key, equals, text = pair.partition("=")
        if not equals:
            raise UsageError(f"{flag} takes KEY=VALUE, not {shown(pair)}.")
        yield key, text


def literal(flag: str, key: str, text: str) -> Any:
    """The value `text` of `key` as a Python literal, if it is one that JSON can hold; otherwise the text itself. Raises
    UsageError."""
    value = _read(flag, key, text)

    def tell(key, problem):
        raise UsageError(f"{flag} {key}: {problem}.")

    check_values({key: value}, tell)
    return value


def _read(flag, key, text):
    try:
        value = ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text
    except (RecursionError, MemoryError):
        raise UsageError(f"{flag} {key}: the value is nested too deeply: {shown(text)}.") from None
    except TypeError as error:  # such as a list for a dict's key
        raise UsageError(f"{flag} {key}: {shown(text)} is no value ({error}).") from None
    waiting = [value]
    while waiting:
        one = waiting.pop()
        if isinstance(one, dict):
            waiting += one.values()
        elif isinstance(one, list | tuple):
            waiting += one
        elif not isinstance(one, None | bool | int | float | str):
            raise UsageError(f"{flag} {key} takes numbers, texts, lists and dicts, not {shown(one)}.")
    return value


def as_word(value: Any) -> str:
    """The text that `literal` reads as `value`, but that lists and tuples are one to it."""
    return value if isinstance(value, str) and _read("", "", value) == value else repr(value)
