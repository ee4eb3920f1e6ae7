import json
import types

import pytest

from bson import cli
from bson.benchmark.films import to_film
from bson.evaluation.suites import suite_names
from macid.drawing import gl

QUICK = ["--set", "map_size=20.0", "--set", "goal_distance=(6,12)", "--set", "num_pedestrians=3", "--set", "horizon=40"]


def test_evaluate_writes_results_report_and_videos(tmp_path, capsys):
    out = tmp_path / "deep" / "run"
    videos = "0" if gl.gl_problem() else "1"
    command = [
        "evaluate",
        "--agent",
        "goal",
        "--suite",
        "smoke",
        "--episodes",
        "2",
        "--videos",
        videos,
        "--out",
        str(out),
    ]
    assert cli.main([*command, *QUICK]) == 0
    content = json.loads((out / "results.json").read_text())
    assert content["agent"] == "goal" and len(content["episodes"]) == 2
    assert content["overrides"]["num_pedestrians"] == "3"
    page = (out / "report.html").read_text()
    assert f"<b>{content['summary']['SNS']:.1f}</b>" in page
    films = list((out / "videos").glob("*.webm")) if videos == "1" else []
    assert len(films) == int(videos) and page.count("data:video/webm") == int(videos)
    assert {p.name for p in out.iterdir()} <= {"results.json", "report.html", "videos"}
    assert "SNS" in capsys.readouterr().out


def cells(*collisions):
    """Episodes of cells, as far as their choice asks: each is told by its number of collisions."""
    fields = {"start_distance": 10.0, "final_distance": 0.0, "travelled": 10.0, "duration": 5.0}
    return [[types.SimpleNamespace(**fields, collisions=number) for number in cell] for cell in collisions]


@pytest.mark.parametrize(
    ("played", "number", "expected"),
    [
        (cells([1, 9, 4]), 2, [(0, 9, "the worst episode"), (0, 1, "the best episode")]),
        (cells([1, 9, 4]), 1, [(0, 9, "the worst episode")]),
        (cells([1, 9, 4]), 5, [(0, 9, "the worst episode"), (0, 4, ""), (0, 1, "the best episode")]),
        (
            cells([0, 40], [30, 20], [2, 1], [3, 5]),  # the second cell is the worst; the first has the worst episode
            2,
            [(1, 30, "the worst cell's worst episode"), (0, 40, "its worst episode"),
            (2, 1, "the best cell's best episode")],
        ),
        (cells([5], [1], []), 3, [(0, 5, "the worst cell's worst episode"), (1, 1, "its worst episode")]),
    ],
)  # fmt: skip
def test_films_are_of_the_worst_cells_and_of_the_best_episode(played, number, expected):
    assert [(cell, episode.collisions, told) for cell, episode, told in to_film(played, number)] == expected


def test_the_same_command_gives_the_same_results(tmp_path):
    contents = []
    for name in ("a", "b"):
        command = ["evaluate", "--agent", "random", "--suite", "smoke", "--episodes", "2", "--videos", "0"]
        assert cli.main([*command, "--out", str(tmp_path / name), *QUICK]) == 0
        contents.append(json.loads((tmp_path / name / "results.json").read_text()))
    assert contents[0]["episodes"] == contents[1]["episodes"]


def test_without_gl_the_evaluation_still_runs_and_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gl, "gl_problem", lambda: "no EGL here")
    command = ["evaluate", "--agent", "stop", "--suite", "smoke", "--episodes", "1", "--out", str(tmp_path)]
    assert cli.main([*command, *QUICK]) == 0
    assert "No video: no EGL here" in capsys.readouterr().err
    assert "No video: no EGL here" in (tmp_path / "report.html").read_text()
    assert cli.main(["render", "--out", str(tmp_path / "x.webm")]) == 2


NAN = "def agent(observation):\n    return [float('nan'), 0.0]\n"
SHAPE = "def agent(observation):\n    return [0.0, 0.0, 0.0]\n"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["evaluate", "--agent", "vhf"], "stop, random, goal, stop-and-go, vfh"),
        (["evaluate", "--suite", "papers"], "paper, paper-slow, scenarios, smoke, standard, street"),
        (["evaluate", "--episodes", "0"], "1 to 100"),
        (["evaluate", "--seed", "-1"], "at least 0"),
        (["evaluate", "--videos", "-1"], "at least 0"),
        (["evaluate", "--set", "people=3"], "num_pedestrians"),
        (["evaluate", "--set", "num_pedestrians"], "KEY=VALUE"),
        (["evaluate", "--set", "obstacle_density=7"], "between 0 and 1"),
        (["evaluate", "--set", "pedestrian_density=1.0", "--set", "map_size=12.0"], "no free goal"),
        (["evaluate", "--agent", "nan.py", "--episodes", "1", "--videos", "0"], "finite"),
        (["evaluate", "--agent", "shape.py", "--episodes", "1", "--videos", "0"], "two numbers"),
        (["evaluate", "--out", "taken/run"], "taken/run"),
        (["render", "--out", "film.mp4"], ".webm"),
        (["render", "--agent", "nobody"], "stop, random, goal, stop-and-go, vfh"),
        (["bench", "--pedestrian-model", "sfm"], "orca, social-force, social-force-bodies, social-force-progress"),
    ],
)
def test_a_wrong_request_is_one_line_that_names_what_is_valid_and_code_2(
    arguments, told, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "nan.py").write_text(NAN)
    (tmp_path / "shape.py").write_text(SHAPE)
    (tmp_path / "taken").write_text("a file")
    assert cli.main(arguments) == 2
    error = [line for line in capsys.readouterr().err.splitlines() if line.startswith("bson: error:")]
    assert len(error) == 1 and told in error[0]
    assert not list(tmp_path.rglob("results.json"))


def test_an_unknown_command_is_code_2():
    with pytest.raises(SystemExit) as caught:
        cli.main(["evalute"])
    assert caught.value.code == 2


def test_list_names_everything(capsys):
    assert cli.main(["list"]) == 0
    out = capsys.readouterr().out
    for name in ("BSON/LocalLidar2D-v0", "vfh", "orca", "diffbot", "paper", "smoke"):
        assert name in out
    assert all(f"suite         {name}: " in out for name in suite_names())


def test_doctor_says_what_is_missing_and_how_to_mend_it(monkeypatch, capsys):
    assert cli.main(["doctor"]) == 0
    assert "mujoco 3." in capsys.readouterr().out
    monkeypatch.setattr(gl, "gl_problem", lambda: "no EGL here")
    assert cli.main(["doctor"]) == 0
    assert "libegl1" in capsys.readouterr().out


def test_bench_prints_every_case(tmp_path, capsys):
    out = tmp_path / "bench.json"
    command = ["bench", "--pedestrians", "2", "--worlds", "1", "3", "--seconds", "0.1", "--out", str(out)]
    assert cli.main(command) == 0
    rows = json.loads(out.read_text())["rows"]
    assert [(row["worlds"], row["sensor"]) for row in rows] == [
        (1, "none"),
        (1, "lidar2d"),
        (3, "none"),
        (3, "lidar2d"),
    ]
    assert all(row["steps_per_s"] > 0 and 0 < row["in_mujoco"] < 1 for row in rows)


def test_render_makes_a_picture(tmp_path):
    if problem := gl.gl_problem():
        pytest.skip(problem)
    path = tmp_path / "scene.png"
    assert cli.main(["render", "--agent", "goal", "--seed", "1", "--out", str(path), *QUICK]) == 0
    assert path.read_bytes()[:4] == b"\x89PNG"
