import json
import os
import pathlib
import subprocess
import sys

import pytest

import macid
from macid.cli import main


def test_evaluate_writes_the_table(tmp_path, capsys):
    out = tmp_path / "new" / "table.json"
    arguments = ["evaluate", "--pedestrian", "social-force", "--levels", "1", "--episodes", "2", "--out", str(out)]
    assert main([*arguments, "--period", "0.1", "--lcf", "0", "1", "--seed", "3"]) == 0
    (row,) = json.loads(out.read_text())
    for name in ("SR10", "CP", "PE", "arrived"):
        assert row[name] >= 0 and row[f"{name}_std"] >= 0
    assert row["arrived"] > 50
    assert (row["pedestrian"], row["level"], row["people"], row["episodes"]) == ("social-force", 1, 25, 2)
    assert (row["seed"], row["engine"]) == (3, "native")
    assert (row["config"]["period"], row["config"]["lcf"], row["config"]["duration"]) == (0.1, [0.0, 1.0], 20.0)
    printed, progress = capsys.readouterr()
    assert "SR10" in printed and f"{row['SR10']:.1f} +- {row['SR10_std']:.1f}" in printed and str(out) in printed
    assert "Lv.1" in progress
    assert os.listdir(out.parent) == ["table.json"]


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (["--pedestrian", "orka"], "Unknown pedestrian model 'orka'. Choose one of "),
        (["--levels", "1", "7"], "Unknown level 7. Choose one of 1, 2, 3, 4, v1"),
        (["--levels", "one"], "Unknown level 'one'. Choose one of 1, 2, 3, 4, v1"),
        (["--episodes", "0"], "--episodes must be at least 1, not 0"),
        (["--period", "0.03"], "multiple of the physics step 0.02 s, not 0.03"),
        (["--period", "inf"], "multiple of the physics step"),
        (["--lcf", "1", "0"], "range (least, most)"),
        (["--out", "{file}/below/table.json"], "Name a folder that you can write to"),
        (["--out", "{folder}"], "is a folder. Name a JSON file"),
    ],
)
def test_a_wrong_request_is_one_line_and_exit_code_2(tmp_path, capsys, wrong, told):
    (tmp_path / "file").write_text("mine")
    wrong = [word.format(file=tmp_path / "file", folder=tmp_path) for word in wrong]
    assert main(["evaluate", "--pedestrian", "orca", "--out", str(tmp_path / "table.json"), *wrong]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("macid: error: ") and err.count("\n") == 1 and told in err
    assert os.listdir(tmp_path) == ["file"] and (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["evaluate", "--pedestrian", "orca", "--engine", "bullet"], "native"),
        (["evaluate", "--pedestrian", "orca", "--episodes", "one"], "--episodes"),
        (["evaluate"], "--pedestrian"),
        (["evalute"], "evaluate"),
        ([], "command"),
    ],
)
def test_what_the_parser_refuses_has_exit_code_2(capsys, arguments, told):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    assert told in capsys.readouterr().err.splitlines()[-1]


def test_bench_measures_rollout_and_training(tmp_path, capsys):
    out = tmp_path / "bench.json"
    assert main(["bench", "--levels", "1", "--worlds", "1", "--seconds", "0.01", "--out", str(out)]) == 0
    (row,) = json.loads(out.read_text())
    assert row["people"] == 25 and min(row["rollout"], row["training"]) > 0


def test_train_writes_a_policy_that_evaluate_takes(tmp_path):
    command = ["train", "--method", "macid-tri", "--worlds", "1", "--level", "1", "--agent-steps", "3000"]
    assert main([*command, "--out", str(tmp_path)]) == 0
    policy = tmp_path / "macid-tri-0" / "policy.npz"
    out = tmp_path / "rows.json"
    arguments = ["evaluate", "--pedestrian", str(policy), "--levels", "1", "--episodes", "1", "--period", "0.1"]
    assert main([*arguments, "--out", str(out)]) == 0
    (row,) = json.loads(out.read_text())
    assert row["config"]["lcf"] == pytest.approx([0.5236, 1.0472], abs=1e-4)
    with pytest.raises(SystemExit):
        main([*arguments, "--preset", "x"])


def test_a_wrong_choice_of_opengl_is_one_line_and_exit_code_2(tmp_path):
    command = [sys.executable, "-m", "macid.cli", "evaluate", "--pedestrian", "orka"]
    environment = os.environ | {"MUJOCO_GL": "metal", "PYTHONPATH": str(pathlib.Path(macid.__file__).parents[1])}
    ran = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert ran.returncode == 2 and ran.stdout == ""
    assert ran.stderr.count("\n") == 1 and "MUJOCO_GL='metal'" in ran.stderr
