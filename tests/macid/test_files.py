import json
import os

import pytest

from macid.files import UsageError, output_folder, run_command, write_bytes, write_json


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


def test_others_may_read_a_result(tmp_path):
    write_bytes(tmp_path / "a", b"")
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o644


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
    [(kind("no such"), 2) for kind in (UsageError, ValueError, FileNotFoundError)] + [(KeyboardInterrupt(), 130)],
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
