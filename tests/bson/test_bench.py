import pytest

from bson import bench, cli
from bson.env import ENVIRONMENTS


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
