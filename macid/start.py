"""How the commands begin and end as processes: Ctrl-C from the first moment on, and another package in the place of
`bson`.

The console scripts begin here. This file imports only modules that Python has loaded anyhow, or small ones, so that
Ctrl-C is heard before anything that takes long or fails.
"""

import os
import signal
import sys

TYPE_CHECKING = False  # as typing has it, which takes long to load
if TYPE_CHECKING:
    from collections.abc import Callable

INTERRUPTED = 130  # exit code after Ctrl-C
_ANSWER = 1.0  # Python may be busy so long in compiled code, as while XLA compiles, before Ctrl-C ends the process [s]
_CLEANING = 15.0  # interrupted work has so long to close files and to remove what is half written [s]
_PACKAGE = "bson-macid"
CURE = (
    f"Give {_PACKAGE} an environment of its own, without pymongo and bson: python -m venv NEW, then "
    f"NEW/bin/pip install {_PACKAGE}. In this one: uninstall the other package, then "
    f"pip install --force-reinstall --no-deps {_PACKAGE} (in a checkout: -e . instead of the name)"
)


class _Interrupts:
    """What Ctrl-C does to a command.

    As long as nothing is begun, it ends the process at once. From `cleaning_up` on, it raises KeyboardInterrupt, so
    that half-written files are removed. Within `deferred` it waits for a place to save. A second Ctrl-C ends the
    process.
    """

    worth: "Callable[[], bool] | None"

    def __init__(self, program):
        self.program, self.came, self.raised, self.raises, self.worth = program, 0, False, False, None

    def handle(self, signum, frame):
        """The signal's handler, in the main thread."""
        if not self.raises or self.raised:
            _flush(sys.stdout)
            self.leave()
        self.raised = True
        raise KeyboardInterrupt

    def leave(self):
        """Ends the process at once: an ordinary end with other threads at work can crash."""
        _end_children()
        os.write(2, f"{chr(10) if self.raises else ''}{self.program}: interrupted\n".encode())
        os._exit(INTERRUPTED)

    def watch(self, pipe):
        """Waits, in a thread, for signals that the main thread does not see or does not obey."""
        from time import sleep

        while signals := os.read(pipe, 64):
            self.came += signals.count(int(signal.SIGINT))
            if self.came > 1 or (self.came == 1 and not self.waits()):
                sleep(_ANSWER)
                if self.raised:
                    sleep(_CLEANING)
                self.leave()
        os.close(pipe)

    def waits(self):
        """Whether something will save and stop by itself."""
        return self.worth is not None and self.worth()


_interrupts = None  # of this process's command


def run(program: str, main: "Callable[[], int]") -> int:
    """The exit code of `main()`, the command `program` of this process; Ctrl-C is one line and exit code 130
    throughout.

    Does not return after Ctrl-C: threads of MuJoCo and XLA may be at work, and an ordinary end would wait for them or
    crash.
    """
    global _interrupts
    _open_standard_handles()
    ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN  # as of a job in the background
    if _interrupts is not None or ignored:
        return main()
    interrupts = _Interrupts(program)
    try:
        handler = signal.signal(signal.SIGINT, interrupts.handle)
    except ValueError:  # not the main thread, which alone is interrupted
        return main()
    _interrupts = interrupts
    from threading import Thread

    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    Thread(target=interrupts.watch, args=(reading,), daemon=True, name="Ctrl-C").start()
    wakeup = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    unraisable, sys.unraisablehook = sys.unraisablehook, _unraisable
    try:
        code = main()
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        code = INTERRUPTED
    finally:
        signal.signal(signal.SIGINT, handler)
        signal.set_wakeup_fd(wakeup)
        sys.unraisablehook = unraisable
        _interrupts = None
    if interrupts.raised or code == INTERRUPTED:
        _flush(sys.stdout)
        _flush(sys.stderr)
        os._exit(INTERRUPTED)
    os.close(writing)
    return code


def _open_standard_handles():
    """Leads closed standard streams (`2>&-`) to nowhere, so that no file gets their numbers."""
    for handle in range(3):
        try:
            os.fstat(handle)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number, which is this


def _end_children():
    """Ends processes that this one waits for (GLFW asks one for its version): they would complain that their pipe
    broke."""
    try:
        for thread in os.listdir("/proc/self/task"):
            with open(f"/proc/self/task/{thread}/children") as children:
                for child in children.read().split():
                    os.kill(int(child), signal.SIGKILL)
    except OSError:  # not on Linux, or over already
        pass


class quiet_children:
    """A context in which processes that are begun do not hear Ctrl-C, which a terminal sends to all; this one does."""

    def __enter__(self):
        self._before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])

    def __exit__(self, *error):
        signal.pthread_sigmask(signal.SIG_SETMASK, self._before)


def _flush(stream):
    try:
        stream.flush()
    except Exception:  # in whatever state it is, it is left
        return


def _unraisable(what):
    """Prints nothing about a KeyboardInterrupt that Python could not raise where it came, as in a weak reference's
    callback: `_Interrupts.watch` ends the process."""
    if not issubclass(what.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(what)


def interrupted() -> bool:
    """Whether Ctrl-C was raised in this command. An error that follows is its consequence."""
    return _interrupts is not None and _interrupts.raised


def cleaning_up() -> None:
    """From now on, Ctrl-C is raised as KeyboardInterrupt, as there are files to close and to remove."""
    if _interrupts is not None:
        _interrupts.raises = True


class deferred:
    """A context in which Ctrl-C waits until the work can be saved, as long as `worth()` says that there is work to
    save.

    It gives a function that tells whether Ctrl-C came: the work is then to be saved, and KeyboardInterrupt to be
    raised. A second Ctrl-C ends the process as ever. In another thread than the main one nothing is deferred.
    """

    def __init__(self, worth: "Callable[[], bool]" = lambda: True):
        self._worth, self._came = worth, False

    def __enter__(self):
        self._before = signal.getsignal(signal.SIGINT)
        try:
            if callable(self._before):
                signal.signal(signal.SIGINT, self._note)
        except ValueError:  # not the main thread
            self._before = None
        if _interrupts is not None:
            _interrupts.worth = self._worth
        return lambda: self._came

    def __exit__(self, *error):
        if _interrupts is not None:
            _interrupts.worth = None
        if callable(self._before):
            signal.signal(signal.SIGINT, self._before)

    def _note(self, signum, frame):
        if (self._came or not self._worth()) and callable(self._before):
            self._before(signum, frame)
        self._came = True


def others() -> list[str]:
    """Names of other installed packages that bring a `bson` of their own, as pymongo does."""
    from importlib import metadata

    found = set()
    for package in metadata.distributions():
        name = package.metadata["Name"]
        if name and name.lower() != _PACKAGE and "\nbson/__init__.py," in f"\n{package.read_text('RECORD') or ''}":
            found.add(name)
    return sorted(found)


def shadowed() -> str | None:
    """What is wrong with the package `bson`, in a sentence; None where it is ours. The package is not imported."""
    from importlib.util import find_spec
    from pathlib import Path

    ours = Path(__file__).resolve().parent.parent / "bson" / "__init__.py"
    try:
        spec = find_spec("bson")
    except ValueError:  # something without a place has that name
        spec = None
    origin = spec and spec.origin
    if not origin and not ours.exists():
        whose = " and ".join(others())
        return (
            f"'{ours}' is missing: {whose + ' has' if whose else 'another package of the name bson, as pymongo, had'} "
            "that file too, and took it along when it was uninstalled or replaced"
        )
    if not origin or not os.path.isfile(origin):
        return f"Python finds no package bson, though '{ours.parent}' is there"
    if b"ENVIRONMENTS" in Path(origin).read_bytes():
        return None
    whose = " and ".join(others()) or "another package, as pymongo"
    if os.path.realpath(origin) == str(ours):
        return f"'{origin}' is not {_PACKAGE}'s any more: {whose} also has a package bson, and overwrote it"
    return f"bson is '{origin}', of {whose}, which stands before {_PACKAGE}'s in '{ours.parent}'"


def bson() -> int:
    """The console script `bson`."""
    return _whole(run("bson", bson_command))


def bson_command() -> int:
    """Runs the command `bson` with this process's words, where `bson` is ours; otherwise says what to do. Returns the
    exit code."""
    from importlib import import_module, util
    from pathlib import Path

    problem = shadowed()
    if problem is None:
        return import_module("bson.cli").main(sys.argv[1:])
    file = Path(__file__).resolve().parent.parent / "bson" / "doctor.py"
    if sys.argv[1:] != ["doctor"] or not file.exists():
        print(f"bson: error: {problem}. {CURE}.", file=sys.stderr)
        return 2
    spec = util.spec_from_file_location("_bson_doctor", file)
    assert spec is not None and spec.loader is not None  # of a file that ends in .py
    doctor = util.module_from_spec(spec)
    spec.loader.exec_module(doctor)
    return doctor.command()


def macid() -> int:
    """The console script `macid`."""
    return _whole(run("macid", macid_command))


def macid_command() -> int:
    """Runs the command `macid` with this process's words; returns the exit code."""
    from macid.cli import main

    return main(sys.argv[1:])


def _whole(code):
    """The exit code of a command whose work is done: Ctrl-C changes nothing any more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    return code
