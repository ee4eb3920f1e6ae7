"""What tools/*.sh and the flags of tools/reproduce_*.py answer where they can't do what was asked."""

import json
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]
NOBODY = 65534


@pytest.fixture
def sealed():
    """A checkout (its tools and pyproject.toml) that can't be written, and what makes a process unable to."""
    folder = pathlib.Path(tempfile.mkdtemp())
    try:
        shutil.copytree(ROOT / "tools", folder / "tools")
        shutil.copy(ROOT / "pyproject.toml", folder)
        for path in (folder, *folder.rglob("*")):
            path.chmod(0o755 if path.is_dir() or path.suffix == ".sh" else 0o644)
        user = {"user": NOBODY, "group": NOBODY} if os.getuid() == 0 else {}
        folder.chmod(0o555)
        yield folder, user
    finally:
        folder.chmod(0o755)
        shutil.rmtree(folder)


@pytest.mark.parametrize("tool", ["setup.sh", "demo.sh", "test.sh"])
def test_where_the_checkout_cannot_be_written_the_tools_say_what_to_do(sealed, tool):
    folder, user = sealed
    ran = subprocess.run(["bash", str(folder / "tools" / tool)], capture_output=True, text=True, cwd="/", **user)
    assert ran.returncode == 1 and ran.stdout == ""
    assert ran.stderr.count("\n") == 1 and f"can't write to {folder}" in ran.stderr
    assert "copy the checkout" in ran.stderr and f"pip install {folder}" in ran.stderr


def test_the_demo_asks_for_a_folder_where_only_the_checkout_cannot_be_written(sealed):
    folder, user = sealed
    folder.chmod(0o755)
    (folder / "tools" / "setup.sh").write_text("#!/bin/sh\n")  # all is there already
    (folder / ".venv" / "bin").mkdir(parents=True)
    (folder / ".venv" / "bin" / "bson").write_text('#!/bin/sh\necho ran "$@"\n')
    (folder / ".venv" / "bin" / "bson").chmod(0o755)
    folder.chmod(0o555)
    demo = ["bash", str(folder / "tools" / "demo.sh")]
    ran = subprocess.run(demo, capture_output=True, text=True, cwd="/", **user)
    assert ran.returncode == 1 and "--out" in ran.stderr and ran.stderr.count("\n") == 1
    ran = subprocess.run([*demo, "--out", "/tmp/x"], capture_output=True, text=True, cwd="/", **user)
    assert (ran.returncode, ran.stdout) == (0, "ran demo --out /tmp/x\n")


def test_numbers_of_the_tools_are_bounded(tmp_path):
    code = (
        "import importlib.util, sys\n"
        "tools = {'tables': '--seeds --agent-steps --episodes', 'table3': '--seeds --steps --episodes'}\n"
        "for tool, flags in tools.items():\n"
        f"    spec = importlib.util.spec_from_file_location(tool, {str(ROOT)!r} + f'/tools/reproduce_{{tool}}.py')\n"
        "    module = importlib.util.module_from_spec(spec)\n"
        "    spec.loader.exec_module(module)\n"
        "    for flag in flags.split():\n"
        "        for value in ('nan', 'inf', '-inf', '1e400', str(2**62), str(2**63), '0', 'x', '9' * 5000, ''):\n"
        "            sys.argv[1:] = [flag, value, '--out', 'out']\n"
        "            try:\n"
        "                code = module.main()\n"
        "            except SystemExit as error:\n"
        "                code = error.code\n"
        "            print(tool, flag, value[:20], code)\n"
        "    sys.argv[1:] = ['--out', 'a\\udcff']\n"
        "    print(tool, '--out', '', module.main())\n"
    )
    if "torch" not in sys.modules:
        pytest.importorskip("torch")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ran = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    lines = ran.stdout.splitlines()
    assert len(lines) == 2 * (3 * 10 + 1) and all(line.endswith(" 2") for line in lines), ran.stdout
    told = ran.stderr.splitlines()
    assert len(told) == len(lines) and all(": error: " in line and len(line) < 6000 for line in told)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_table_of_models_beside_people_goes_on_where_it_was(tmp_path):
    words = [sys.executable, str(ROOT / "tools" / "reproduce_human.py"), "--pedestrians", "standing", "--seeds", "1"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    for expected in (2, 0):  # measurements made
        ran = subprocess.run([*words, "--out", "out"], cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert ran.returncode == 0, ran.stderr
        assert ran.stderr.count("human: standing") == expected
    table = (tmp_path / "out" / "human.md").read_text().splitlines()
    assert [line.split("|")[1].strip() for line in table[2:]] == ["*people*", "standing", "standing, 0.2 m"]
    rows = json.loads((tmp_path / "out" / "human.json").read_text())
    assert rows["standing, 0.2 m"]["radius"] == 0.2 and rows["standing"]["values"]["through18"] == [0.0]
    assert len(list((tmp_path / "out" / "rows").iterdir())) == 2
