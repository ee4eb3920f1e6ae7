"""Results on disk: written to a temporary name and renamed, so that nobody reads half a file; and command-line errors."""

import argparse
import json
import os
import pathlib
import platform
import sys
import tempfile
from importlib import metadata


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


def run_command(program, main):
    """Runs `main()`; an error of the user's is one line on stderr and exit code 2, Ctrl-C is exit code 130.

    With BSON_TRACEBACK set in the environment, errors are raised as they are.
    """
    try:
        import mujoco  # noqa: F401
    except Exception as error:  # whatever its choice of GL brings up
        chosen = os.environ.get("MUJOCO_GL", "")
        print(
            f"{program}: error: MuJoCo can't start with MUJOCO_GL='{chosen}' ({error}). Unset it, or use egl.",
            file=sys.stderr,
        )
        return 2
    try:
        return main()
    except (ValueError, FileNotFoundError, FloatingPointError) as error:
        if os.environ.get("BSON_TRACEBACK"):
            raise
        print(f"{program}: error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # whoever reads has had enough, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        return 130
