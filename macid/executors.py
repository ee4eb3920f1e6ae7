"""Where work is done: in this process (`Local`), or by workers on the machines of a Ray cluster (macid.cluster).

Work is a function `work(job, send)` of a module. It calls `send(piece)` whenever a piece of its result is ready; it
returns nothing else. An executor runs it for several jobs, and hands each piece to `receive(index, piece)`, in this
process.

A job is a function that gives the work still to do, judged by the pieces that `receive` got, or None where nothing is
left. It is called when the job begins, and again when a worker was lost with it. So a lost worker costs only the work
that it had not sent.
"""

import dataclasses
import functools
import pathlib
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

from macid.files import UsageError, named

EXECUTORS = ("local", "ray")
MOST_WORKERS = 100_000
_MOST_BYTES = 1 << 26  # of the files that travel to a worker beside the jobs
_OURS = ("macid", "bson")  # packages installed on every machine

Work = Callable[[Any, Callable[[Any], None]], None]
Job = Callable[[], Any]


class Executor(Protocol):
    """Runs jobs; a `with` closes it."""

    workers: int | None  #: how many jobs run at once; None in this process, where they run one after the other

    def __enter__(self) -> "Executor": ...

    def __exit__(self, *error: Any) -> None: ...

    def run(self, work: Work, jobs: Sequence[Job], receive: Callable[[int, Any], None], carried: "Carried") -> None:
        """Runs `work` for every job, in any order, and calls receive(index, piece) with each piece as it comes.

        carried: what the jobs need of this machine. Raises the errors of `work`, and UsageError where a worker can't do
        the work.
        """
        ...


class Local:
    """Runs one job after the other in this process."""

    workers: int | None = None

    def __enter__(self) -> "Local":
        return self

    def __exit__(self, *error: Any) -> None:
        pass

    def run(self, work: Work, jobs: Sequence[Job], receive: Callable[[int, Any], None], carried: "Carried") -> None:
        """See Executor.run; the files of `carried` are here already."""
        for index, job in enumerate(jobs):
            if (left := job()) is not None:
                work(left, functools.partial(receive, index))


def call(job: tuple[Callable[..., Any], dict[str, Any]], send: Callable[[Any], None]) -> None:
    """The work of a job that is a module's function and its arguments by name: sends what it returns."""
    function, arguments = job
    send(function(**arguments))


def make_executor(name: str | Executor = "local", address: str | None = None, workers: int | None = None) -> Executor:
    """The executor `name` of EXECUTORS, or the Executor itself.

    address: of the Ray cluster, HOST:PORT, or "auto" for this machine's cluster (default: the environment variable
    RAY_ADDRESS, or else a cluster of this machine alone, which ends with the executor). workers: number of jobs at once
    (default: the cluster's cores). Raises UsageError, before anything is begun, where Ray is not installed or nobody
    answers.
    """
    if not isinstance(name, str):
        return name
    if name not in EXECUTORS:
        raise UsageError(f"Unknown executor '{name}'. Choose {' or '.join(EXECUTORS)}.")
    if name == "ray":
        from macid.cluster import Cluster

        return Cluster(address, workers)
    for flag, value in (("--ray-address", address), ("--workers", workers)):
        if value is not None:
            raise UsageError(f"{flag} is for --executor ray: leave it out, or add that.")
    return Local()


@dataclasses.dataclass(frozen=True)
class Carried:
    """Files of this machine that jobs need, and that travel with them.

    files: their absolute paths; a worker has them in a folder of its own, and works in that folder's copy of the
    current folder, so that relative names lead to them. paths: those of their folders in which modules are looked for.
    """

    files: tuple[str, ...] = ()
    paths: tuple[str, ...] = ()

    def __add__(self, other: "Carried") -> "Carried":
        return Carried(tuple(dict.fromkeys(self.files + other.files)), tuple(dict.fromkeys(self.paths + other.paths)))

    def read(self) -> dict[str, bytes]:
        """{absolute path: content}. Raises UsageError where that is more than 64 MiB."""
        if (size := sum(pathlib.Path(file).stat().st_size for file in self.files)) > _MOST_BYTES:
            most = max(self.files, key=lambda file: pathlib.Path(file).stat().st_size)
            raise UsageError(
                f"{len(self.files)} files with {size >> 20:,} MiB would travel to every worker, but at most "
                f"{_MOST_BYTES >> 20} MiB can: {named(most)} is the largest."
            )
        return {file: pathlib.Path(file).read_bytes() for file in self.files}

    def told(self) -> str:
        """The files that travel, in a line; "" without any."""
        shown = [pathlib.Path(file).name for file in self.files]
        more = f" and {len(shown) - 10} more" if len(shown) > 10 else ""
        return f"to the workers go: {', '.join(shown[:10])}{more}" if shown else ""


def carry_files(files: Iterable[str | pathlib.Path]) -> Carried:
    """A Carried of those `files` that exist."""
    return Carried(tuple(str(path.absolute()) for path in map(pathlib.Path, files) if path.is_file()))


def carry_module(name: str, extra: Iterable[str | pathlib.Path] = (), top: str | pathlib.Path | None = None) -> Carried:
    """The loaded module `name` with the modules beside it that are loaded by now, as it imported them. An installed
    module does not travel: it has to be installed on every machine.

    extra: further files, named from its folder. top: the folder below which modules count as beside it (default: the
    folder in which the module, or its package, is found).
    """
    file = getattr(sys.modules.get(name), "__file__", None)
    if not file or name.partition(".")[0] in _OURS or _installed(file):
        return Carried()
    here = pathlib.Path(file).absolute().parent
    levels = name.count(".") + (pathlib.Path(file).name == "__init__.py")
    top = [here, *here.parents][levels] if top is None else pathlib.Path(top).absolute()
    found = [file]
    for other, module in list(sys.modules.items()):
        path = getattr(module, "__file__", None)
        if path and other.partition(".")[0] not in _OURS and not _installed(path):
            path = pathlib.Path(path).absolute()
            if path.suffix in (".py", ".so") and path.is_relative_to(top):
                found.append(path)
    lacking = [str(each) for each in extra if not (here / each).is_file()]
    if lacking:
        raise UsageError(f"There is no file {named(lacking[0])} beside {named(file)}, which names it in `files`.")
    found += [here / each for each in extra]
    return Carried(carry_files(found).files, (str(top),))


def _installed(file):
    """Whether a module's file belongs to Python or to an installed package."""
    import sysconfig

    parts = pathlib.Path(file).parts
    return "site-packages" in parts or "dist-packages" in parts or str(file).startswith(sysconfig.get_path("stdlib"))
