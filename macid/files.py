"""Results on disk: written to a temporary name and renamed, so that nobody reads half a file; and command-line errors."""

import argparse
import contextlib
import json
import os
import pathlib
import platform
import sys
import tempfile
from importlib import metadata

from macid import start


class UsageError(ValueError):
    """A request that can't be met as it was made; the message says what is valid."""


def output_folder(path):
    """`path` as a writable folder, made if missing. Raises UsageError."""
    folder = pathlib.Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UsageError(f"Can't write to '{folder}': {error.strerror}. Name a folder that you can write to.") from None
    return folder


def write_bytes(path, content):
    """`content` to the file `path`, all or nothing."""
    path = pathlib.Path(path)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as f:
            f.write(content)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def write_json(path, content):
    """`content` as JSON to the file `path`, all or nothing."""
    write_bytes(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def versions(*packages):
    """What results were made with: {name: version} of those `packages` that are installed, Python, and the system."""
    found = {}
    for name in packages:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:  # a checkout on the path
            continue
    return {**found, "python": platform.python_version(), "os": sys.platform}


class HelpFormatter(argparse.ArgumentDefaultsHelpFormatter):
    """Help with the defaults that tell something."""

    def _get_help_string(self, action):
        if action.default in (None, False) or "(default" in (action.help or ""):
            return action.help
        return super()._get_help_string(action)


def one_line(text, most=4000):
    """`text` as one line that every terminal can show, of at most `most` characters."""
    text = "".join(c if c.isprintable() else " " if c.isspace() else ascii(c)[1:-1] for c in text)
    return text if len(text) <= most else f"{text[: most - 3]}..."


def start_mujoco(draws=True):
    """Imports MuJoCo, which chooses OpenGL's backend by MUJOCO_GL then. Raises UsageError. A command that does
    not draw goes on without OpenGL where the choice can't be had, or without MuJoCo where that isn't there."""
    try:
        with start.quiet_children():  # of GLFW
            import mujoco  # noqa: F401

        return
    except Exception as error:  # whatever its choice of OpenGL brings up
        chosen, problem = os.environ.get("MUJOCO_GL", ""), error
    if not draws:
        os.environ["MUJOCO_GL"] = "disable"
        with contextlib.suppress(ImportError):
            import mujoco  # noqa: F401, F811

            for module in [name for name in sys.modules if name.startswith("mujoco.")]:  # those of the failed import
                parent, _, child = module.rpartition(".")
                setattr(sys.modules[parent], child, sys.modules[module])
        os.environ["MUJOCO_GL"] = chosen
        return
    mend = {
        "": "Reinstall it: pip install 'mujoco>=3.17,<4'",
        "egl": "Install EGL (on Debian and Ubuntu: apt-get install libegl1 libgl1-mesa-dri), or unset MUJOCO_GL",
    }.get(chosen.lower().strip(), "Unset it, or use egl")
    raise UsageError(f"MuJoCo can't start with MUJOCO_GL='{chosen}' ({problem}). {mend}.")


def run_command(program, main):
    """Runs `main()`; an error of the user's is one line on stderr and exit code 2, Ctrl-C is exit code 130.

    With BSON_TRACEBACK set in the environment, errors are raised as they are.
    """
    try:
        code = main()
        sys.stdout.flush()  # a full disk is told here
        return code
    except KeyboardInterrupt:
        problem, code = "interrupted", start.INTERRUPTED
    except BrokenPipeError:  # whoever reads has had enough, as `head` does
        _drop_output()
        return 1
    except (ValueError, OSError, FloatingPointError, MemoryError) as error:
        if os.environ.get("BSON_TRACEBACK"):
            raise
        problem, code = f"error: {_told(error)}", 2
        try:
            sys.stdout.flush()
        except OSError:
            _drop_output()
    except BaseException:
        if not start.interrupted():
            raise
        problem, code = "interrupted", start.INTERRUPTED
    if start.interrupted():  # whatever came of it
        problem, code = "interrupted", start.INTERRUPTED
    print(f"{program}: {one_line(problem)}", file=sys.stderr)
    return code


def _told(error):
    """What an error says, in a message."""
    if isinstance(error, MemoryError):
        return f"There is not enough memory for this ({error}): ask for fewer worlds, people or episodes at once."
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror}: '{error.filename}'." if error.filename else f"{error.strerror}."
    return str(error)


def _drop_output():
    """Sends what stdout still holds to nowhere, as it can't be written."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):  # it is no file
        pass
