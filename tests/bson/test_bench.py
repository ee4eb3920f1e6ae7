import pytest

from bson import ENVIRONMENTS, bench, cli


def test_every_environments_sensors_can_be_measured():
    assert list(bench.SENSORS) == ["none", *dict.fromkeys(each["sensor"] for each in ENVIRONMENTS.values())]
    assert bench.SENSORS["none"] == ()


def test_an_unknown_sensor_is_told_before_anything_is_measured(capsys):
    with pytest.raises(ValueError, match="Unknown sensor 'sonar'. Choose among none, lidar2d, lidar3d, camera"):
        bench.run(sensors=("none", "sonar"))
    assert capsys.readouterr().out == ""
    assert cli.main(["bench", "--sensors", "sonar"]) == 2
    out, error = capsys.readouterr()
    assert out == "" and error.count("\n") == 1 and "'sonar'" in error


def test_training_is_measured_in_shares_of_its_time(capsys):
    pytest.importorskip("stable_baselines3")
    (row,) = bench.run_learning(("sac",), people=(2,), batches=(4,), seconds=0.5, model="social-force")
    assert row["algo"] == "sac" and row["steps_per_s"] > 0
    assert 0.0 < row["in_updates"] < 1.0 and 0.0 < row["in_mujoco"] < 1.0 - row["in_updates"]
    assert f"{row['steps_per_s']:,.0f}" in capsys.readouterr().out


@pytest.mark.parametrize("words", [["--seconds", "0"], ["--out", "."], ["--worlds", "0"]])
def test_what_cannot_be_measured_is_told_at_once(words, capsys):
    assert cli.main(["bench", *words]) == 2
    out, error = capsys.readouterr()
    assert out == "" and words[0] in error


@pytest.mark.parametrize(
    ("words", "told"), [(["--train", "dqn"], "Choose among ppo, sac, tac"), (["--train", "--sensors", "none"], "leave")]
)
def test_a_wrong_training_to_measure_is_told(words, told, capsys):
    pytest.importorskip("stable_baselines3")
    assert cli.main(["bench", *words]) == 2
    assert told in capsys.readouterr().err
