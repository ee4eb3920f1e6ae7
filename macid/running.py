"""The run of a command: MuJoCo's start, streams that never stop the work, errors in one line, and exit codes."""

import contextlib
import os
import sys
from collections.abc import Callable

from macid import start
from macid.files import UsageError, named, one_line, reason_of


def start_mujoco(draws: bool = True) -> None:
    """Imports MuJoCo, which chooses OpenGL's backend by MUJOCO_GL at that moment. Raises UsageError. A command that
    does not draw goes on without OpenGL where this backend can't be had, or without MuJoCo where it isn't installed."""
    try:
        with start.quiet_children():  # of GLFW
            import mujoco

        return
    except Exception as error:  # whatever its choice of OpenGL brings up
        chosen, problem = os.environ.get("MUJOCO_GL", ""), error
    if not draws:
        os.environ["MUJOCO_GL"] = "disable"
        with contextlib.suppress(ImportError):
            import mujoco  # noqa: F401

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


def run_command(program: str, main: Callable[[], int]) -> int:
    """Runs `main()`; an error of the user's is one line on stderr and exit code 2, Ctrl-C is exit code 130.

    Results are written even where nothing can be printed; the exit code is then 2, or 1 without a word where nobody
    reads any more, as after `head`. With BSON_TRACEBACK set in the environment, errors are raised as they are.
    """
    output, errors, ended = _Stream(sys.stdout), _Stream(sys.stderr), None
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
        try:
            code = _answer(program, main)
        except SystemExit as end:  # of the parser, after its help
            ended, code = end, int(bool(end.code))
        output.flush()
        errors.flush()
        if not code and output.problem:
            if isinstance(output.problem, BrokenPipeError):
                return 1
            print(f"{program}: error: Can't print: {reason_of(output.problem)}.", file=errors)
            return 2
    if ended:
        raise ended
    return code


def _answer(program, main):
    """`main()`'s exit code; where it raises an error, this is told, and the code is the error's."""
    try:
        return main()
    except KeyboardInterrupt:
        problem, code = "interrupted", start.INTERRUPTED
    except (ValueError, OSError, FloatingPointError, MemoryError) as error:
        if os.environ.get("BSON_TRACEBACK"):
            raise
        problem, code = f"error: {_told(error)}", 2
    except BaseException:
        if not start.interrupted():
            raise
        problem, code = "interrupted", start.INTERRUPTED
    if start.interrupted():  # whatever came of it
        problem, code = "interrupted", start.INTERRUPTED
    print(f"{program}: {one_line(problem)}", file=sys.stderr)
    return code


def _told(error):
    """An error in words for a user."""
    if isinstance(error, MemoryError):
        return f"There is not enough memory for this ({error}): ask for fewer worlds, people or episodes at once."
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror}: {named(error.filename)}." if error.filename else f"{error.strerror}."
    return str(error)


class _Stream:
    """A standard stream that never stops the work. Once it can't be written (a full disk, a pipe that nobody reads),
    all that follows is dropped. Characters that its encoding lacks are escaped.

    problem: the first OSError.
    """

    def __init__(self, stream):
        # None: it was closed before Python began. The file stays open as long as the process.
        self._stream = open(os.devnull, "w") if stream is None else stream  # noqa: SIM115
        self.problem = None

    def __getattr__(self, name):
        return getattr(self._stream, name)

    def write(self, text):
        try:
            return self._stream.write(text)
        except UnicodeEncodeError:
            encoding = self._stream.encoding
            return self.write(text.encode(encoding, "backslashreplace").decode(encoding))
        except OSError as error:
            self._drop(error)
            return len(text)

    def flush(self):
        try:
            self._stream.flush()
        except OSError as error:
            self._drop(error)

    def _drop(self, error):
        """Sends what the stream still holds and what will come to nowhere."""
        self.problem = self.problem or error
        with contextlib.suppress(OSError, ValueError):  # it is no file
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)
