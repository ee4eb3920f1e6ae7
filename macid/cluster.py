"""Jobs on the machines of a Ray cluster (extra `ray`): the executor `ray`, and the code that runs in its workers.

A job is one task on one core. The pieces that it sends come back at once, as bytes. A killed worker loses only the work
that it had not sent yet: the job is begun anew with the rest. Workers get the environment variables on which results
depend, and refuse to work with another version of this project, MuJoCo, JAX or NumPy.
"""

import collections
import contextlib
import dataclasses
import functools
import hashlib
import os
import pathlib
import pickle
import queue
import secrets
import shutil
import socket
import sys
import tempfile
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from macid import assets, start
from macid.executors import Carried, Job, Work
from macid.files import UsageError, one_line, versions
from macid.running import start_mujoco
from macid.threads import VARIABLE

INSTALL = "pip install 'bson-macid[ray]'"
# Ray's environment: it sends no usage statistics; its workers have this process's priority, not a lower one; this
# module, not Ray on standard output, reports a lost worker.
_RAY = {
    "RAY_DEDUP_LOGS_SKIP_REGEX": "worker died or was killed",
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_worker_niceness": "0",
}
_ANSWER = 3.0  # time in which a cluster's address has to answer [s]
_LOSSES = 3  # workers that a job may lose one after the other without a piece sent
_MOST_FOLDER = 30  # characters of a folder for Ray's sockets, whose paths may have 107
_STORE = 1 << 28  # bytes of the object store of a cluster of this machine alone
_SAME = ("mujoco", "mujoco-mjx", "jax", "jaxlib", "numpy")  # packages on whose versions results depend
_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\4\0\0\0\0\0"  # how HTTP/2, and so gRPC, begins (RFC 9113, 3.4)
_SETTINGS = 4  # the kind of the frame that answers it


class Cluster:
    """Runs jobs on a Ray cluster, see macid.executors.Executor: an existing one, or one of this machine alone, which
    ends with the `with`."""

    def __init__(self, address: str | None = None, workers: int | None = None):
        """address, workers: as for macid.executors.make_executor. Raises UsageError where Ray is missing or nobody
        answers."""
        for name, value in _RAY.items():
            os.environ.setdefault(name, value)
        try:
            import ray
        except ImportError as error:
            raise UsageError(f"--executor ray needs {error.name or 'ray'}: {INSTALL}.") from None
        self._ray: Any = ray  # its types don't say that a task may be a generator
        self.address = _checked(address or os.environ.get("RAY_ADDRESS") or "local")
        self.workers = workers
        self._wanted, self._ours, self._folder = workers, False, None

    def __enter__(self) -> "Cluster":
        ray = self._ray
        if not ray.is_initialized():
            start.cleaning_up()
            quiet = {"log_to_driver": False, "logging_level": "ERROR"}
            alone = {}
            if self.address == "local":
                os.environ.setdefault("RAY_AUTH_TOKEN", _token())  # otherwise Ray would write one to the home folder
                short = len(tempfile.gettempdir()) <= _MOST_FOLDER
                self._folder = tempfile.mkdtemp(prefix="macid-ray-", dir=None if short else "/tmp")
                alone = {
                    "num_cpus": self._wanted or os.cpu_count(),
                    "include_dashboard": False,
                    "object_store_memory": _STORE,
                    "_temp_dir": self._folder,
                }
            try:
                with start.quiet_children(), warnings.catch_warnings():
                    warnings.filterwarnings("ignore", r"os\.fork\(\) was called")  # JAX warns when Ray forks
                    ray.init(address=self.address, **alone, **quiet)
            except (ConnectionError, RuntimeError, ValueError, OSError) as error:
                self.__exit__()
                told = " ".join(str(error).split())[:400]
                raise UsageError(
                    f"Can't work on the Ray cluster '{self.address}': {told.rstrip('.')}. This machine has to be one "
                    "of it (ray start --address HOST:PORT), with its token if it has one (RAY_AUTH_MODE=token)."
                ) from None
            except BaseException:
                self.__exit__()
                raise
            self._ours = True
        cores = int(ray.cluster_resources().get("CPU", 0))
        if not cores:
            self.__exit__()
            raise UsageError(f"The Ray cluster '{self.address}' has no core to work with. Start one with --num-cpus.")
        self.workers = self._wanted or cores
        return self

    def __exit__(self, *error: Any) -> None:
        if self._ours or self._folder:
            self._ours = False
            self._ray.shutdown()
        if self._folder:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None

    def run(self, work: Work, jobs: Sequence[Job], receive: Callable[[int, Any], None], carried: Carried) -> None:
        """See macid.executors.Executor.run."""
        ray = self._ray
        assert self.workers is not None  # set in the `with`
        packages = tuple(dict.fromkeys(["macid", work.__module__.partition(".")[0]]))
        bundle = ray.put(_Bundle(carried.read(), carried.paths, os.getcwd(), packages, fingerprint(packages)))
        if told := carried.told():
            print(told, file=sys.stderr, flush=True)
        task, environment = _task(ray), _environment()
        if self._folder:
            environment["TMPDIR"] = self._folder
        waiting, running, lost = collections.deque(range(len(jobs))), {}, collections.Counter()
        try:
            while waiting or running:
                while waiting and len(running) < self.workers:
                    index = waiting.popleft()
                    if (left := jobs[index]()) is not None:
                        call = ray.cloudpickle.dumps((work, left))
                        running[task.remote(environment, bundle, call)] = index
                if not running:
                    continue
                ready, _ = ray.wait(list(running), num_returns=1, timeout=0.5)  # a timeout, so that Ctrl-C is heard
                for pieces in ready:
                    index = running[pieces]
                    try:
                        kind, piece = pickle.loads(ray.get(next(pieces)))
                    except StopIteration:
                        del running[pieces]
                    except ray.exceptions.RayTaskError as error:
                        raise UsageError(f"A worker can't begin: {one_line(str(error.cause), 400)}") from None
                    except ray.exceptions.RayError as error:  # the worker or its machine is gone
                        del running[pieces]
                        lost[index] += 1
                        reason = one_line(str(error).partition("\n")[0], 300)
                        if lost[index] > _LOSSES:
                            raise UsageError(
                                f"{lost[index]} workers were lost one after the other at the same work, and none sent "
                                f"anything: {reason}"
                            ) from None
                        print("a worker was lost; what it had not sent is done anew", file=sys.stderr, flush=True)
                        waiting.append(index)
                    else:
                        if kind == "error":
                            raise piece
                        lost[index] = 0
                        receive(index, piece)
        finally:
            for pieces in running:
                with contextlib.suppress(Exception):
                    ray.cancel(pieces, force=True)


@functools.cache
def _token():
    """The token of this process's own clusters."""
    return secrets.token_hex(32)


def _checked(address):
    """`address`, where a cluster answers there. Raises UsageError within seconds."""
    if address == "local":
        return address
    if address.startswith("ray://"):
        raise UsageError(
            f"--ray-address {address}: Ray's client is not used. Run this on a machine of the cluster, with "
            "--ray-address auto."
        )
    where = _of_this_machine() if address == "auto" else address
    if where is None:
        raise UsageError(
            "--ray-address auto: no Ray cluster runs on this machine. Begin one: ray start --head --port 6379 "
            "--disable-usage-stats."
        )
    host, colon, port = where.rpartition(":")
    if not (colon and host and port.isdecimal() and int(port) < 65536):
        raise UsageError(f"--ray-address must be HOST:PORT or auto, not '{address}'.")
    problem = "another program answers there"
    try:
        with socket.create_connection((host.strip("[]"), int(port)), _ANSWER) as connection:
            connection.settimeout(_ANSWER)
            connection.sendall(_PREFACE)
            if connection.recv(9)[3:4] == bytes([_SETTINGS]):
                return address
    except TimeoutError:
        problem = f"nothing came within {_ANSWER:g} s"
    except (OSError, UnicodeError) as error:
        problem = getattr(error, "strerror", None) or str(error)
    raise UsageError(
        f"No Ray cluster answers at '{where}' ({problem}). Begin one there: ray start --head --port {port} "
        "--disable-usage-stats."
    )


def _of_this_machine():
    """The address of the cluster to which this machine belongs, as `ray start` noted it; None without a note."""
    noted = pathlib.Path(os.environ.get("RAY_TMPDIR", "/tmp"), "ray", "ray_current_cluster")
    try:
        return noted.read_text().strip() or None
    except OSError:
        return None


def _environment():
    """The environment variables that workers need to get this process's results: XLA sums in as many threads as it
    would here (see macid.learning.train.train)."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    kept = {name: os.environ[name] for name in ("MUJOCO_GL", "JAX_PLATFORMS", "XLA_FLAGS") if name in os.environ}
    return {
        "NPROC": os.environ.get("NPROC", str(cores)),
        **dict.fromkeys((VARIABLE, "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"),
        **kept,
    }


@dataclasses.dataclass(frozen=True)
class _Bundle:
    """The data that goes to workers once for all jobs: files by absolute path, folders of modules, the current folder,
    and the fingerprint that workers must have."""

    files: dict[str, bytes]
    paths: tuple[str, ...]
    current: str
    packages: tuple[str, ...]
    fingerprint: dict[str, str]


def _task(ray):
    """The Ray task of a job. It is sent by value, so it begins even in a worker with another version of this project,
    or without it."""

    @ray.remote(max_retries=0, num_cpus=1, num_returns="streaming")
    def work(environment, bundle, call):
        import os
        import pickle
        import socket
        import tempfile

        os.environ.update(environment)
        tempfile.tempdir = None  # so that it follows the new environment
        try:
            from macid.cluster import serve
        except ImportError as error:
            told = f"A worker on {socket.gethostname()} lacks this version of bson-macid ({error})"
            yield pickle.dumps(("error", ValueError(f"{told}: install the same on every machine.")))
            return
        yield from serve(bundle, call)

    return work


@functools.cache
def fingerprint(packages: tuple[str, ...]) -> dict[str, str]:
    """The fingerprint of this installation, on which results depend: versions, and a hash of the code of `packages` and
    of the assets."""
    digest = hashlib.sha256()
    code = pathlib.Path(__file__).parent.parent
    found = [(code, file) for name in packages for file in code.joinpath(name).rglob("*.py")]
    folders = [folder for folder in assets.root().iterdir() if folder.name not in ("readme", "results")]
    found += [(assets.root(), file) for folder in folders for file in folder.rglob("*")]
    for root, file in sorted(found):
        if file.is_file():
            content = file.read_bytes()
            digest.update(f"{file.relative_to(root)} {len(content)}\n".encode() + content)
    made_with = versions(*_SAME)
    return {"bson-macid": digest.hexdigest()[:12], **{name: made_with.get(name, "none") for name in _SAME}}


def _other_version(bundle):
    """The difference between this worker's fingerprint and the bundle's, in a sentence; "" where they are equal."""
    ours, wanted = fingerprint(bundle.packages), bundle.fingerprint
    other = [f"{name} {ours.get(name)}, not {wanted[name]}" for name in wanted if ours.get(name) != wanted[name]]
    if not other:
        return ""
    return (
        f"The worker on {socket.gethostname()} has another version: {', '.join(other)} (of bson-macid: a hash of "
        "code and assets). Install the same on every machine."
    )


def serve(bundle: _Bundle, call: bytes) -> Iterator[bytes]:
    """Runs a job in a worker, in a thread; yields its pieces, each pickled: ("piece", the piece), or ("error", the
    exception)."""
    if problem := _other_version(bundle):
        yield pickle.dumps(("error", UsageError(problem)))
        return
    sent = queue.SimpleQueue()

    def run():
        try:
            start_mujoco()
            with _unpacked(bundle) as root:
                try:
                    work, job = pickle.loads(call)
                    work(moved(job, bundle.files, root), lambda piece: sent.put(pickle.dumps(("piece", piece))))
                except Exception as error:
                    sent.put(_told(error, root))
        except Exception as error:
            sent.put(_told(error, ""))
        finally:
            sent.put(None)

    threading.Thread(target=run, daemon=True).start()
    while (piece := sent.get()) is not None:
        yield piece


@contextlib.contextmanager
def _unpacked(bundle):
    """Puts the bundle's files into a new folder, and works in that folder's copy of the current folder; puts everything
    back after the `with`. Gives the new folder, which goes in front of absolute paths."""
    before, paths = os.getcwd(), list(sys.path)
    with tempfile.TemporaryDirectory(prefix="macid-worker-") as root:
        try:
            for path, content in bundle.files.items():
                there = pathlib.Path(root + path)
                there.parent.mkdir(parents=True, exist_ok=True)
                there.write_bytes(content)
            here = pathlib.Path(root + bundle.current)
            here.mkdir(parents=True, exist_ok=True)
            os.chdir(here)
            sys.path[:0] = [root + path for path in bundle.paths]
            yield root
        finally:
            os.chdir(before)
            sys.path[:] = paths
            for name, module in list(sys.modules.items()):
                if (getattr(module, "__file__", None) or "").startswith(root):
                    del sys.modules[name]


def moved(value: Any, files: Mapping[str, Any], root: str) -> Any:
    """A copy of `value`, of nested dataclasses, dicts, lists and tuples, in which absolute paths of `files` lead below
    `root`."""
    if isinstance(value, str):
        return root + value if value in files or value.rpartition(":")[0] in files else value  # file.py:attribute
    if isinstance(value, dict):
        return {key: moved(each, files, root) for key, each in value.items()}
    if type(value) in (list, tuple):
        return type(value)(moved(each, files, root) for each in value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        old = {field.name: getattr(value, field.name) for field in dataclasses.fields(value) if field.init}
        new = {name: moved(each, files, root) for name, each in old.items()}
        if changed := {name: each for name, each in new.items() if each is not old[name] and _differs(each, old[name])}:
            return dataclasses.replace(value, **changed)
    return value


def _differs(one, other):
    try:
        return bool(one != other)
    except ValueError:  # of arrays, which never hold paths
        return False


def _told(error, root):
    """An exception for the machine that asked: pickled ("error", exception), with that machine's paths in place of this
    worker's."""
    if isinstance(error, (ValueError, OSError, FloatingPointError, MemoryError)):  # shown to users as one line
        error.args = tuple(each.replace(root, "") if root and isinstance(each, str) else each for each in error.args)
        with contextlib.suppress(Exception):
            content = pickle.dumps(("error", error))
            if type(error).__module__.partition(".")[0] in ("builtins", "macid", "bson"):
                pickle.loads(content)
                return content
        return pickle.dumps(("error", UsageError(str(error))))
    lines = "".join(traceback.format_exception(error))
    return pickle.dumps(("error", RuntimeError(f"In a worker on {socket.gethostname()}:\n{lines}")))
