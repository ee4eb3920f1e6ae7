import contextlib
import json
import os
import signal
import stat
import subprocess
import sys

import pytest

from macid.files import (
    UsageError,
    check_file,
    check_folder,
    lock_folder,
    new_file,
    new_folder,
    output_folder,
    remove_leftovers,
    whole_folder,
    write_bytes,
    write_json,
)
from macid.running import run_command


def test_json_comes_back(tmp_path):
    file = tmp_path / "a.json"
    write_json(file, {"a": [1, 2.5, None]})
    assert json.loads(file.read_text()) == {"a": [1, 2.5, None]}
    write_json(str(file), [])
    assert json.loads(file.read_text()) == []
    assert os.listdir(tmp_path) == ["a.json"]


@pytest.mark.parametrize("content", [{"a": float("nan")}, {"a": object()}])
def test_what_json_cannot_hold_keeps_the_old_file(tmp_path, content):
    file = tmp_path / "a.json"
    write_json(file, 1)
    with pytest.raises((TypeError, ValueError)):
        write_json(file, content)
    assert file.read_text() == "1\n"
    assert os.listdir(tmp_path) == ["a.json"]


def test_a_write_that_fails_keeps_the_old_file_and_leaves_nothing(tmp_path, monkeypatch):
    file = tmp_path / "a"
    write_bytes(file, b"old")

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_bytes(file, b"new")
    assert file.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a"]


def permissions(path):
    return stat.S_IMODE(path.stat().st_mode)


@pytest.mark.parametrize("umask", [0o022, 0o077, 0o002])
def test_the_umask_says_who_may_read_a_result_and_a_replaced_file_keeps_its_permissions(tmp_path, umask):
    before = os.umask(umask)
    try:
        write_bytes(tmp_path / "a", b"")
    finally:
        os.umask(before)
    assert permissions(tmp_path / "a") == 0o666 & ~umask
    (tmp_path / "a").chmod(0o640)
    write_bytes(tmp_path / "a", b"new")
    assert permissions(tmp_path / "a") == 0o640 and (tmp_path / "a").read_bytes() == b"new"


def test_a_link_stays_and_its_file_is_written(tmp_path):
    (tmp_path / "far").mkdir()
    (tmp_path / "a").symlink_to("far/b")
    for content in (b"one", b"two"):  # the first time, it leads to nothing
        write_bytes(check_file(tmp_path / "a"), content)
        assert (tmp_path / "a").is_symlink() and (tmp_path / "far" / "b").read_bytes() == content
    assert sorted(os.listdir(tmp_path)) == ["a", "far"] and os.listdir(tmp_path / "far") == ["b"]


@pytest.fixture
def odd(tmp_path):
    """Names of what is no file to be written, in a folder."""
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    (tmp_path / "nowhere").symlink_to("none/at/all")
    (tmp_path / "circle").symlink_to("circle")
    (tmp_path / "to-fifo").symlink_to("fifo")
    return tmp_path


@pytest.mark.parametrize(
    "name",
    [
        *("fifo", "folder", "to-fifo", "nowhere", "circle", "file/a", "/dev/null", "/dev/full", "/proc/a"),
        *("é" * 200, "a\0b", "\ud800", "new/" + 300 * "x", f"new/{300 * 'x'}/a", "nowhere/a", ""),
    ],
)
def test_what_is_no_regular_file_is_refused_and_stays_as_it_is(odd, name):
    before, device = sorted(os.listdir(odd)), os.stat("/dev/null").st_mode
    with pytest.raises(UsageError, match="^Can't write") as caught:
        check_file(odd / name)
    assert len(str(caught.value)) < 600
    with pytest.raises((UsageError, ValueError, OSError)):
        write_bytes(odd / name, b"content")
    assert sorted(os.listdir(odd)) == before and os.stat("/dev/null").st_mode == device


@pytest.mark.parametrize(
    "name", ["fifo", "file", "nowhere", "circle", "file/a", "/proc/a/b", 300 * "x", f"new/{300 * 'x'}/a"]
)
def test_a_folder_that_cannot_be_made_is_refused_and_nothing_is_made(odd, name):
    before = sorted(os.listdir(odd))
    for check in (check_folder, output_folder):
        with pytest.raises(UsageError, match="Name a folder that you can write to"):
            check(odd / name)
    assert check_folder(odd / "a" / "b") == odd / "a" / "b" and sorted(os.listdir(odd)) == before


def run(code, *arguments, **options):
    """A process that runs Python code."""
    words = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.Popen(words, stdout=subprocess.PIPE, text=True, **options)


NOBODY = """import os, pathlib, sys
from macid.files import UsageError, check_file, check_folder, write_bytes
os.setgid(65534)
os.setuid(65534)
folder = pathlib.Path(sys.argv[1])
for check, name in ((check_file, "a"), (check_file, "closed/b"), (check_folder, "closed/c")):
    try:
        check(folder / name)
    except UsageError:
        print("refused")
try:
    write_bytes(folder / "a", b"yours")
except OSError as error:
    print("protected" if "protected" in str(error) else error)
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="another user is needed")
def test_a_protected_file_or_folder_is_refused(tmp_path):
    (tmp_path / "a").write_text("mine")
    (tmp_path / "a").chmod(0o444)
    (tmp_path / "closed").mkdir(mode=0o555)
    for folder in (tmp_path, *tmp_path.parents[:2]):
        folder.chmod(0o777)
    done = run(NOBODY, tmp_path)
    assert done.communicate()[0] == "refused\n" * 3 + "protected\n" and done.returncode == 0
    assert (tmp_path / "a").read_text() == "mine"


def test_a_folder_that_went_is_named_and_not_a_temporary_file(tmp_path):
    (tmp_path / "out").mkdir()

    def loses_its_folder():
        with new_file(tmp_path / "out" / "a.json") as (_, temporary):
            temporary.unlink()
            (tmp_path / "out").rmdir()

    with pytest.raises(OSError, match=f"Can't write '{tmp_path}/out/a.json': there is no folder '{tmp_path}/out'"):
        loses_its_folder()
    with pytest.raises(UsageError, match=f"there is no folder '{tmp_path}/out'"):
        write_bytes(tmp_path / "out" / "a.json", b"")


@pytest.fixture
def small_disk(tmp_path):
    """A folder on a disk of 600 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=600k", "tmpfs", folder], capture_output=True).returncode:
        pytest.skip("may not mount a file system")
    yield folder
    subprocess.run(["umount", folder], check=True)


def test_a_full_disk_is_told_and_the_old_file_stays(small_disk):
    write_bytes(small_disk / "a", b"old")
    with pytest.raises(OSError, match="disk/a': No space left on device"):
        write_bytes(small_disk / "a", bytes(1_000_000))
    assert (small_disk / "a").read_bytes() == b"old" and os.listdir(small_disk) == ["a"]


HOLD = """import sys, time
from macid.files import lock_folder, new_file
with lock_folder(sys.argv[1]) as folder, new_file(folder / "checkpoint.npz") as (handle, _):
    open(handle, "wb", closefd=False).write(bytes(1000))
    print("there", flush=True)
    time.sleep(60)
"""


def test_a_folder_is_one_process_s_and_after_kill_9_the_next_has_it_and_removes_what_was_half_written(tmp_path):
    folder = tmp_path / "deep" / "run"
    (tmp_path / "link").symlink_to("deep/run")
    holder = run(HOLD, folder)
    assert holder.stdout.readline() == "there\n"
    for name in ("deep/run", "link"):
        with pytest.raises(UsageError, match="Another run is at work"), lock_folder(tmp_path / name):
            pass
    (half,) = os.listdir(folder)
    remove_leftovers(folder)
    remove_leftovers(folder, "checkpoint.npz")
    assert os.listdir(folder) == [half], "It is still being written."
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    (folder / ".notes.ab12cd34").write_text("not ours")
    with lock_folder(folder):
        assert os.listdir(folder) == [".notes.ab12cd34"]
        with pytest.raises(UsageError), lock_folder(folder):
            pass
    with lock_folder(folder):
        pass


def test_the_next_writer_of_a_file_removes_what_killed_ones_left_of_it(tmp_path):
    long = 240 * "x" + ".webm"
    for name in ("a.json", "é.csv", long):
        with contextlib.suppress(KeyboardInterrupt), new_file(tmp_path / name, ".webm") as (_, temporary):
            (tmp_path / f"kept{temporary.name}").touch()
            raise KeyboardInterrupt
        assert sorted(os.listdir(tmp_path)) == [f"kept{temporary.name}"]
        (tmp_path / f"kept{temporary.name}").rename(temporary)  # as if it had been killed
        write_bytes(tmp_path / name, b"")
        assert os.listdir(tmp_path) == [name]
        (tmp_path / name).unlink()


def test_a_folder_made_for_what_fails_goes_again(tmp_path):
    (tmp_path / "mine").mkdir()
    for name in ("a/b/c", "mine/d", "mine"):
        for made in (new_folder, lock_folder, lambda path: lock_folder(path, alone=("config.json",))):
            with contextlib.suppress(KeyError), made(tmp_path / name) as folder:
                assert folder.is_dir()
                raise KeyError
            assert os.listdir(tmp_path) == ["mine"] and os.listdir(tmp_path / "mine") == []
    for others in ([], ["policy.npz"]):
        with contextlib.suppress(KeyError), lock_folder(tmp_path / "a" / "b", alone=("config.json",)) as folder:
            for name in ("config.json", *others):
                (folder / name).touch()
            raise KeyError
        assert (tmp_path / "a").exists() == bool(others)
    assert sorted(os.listdir(tmp_path / "a" / "b")) == ["config.json", "policy.npz"]
    with contextlib.suppress(KeyError), lock_folder(tmp_path / "a" / "b", alone=("config.json",)) as folder:
        raise KeyError
    assert sorted(os.listdir(tmp_path / "a" / "b")) == ["config.json", "policy.npz"]


PRINT = """import sys
from macid.files import write_bytes
from macid.running import run_command
def main():
    for line in range(5000):
        print("line", line, "\\udcff")
        print("progress", line, file=sys.stderr)
    write_bytes("result", b"whole")
    print("Written")
    return 0
sys.exit(run_command("tool", main))
"""


@pytest.mark.parametrize(
    ("output", "code", "told"),
    [
        ("", 0, "progress 4999\n"),
        ("> /dev/full", 2, "progress 4999\ntool: error: Can't print: No space left on device.\n"),
        ("| true", 1, "progress 4999\n"),
        (">&-", 0, "progress 4999\n"),
        ("2>&-", 0, ""),
        ("2> /dev/full", 0, ""),
        ("> /dev/full 2> /dev/full", 2, ""),
    ],
)
def test_what_cannot_be_printed_stops_nothing_that_is_to_be_written(tmp_path, output, code, told):
    (tmp_path / "print.py").write_text(PRINT)
    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; '{sys.executable}' print.py {output}"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        errors="replace",
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path)), "PYTHONIOENCODING": "ascii"},
    )
    assert done.returncode == code and done.stderr.endswith(told) and "Traceback" not in done.stderr
    assert (tmp_path / "result").read_bytes() == b"whole"


@pytest.mark.parametrize("there", [False, True])
def test_a_whole_folder_is_there_at_the_end_or_not_at_all(tmp_path, there):
    path = tmp_path / "new" / "folder"
    if there:
        path.mkdir(parents=True)
    before = sorted(tmp_path.rglob("*"))

    def fails_half_way():
        with whole_folder(path) as folder:
            (folder / "half").touch()
            assert not path.exists() or not os.listdir(path)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fails_half_way()
    assert sorted(tmp_path.rglob("*")) == before
    with whole_folder(path) as folder:
        (folder / "below").mkdir()
        (folder / "below" / "a").write_text("whole")
    assert os.listdir(path.parent) == ["folder"] and (path / "below" / "a").read_text() == "whole"
    with pytest.raises(UsageError, match="There are files in .*folder' already"), whole_folder(path):
        pass
    assert (path / "below" / "a").read_text() == "whole"


def test_a_whole_folder_s_next_writer_removes_what_a_killed_one_left_of_it(tmp_path):
    code = (
        "import os, sys, signal; from macid.files import whole_folder\n"
        "with whole_folder(sys.argv[1]) as folder:\n"
        "    (folder / 'half').touch()\n"
        "    os.kill(os.getpid(), signal.SIGKILL)"
    )
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path / "a")]).returncode == -signal.SIGKILL
    assert len(os.listdir(tmp_path)) == 1
    with whole_folder(tmp_path / "a"), whole_folder(tmp_path / "b"):
        assert len(os.listdir(tmp_path)) == 2  # the one at work and its own stay
    assert sorted(os.listdir(tmp_path)) == ["a", "b"]


def test_an_output_folder_is_made(tmp_path):
    assert output_folder(tmp_path / "a" / "b").is_dir()
    assert output_folder(str(tmp_path)) == tmp_path
    assert os.listdir(tmp_path / "a" / "b") == []


def test_a_folder_that_cannot_be_is_told(tmp_path):
    (tmp_path / "file").touch()
    for bad in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(UsageError, match="Name a folder that you can write to"):
            output_folder(bad)


@pytest.mark.parametrize(
    ("error", "code"),
    [(kind("no such"), 2) for kind in (UsageError, ValueError, FileNotFoundError)]
    + [(kind(13, "no such", "a\nb"), 2) for kind in (OSError, PermissionError, BrokenPipeError)]
    + [(KeyboardInterrupt(), 130)],
)
def test_a_users_error_is_one_line_and_an_exit_code(capsys, error, code):
    def main():
        raise error

    assert run_command("tool", main) == code
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("tool: ") and err.count("\n") == 1
    assert ("no such" in err) == (code == 2)


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (OSError(28, "No space left on device", "a/b.npz"), "error: No space left on device: 'a/b.npz'."),
        (PermissionError(13, "Permission denied"), "error: Permission denied."),
        (MemoryError("8 TB"), "not enough memory"),
        (UsageError("two\nlines\x1b[0m and \udcff"), r"error: two lines\x1b[0m and \udcff"),
        (UsageError("x" * 100_000), "xxx..."),
    ],
)
def test_whatever_an_error_says_is_one_printable_line(capsys, error, told):
    def main():
        raise error

    assert run_command("tool", main) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("tool: error: ") and err.count("\n") == 1 and told in err
    assert err[:-1].isprintable() and len(err) < 5000


def test_other_errors_are_not_hidden():
    with pytest.raises(ZeroDivisionError):
        run_command("tool", lambda: 1 / 0)
    assert run_command("tool", lambda: 0) == 0
