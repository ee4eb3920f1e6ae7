"""Results on disk, and the errors of those who ask for them.

Where results are to go is checked before the work begins. They are written to a temporary name and renamed, so that
nobody reads half a file. A run has its folder for itself.
"""

import contextlib
import errno
import fcntl
import json
import os
import pathlib
import platform
import re
import secrets
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from importlib import metadata
from typing import Any

from macid import start

_STEM = 100  # characters of a file's name that its temporary file has, too
_LEFTOVER = re.compile(r"\.(?P<stem>.*)\.[a-z0-9_]{8}(\.webm)?", re.DOTALL)
_ENDINGS = (".json", ".html", ".npz", ".npy", ".pkl", ".csv", ".webm", ".png", ".md")  # of what is written here


class UsageError(ValueError):
    """A request can't be met as it was made; the message says what is valid."""


class WriteError(UsageError, OSError):
    """A file or a folder can't be written: the disk is full, or the folder is gone. The message names it."""


def named(path: Any) -> str:
    """`path` as a message has it: in quotes, without its middle where it is long."""
    text = os.fsdecode(path)
    return f"'{text}'" if len(text) <= 200 else f"'{text[:100]}...{text[-90:]}'"


def reason_of(error: Any) -> str:
    """What an error says, of an OSError without its number and path."""
    return error.strerror or str(error) if isinstance(error, OSError) else str(error)


def _mode(path):
    """The kind and the permissions of what `path` leads to, as `os.stat` has them; None where nothing is there."""
    try:
        return os.stat(path).st_mode
    except FileNotFoundError:
        return None


def _check_names(names, folder):
    """Raises OSError where one of `names` is longer than the file system of `folder` allows, or is no name."""
    most = os.pathconf(folder, "PC_NAME_MAX")
    for name in names:
        if len(os.fsencode(name)) > most:
            raise OSError(errno.ENAMETOOLONG, f"a name in it has more than {most} bytes")


def check_folder(path: str | os.PathLike[str]) -> pathlib.Path:
    """`path` as a Path, if it is a folder that can be written to or could be made. Makes nothing. Raises UsageError."""
    folder = there = pathlib.Path(path)
    new = []  # names of folders that are to be made
    try:
        while (mode := _mode(there)) is None:
            if there.is_symlink():
                raise OSError(errno.ENOENT, f"the link {named(there)} leads nowhere")
            new.append(there.name)
            there = there.parent
        if not stat.S_ISDIR(mode):
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
        _check_names(new, there)
        with tempfile.TemporaryFile(dir=there):
            pass
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        raise UsageError(
            f"Can't write to {named(folder)}: {reason_of(error)}. Name a folder that you can write to."
        ) from None
    return folder


def output_folder(path: str | os.PathLike[str]) -> pathlib.Path:
    """`path` as a writable folder, made if missing. Raises UsageError."""
    folder = check_folder(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(
            f"Can't make the folder {named(folder)}: {reason_of(error)}. Name a folder that you can write to."
        ) from None
    return folder


def _target(path):
    """The file that writing `path` makes or replaces, links followed, and its permissions, None where it is new.

    Raises OSError where this file is not regular or is protected.
    """
    target = pathlib.Path(os.path.realpath(path))
    if (mode := _mode(path)) is None:
        return target, None
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "it is a folder")
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "it is no regular file")
    if not os.access(target, os.W_OK):
        raise PermissionError(errno.EACCES, "it is protected from writing")
    return target, stat.S_IMODE(mode) & 0o777


def check_file(path: str | os.PathLike[str], what: str = "file") -> pathlib.Path:
    """`path` as a Path, if it is a regular file that can be replaced, or one that could be made, with its folder.

    what: how messages call it. Links are followed. Makes nothing. Raises UsageError.
    """
    path = pathlib.Path(path)
    try:
        if path.name:
            check_folder(path.parent)
        target, mode = _target(path)
        if mode is None and path.is_symlink() and not target.parent.is_dir():
            raise OSError(errno.ENOENT, "it is a link that leads nowhere")
        check_folder(target.parent)
        _check_names([target.name], next(each for each in target.parents if each.is_dir()))
    except UsageError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        article = "a" if isinstance(error, IsADirectoryError) else "another"
        raise UsageError(f"Can't write {named(path)}: {reason_of(error)}. Name {article} {what}.") from None
    return path


def _lock(handle):
    """Whether an open file or folder could be locked for this process: None where there are no locks.

    The lock goes with the last of the open handle's copies, at the latest with the process, however that ends.
    """
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # such as a network folder without locks
        return None
    return True


def _stem(name):
    """The beginning, in ASCII, of the names of temporary files for the file `name`."""
    return name.encode("ascii", "ignore").decode()[-_STEM:]


def _temporary(target, ending):
    """A new empty file beside `target`: its handle, locked, and its path."""
    start.cleaning_up()
    while True:
        temporary = target.parent / f".{_stem(target.name)}.{secrets.token_hex(4)}{ending}"
        try:
            handle = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)  # the umask holds
        except FileExistsError:
            continue
        if _lock(handle) is not False and os.fstat(handle).st_nlink:  # not swept away before it was locked
            return handle, temporary
        os.close(handle)


def remove_leftovers(folder: str | os.PathLike[str], name: str | None = None) -> None:
    """Removes the temporary files that killed runs left in `folder`, if it exists; with `name`, only this file's.

    A run that still goes on has locked its temporary files: they stay.
    """
    try:
        entries = os.listdir(folder)
    except OSError:  # not there, or not to be read: nothing that could be removed
        return
    for entry in entries:
        match = _LEFTOVER.fullmatch(entry)
        if not match or not (match["stem"].endswith(_ENDINGS) if name is None else match["stem"] == _stem(name)):
            continue
        path = pathlib.Path(folder, entry)
        with contextlib.suppress(OSError):
            handle = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                if stat.S_ISREG(os.fstat(handle).st_mode) and _lock(handle):
                    path.unlink()
            finally:
                os.close(handle)


@contextlib.contextmanager
def new_file(path: str | os.PathLike[str], ending: str = "") -> Iterator[tuple[Any, pathlib.Path]]:
    """A file to be filled in a `with`, by its handle or its path. It then becomes `path`, or is removed where that
    fails.

    ending: the ending of its temporary name. A file that is replaced keeps its permissions, a link stays and its file
    is replaced. Raises WriteError, which names `path`.
    """
    path = pathlib.Path(path)
    try:
        target, mode = _target(path)
        remove_leftovers(target.parent, target.name)
        handle, temporary = _temporary(target, ending)
        try:
            if mode is not None:
                os.chmod(temporary, mode)
            yield handle, temporary
            os.replace(temporary, target)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
            raise
        finally:
            os.close(handle)
    except WriteError:
        raise
    except OSError as error:
        gone = not os.path.isdir(os.path.dirname(os.path.realpath(path)))
        reason = f"there is no folder {named(path.parent)}" if gone else reason_of(error)
        told = WriteError(f"Can't write {named(path)}: {reason}.")
        told.errno = error.errno
        raise told from None


def write_bytes(path: str | os.PathLike[str], content: bytes) -> None:
    """Writes `content` to the file `path`, all or nothing. Raises WriteError."""
    with new_file(path) as (handle, _), open(handle, "wb", closefd=False) as f:
        f.write(content)


def write_json(path: str | os.PathLike[str], content: Any) -> None:
    """Writes `content` as JSON to the file `path`, all or nothing. Raises WriteError."""
    write_bytes(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


@contextlib.contextmanager
def new_folder(path: str | os.PathLike[str]) -> Iterator[pathlib.Path]:
    """`path` as a writable folder, made if missing. Where the work in the `with` fails and leaves it empty, it is
    removed.

    Raises UsageError.
    """
    folder = check_folder(path)
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    start.cleaning_up()
    try:
        yield output_folder(folder)
    except BaseException:
        with contextlib.suppress(OSError):  # not empty, or not made
            for each in made:
                each.rmdir()
        raise


@contextlib.contextmanager
def lock_folder(
    path: str | os.PathLike[str], files: Iterable[str] = (), alone: Iterable[str] = ()
) -> Iterator[pathlib.Path]:
    """`path` as a writable folder, made if missing, that this run has for itself in a `with`.

    files: the names of the files that will be written there, which are checked. Half-written files of killed runs are
    removed. Where the work fails and leaves nothing, or only new files of the names `alone`, such as a configuration,
    these and the folder are removed. A process that was killed locks nothing. Raises UsageError where another run has
    the folder or it can't be written.
    """
    for name in files:
        check_file(pathlib.Path(path) / name)
    with new_folder(path) as folder:
        handle = os.open(folder, os.O_RDONLY)
        try:
            if _lock(handle) is False:
                raise UsageError(
                    f"Another run is at work in {named(folder)}. Wait until it ends, or use another folder."
                )
            remove_leftovers(folder)
            before = set(os.listdir(folder))
            try:
                yield folder
            except BaseException:
                with contextlib.suppress(OSError):
                    if (new := set(os.listdir(folder)) - before) <= set(alone):
                        for name in new:
                            (folder / name).unlink()
                raise
        finally:
            os.close(handle)


@contextlib.contextmanager
def whole_folder(path: str | os.PathLike[str]) -> Iterator[pathlib.Path]:
    """A folder to be filled in a `with`, that then becomes `path`, or goes where that fails: nobody sees half of it.

    Raises UsageError where there are files in `path` already, or it can't be written.
    """
    folder = check_folder(path)
    if folder.is_dir() and os.listdir(folder):
        raise UsageError(f"There are files in {named(folder)} already. Name a new folder, or an empty one.")
    target = pathlib.Path(os.path.realpath(folder))
    with new_folder(target.parent):
        remove_leftover_folders(target.parent, lambda path, name: name == _stem(target.name))
        temporary = target.parent / f".{_stem(target.name)}.{secrets.token_hex(4)}"
        os.mkdir(temporary)
        handle = os.open(temporary, os.O_RDONLY)
        try:
            _lock(handle)
            yield temporary
            os.replace(temporary, target)
        except UsageError:
            raise
        except OSError as error:
            raise UsageError(f"Can't write {named(folder)}: {reason_of(error)}. Name a new folder.") from None
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
            os.close(handle)


def remove_leftover_folders(folder: str | os.PathLike[str], ours: Callable[[pathlib.Path, str], bool]) -> None:
    """Removes what killed runs of `whole_folder` left half-filled in `folder`, where `ours(path, name)` says so of such
    a temporary folder `path`, which was to become `name` (a long name's beginning). A run that still goes on has locked
    its folder: it stays."""
    for entry in os.listdir(folder):
        match = _LEFTOVER.fullmatch(entry)
        if match and ours(pathlib.Path(folder, entry), match["stem"]):
            _remove_unlocked(pathlib.Path(folder, entry))


def _remove_unlocked(folder):
    """Removes `folder`, if it is one and no process has it locked."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY | os.O_NOFOLLOW | os.O_DIRECTORY)
        try:
            if _lock(handle):
                shutil.rmtree(folder)
        finally:
            os.close(handle)


def versions(*packages: str) -> dict[str, str]:
    """What results were made with: {name: version} of the `packages` that are installed, of Python, and the system."""
    found = {}
    for name in packages:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:  # a checkout on the path
            continue
    return {**found, "python": platform.python_version(), "os": sys.platform}


def one_line(text: str, most: int = 4000) -> str:
    """`text` as one line that every terminal can show, of at most `most` characters."""
    text = "".join(c if c.isprintable() else " " if c.isspace() else ascii(c)[1:-1] for c in text)
    return text if len(text) <= most else f"{text[: most - 3]}..."
