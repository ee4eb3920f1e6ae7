"""One resolver for every kind of name: a built-in, the user's own `module:attribute` or `file.py:attribute`, or a data
file.

A `Kind` is one kind of thing that users name: a pedestrian model, an agent, a map. It says which names come with the
project, which files are read, and which objects of the user's own are valid.
"""

import contextlib
import dataclasses
import importlib
import importlib.util
import os
import pathlib
import sys
import sysconfig
import traceback
import types
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Generic, TypeVar

from macid.documents import shown, shown_path
from macid.files import UsageError

T = TypeVar("T")
_LIBRARY = sysconfig.get_paths()["stdlib"]  # Python's own files
_MISSING = object()
_SHOWN = 40  # names listed in a message


class Failed(UsageError, RuntimeError):
    """The user's own code raised an error, the cause, or called exit()."""


@dataclasses.dataclass(frozen=True)
class Kind(Generic[T]):
    """One kind of name.

    `load` takes a name of `names()`, a data file whose ending is among `files`, `module:attribute`, or
    `file.py[:attribute]`.
    """

    what: str  #: its name in messages: "pedestrian model"
    built_in: Mapping[str, Any] = dataclasses.field(default_factory=dict)  #: {name: the object, or "module:attribute"}
    shipped: Callable[[], Sequence[str]] = tuple  #: names of data files that come with the project
    listed: Callable[[], Sequence[str]] | None = None  #: the names that messages list; None: all
    read: Callable[[str], T] | None = None  #: reads a shipped name or a data file; gives the object
    files: tuple[str, ...] = ()  #: endings of data files
    own: str = "attribute"  #: the kind of object at `module:...`: "function", "class"
    attribute: str = ""  #: the attribute of a file.py where none is given; "": one must be given
    check: Callable[[Any, str], T] | None = None  #: (own object, its name) -> `load`'s result, or an error
    error: type[UsageError] | type[ValueError] = UsageError  #: the error for a wrong name
    failed: type[Exception] = Failed  #: the error for failing code of the user's own

    def names(self) -> list[str]:
        """The names that come with the project, for messages and lists."""
        return list(self.listed()) if self.listed else [*self.built_in, *self.shipped()]

    @property
    def forms(self) -> str:
        """The forms that are valid beside the names: "a 'module:function', or a .npz file"; "" without any."""
        words = []
        if self.check is not None or self.attribute:
            attribute = f"[:{self.own}]" if self.attribute else f":{self.own}"
            words += [f"a 'module:{self.own}'", f"a file '{self.what.split()[-1]}.py{attribute}'"]
        if self.files:
            *most, last = self.files
            words.append(f"a {', '.join(most)}{' or ' if most else ''}{last} file")
        *most, last = words or [""]
        return f"{', '.join(most)}, or {last}" if most else last

    @property
    def help(self) -> str:
        """The valid names and forms, as a sentence."""
        named = f"one of {', '.join(self.names())}" if self.names() else ""
        between = "" if not (named and self.forms) else ", " if ", or " in self.forms else ", or "
        return f"Choose {named}{between}{self.forms}."

    def unknown(self, name: Any) -> Exception:
        """The error for a `name` that is none of these."""
        return self.error(f"Unknown {self.what} {shown(name)}. {self.help}")

    def load(self, name: str) -> T:
        """The object that `name` stands for. Raises `error`, with the valid choices, and `failed` where the user's own
        code fails."""
        if not isinstance(name, str):
            raise self.unknown(name)
        if name in self.built_in:
            found = self.built_in[name]
            if isinstance(found, str):
                module, _, attribute = found.partition(":")
                found = getattr(importlib.import_module(module), attribute)
            return found
        if self.read is not None and (name.endswith(self.files or ("\0",)) or name in self.shipped()):
            return self.read(name)
        if self.check is None and not self.attribute:
            raise self.unknown(name)
        return self.own_object(name)

    def own_object(self, name: str) -> T:
        """The object that `module:attribute` or `file.py[:attribute]` names, checked. Raises as `load`."""
        module, attribute = parts(name)
        if module.endswith(".py"):
            if not (attribute or self.attribute):
                raise self.error(f"{self._called(name)}: say which {self.own} of the file: '{module}:NAME'.")
            found = self._from_file(module, attribute or self.attribute, name)
        elif attribute:
            found = self._from_module(module, attribute, name)
        else:
            raise self.unknown(name)
        return found if self.check is None else self.check(found, name)

    def _called(self, name):
        return f"{self.what[0].upper()}{self.what[1:]} {shown_path(name)}"

    @contextlib.contextmanager
    def running(self, name: str, doing: str) -> Iterator[None]:
        """Runs code of the user's own `name`. An error there becomes `failed`, with one line: the error, its file
        and its line number."""
        try:
            yield
        except (Exception, SystemExit) as error:
            raise self.failed(f"{self._called(name)}: {doing} {raised(error)}.") from error

    def _from_module(self, module: str, attribute: str, name: str) -> Any:
        if not all(part.isidentifier() for part in module.split(".")):
            raise self.error(f"{self._called(name)}: {shown(module)} is no module's name. {self.help}")
        if os.getcwd() not in sys.path:  # sys.path of a console script lacks the current folder
            sys.path.insert(0, os.getcwd())
        try:
            with self.running(name, f"importing '{module}'"):
                loaded = importlib.import_module(module)
        except self.failed as error:
            cause = error.__cause__
            if isinstance(cause, ModuleNotFoundError) and cause.name and module.startswith(cause.name):  # missing
                raise self.error(f"{self._called(name)}: can't import '{module}' ({cause}). {self.help}") from None
            raise
        return self._attribute(loaded, attribute, name)

    def _from_file(self, path: str, attribute: str, name: str) -> Any:
        if not pathlib.Path(path).is_file():
            raise self.error(f"{self._called(name)}: there is no file {shown(path)}. {self.help}")
        spec = importlib.util.spec_from_file_location(own_module(path), path)
        assert spec is not None and spec.loader is not None  # true of a file that ends in .py
        module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
        folder = str(pathlib.Path(path).resolve().parent)
        if folder not in sys.path:  # for modules beside the file
            sys.path.insert(0, folder)
        with self.running(name, f"running '{path}'"):
            spec.loader.exec_module(module)
        return self._attribute(module, attribute, name)

    def _attribute(self, module: types.ModuleType, attribute: str, name: str) -> Any:
        with self.running(name, f"its '{attribute}'"):
            found = getattr(module, attribute, _MISSING)
        if found is _MISSING:
            there = [n for n, value in vars(module).items() if callable(value) and not n.startswith("_")]
            more = f" and {len(there) - _SHOWN} more" if len(there) > _SHOWN else ""
            told = ", ".join(there[:_SHOWN]) or "no callables"
            raise self.error(f"{self._called(name)}: no '{attribute}' there. There are: {told}{more}.")
        return found


def parts(name: str) -> tuple[str, str]:
    """(module or file, attribute) of `module:attribute` or `file.py[:attribute]`; the attribute is "" where none is
    given."""
    module, colon, attribute = name.rpartition(":")
    return (module, attribute) if colon else (name, "")


def own_module(name: str) -> str:
    """The name in sys.modules of the module that `module:attribute` or `file.py[:attribute]` names, once it is loaded;
    "" for other names."""
    module, _ = parts(name)
    if module.endswith(".py"):
        path = pathlib.Path(module)
        return f"own_{path.stem}_{zlib.crc32(str(path.resolve()).encode()):08x}"  # others may have a file of this name
    return module if ":" in name else ""


def code_file(name: str) -> pathlib.Path | None:
    """The file of the user's own code `name`, once loaded; None for other names, and for compiled code."""
    file = getattr(sys.modules.get(own_module(name)), "__file__", None)
    return pathlib.Path(file) if file else None


def raised(error: BaseException, ours: Sequence[str] = ()) -> str:
    """The error of the user's code and its place: the last line of the traceback outside Python, installed packages and
    the files `ours`."""
    if isinstance(error, SystemExit):
        what = f"called exit({'' if error.code is None else shown(error.code)})"
    else:
        text = " ".join(str(error).split())
        what = f"raised {type(error).__name__}{text and ': '}{text[:500]}"
    if isinstance(error, SyntaxError) and error.filename:
        return f"{what} in {error.filename}, line {error.lineno}"
    skipped = {__file__, *ours}
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith("<frozen")]
    theirs = [frame for frame in frames if frame.filename not in skipped and "site-packages" not in frame.filename]
    theirs = [frame for frame in theirs if not frame.filename.startswith(_LIBRARY)]
    frame = theirs[-1] if theirs else frames[-1] if frames[1:] else None
    return f"{what} in {frame.filename}, line {frame.lineno}" if frame else what
