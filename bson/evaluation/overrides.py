"""What is changed of a task, as words: of --set on a command line, and as results.json keeps them."""

import ast
import dataclasses
from collections.abc import Iterable
from typing import Any

from bson.task import TaskConfig
from macid.documents import check_values, shown
from macid.files import UsageError


def read_overrides(pairs: Iterable[str]) -> dict[str, Any]:
    """`KEY=VALUE` words as a dict of TaskConfig's fields; values are Python literals or plain text. Raises
    UsageError."""
    fields = [field.name for field in dataclasses.fields(TaskConfig)]
    changes = {}
    for pair in pairs:
        key, equals, text = pair.partition("=")
        if not equals:
            raise UsageError(f"--set takes KEY=VALUE, not {shown(pair)}.")
        if key not in fields:
            raise UsageError(f"Unknown option {shown(key)}. Choose among {', '.join(fields)}.")
        changes[key] = _literal(key, text)

    def tell(key, problem):
        raise UsageError(f"--set {key}: {problem}.")

    check_values(changes, tell)
    return changes


def _literal(key, text):
    """`text` as a Python literal, if it is one that JSON can hold; otherwise the text itself. Raises UsageError."""
    try:
        value = ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text
    except (RecursionError, MemoryError):
        raise UsageError(f"--set {key}: the value is nested too deeply: {shown(text)}.") from None
    except TypeError as error:  # such as a list for a dict's key
        raise UsageError(f"--set {key}: {shown(text)} is no value ({error}).") from None
    waiting = [value]
    while waiting:
        one = waiting.pop()
        if isinstance(one, dict):
            waiting += one.values()
        elif isinstance(one, list | tuple):
            waiting += one
        elif not isinstance(one, None | bool | int | float | str):
            raise UsageError(f"--set {key} takes numbers, texts, lists and dicts, not {shown(one)}.")
    return value
