"""Any command line ends in success, or in one line on stderr and exit code 2 (doctor: 1 too); nothing half-written."""

import contextlib
import io
import os
import pathlib
import shutil
import sys

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import bson.bench
import macid.bench
import macid.evaluate
import macid.learning.train
from bson import cli as bson_cli
from macid import cli as macid_cli
from macid.learning.curves import training_folder

FILES = {
    "good.py": "def agent(observation):\n    return [0.1, 0.0]\n",
    "raises.py": "1 / 0\n",
    "leaves.py": "exit(7)\n",
    "syntax.py": "def agent(:\n",
    "late.py": "def agent(observation):\n    exit(7)\n",
    "lists.py": "def agent(observation):\n    return [[0.1], [0.2]]\n",
    "picky.py": "class agent:\n    def __init__(self, needed):\n        pass\n",
    "junk.npz": "junk",
    "junk.json": "{",
    "results.json": '{"agent": 3}',
    "junk.toml": "[[",
    "page.md": "no place for a leaderboard\n",
}
BROKEN = [
    "", " ", "-", "nan", "inf", "-inf", "1e400", "-1e400", "1e308", "-1", "0", "0.03", str(2**62), str(2**63),
    str(-(2**63)),
    "9" * 5000, "x" * 5000, "/".join(["y" * 300] * 3), "\udcff", "a\udc80b.webm", "a\0b", "a\nb", "é", "None", "True",
    "[", "[]",
    "{[]: 1}", "(" * 3000, "-" * 5000 + "1", "[" * 150, "1j", "b'x'", "{1, 2}", "...", "..", ".", "/dev/null",
    "/proc/self/mem",
    "missing.py", "missing.npz", "missing.toml", "raises.py", "leaves.py", "syntax.py", "late.py", "lists.py",
    "picky.py",
    "picky.py:nobody", "junk.npz", "junk.json", "junk.toml", "folder", ".near:agent", "a/b:c", ":", "os:path",
    "sys:exit",
    "raises:agent", "leaves:agent", "math:sqrt", "file/below", "file",
]  # fmt: skip
KEYS = ["num_pedestrians", "pedestrian_density", "obstacle_density", "pedestrian_model", "lcf", "lcf_each", "map_size",
        "map",
        "control_period", "pedestrian_period", "horizon", "goal_distance", "reward", "robot", "self", "config",
        "changes",
        "obj", "kwargs", "", "__class__", "people"]  # fmt: skip
VALUES = ["3", "2", "0.1", "0.0", "orca", "(1, 2)", "{'macid': 1, 'orca': 2}", "{'orca': nan}", "{1: 2}",
        "{'goal': 1.0}",
          "[1, 'a']", "1e19", "-3", "20.0", "{'max_speed': 1.0}", "{'max_speed': 1e300}", "{'collision': -1e400}",
          "(6, 12)", "(2, 1)", "hall", "diffbot", "\udcff", "[0.5, 0.5]", "[" + "1," * 3000 + "]"]  # fmt: skip

# command: {flag: its valid values}; a flag of None takes no value.
BSON = {
    "evaluate": {
        "--agent": ["stop", "goal", "good.py"], "--track": ["local", "global"], "--sensor": ["lidar2d"],
        "--suite": ["smoke"], "--episodes": ["1"], "--seed": ["0", "3"], "--videos": ["0"], "--out": ["out", "new/out"],
        "--resume": None, "--record": None, "--executor": ["local"], "--ray-address": ["auto"], "--workers": ["2"],
    },
    "render": {"--agent": ["stop"], "--seed": ["0"], "--step": ["0", "-1"], "--out": ["a.png", "b.gif"]},
    "export": {"--track": ["global"], "--sensor": ["camera"], "--seed": ["0"], "--suite": ["smoke"], "--cell": ["all"],
               "--out": ["out", "new/out"]},
    "compare": {"--out": ["out"]},
    "leaderboard": {"--readme": ["page.md"]},
    "verify": {"--agent": ["stop"], "--share": ["0.5"], "--seed": ["0"], "--suite": ["smoke", "held-out"],
               "--passphrase-file": ["page.md"], "--out": ["out.json"]},
    "train": {"--algo": ["ppo", "bc"], "--steps": ["64", "1e3"], "--worlds": ["1", "2"], "--seed": ["0"],
        "--out": ["runs"],
              "--resume": None, "--tensorboard": None},
    "bench": {"--pedestrians": ["2"], "--worlds": ["1"], "--sensors": ["none"], "--seconds": ["0.1"],
              "--pedestrian-model": ["orca"], "--out": ["b.json"], "--train": ["ppo"], "--record": None},
    "record": {"--agent": ["stop"], "--seed": ["0"], "--suite": ["smoke"], "--episodes": ["1"], "--twist": None,
               "--out": ["out", "new/out"]},
    "replay": {"--out": ["out"]},
    "list": {}, "demo": {"--episodes": ["0"]}, "nothing": {},
}  # fmt: skip
MACID = {
    "evaluate": {
        "--pedestrian": ["orca", "macid"], "--levels": ["1", "v2"], "--episodes": ["1", "3"], "--seed": ["0", "5"],
        "--period": ["0.1", "20"], "--lcf": ["0"], "--bins": None, "--engine": ["native"], "--out": ["a.json",
            "new/a.json"],
    },
    "watch": {"--pedestrian": ["orca"], "--level": ["1"], "--seed": ["0"], "--seconds": ["1"], "--period": ["0.1"],
              "--speed": ["2"], "--follow": ["3"], "--at": ["0"], "--scale": ["0.5"], "--out": ["a.gif"]},
    "export": {"--level": ["1"], "--map": ["hall"], "--people": ["3"], "--seed": ["0"], "--period": ["0.1"],
        "--lcf": ["0"],
               "--out": ["out", "new/out"]},
    "train": {"--method": ["macid", "ipo"], "--engine": ["native"], "--level": ["1"], "--seed": ["0"], "--seeds": ["2"],
              "--worlds": ["1"], "--period": ["0.1"], "--agent-steps": ["1e4"], "--preset": ["paper"],
                  "--out": ["runs"],
              "--resume": None, "--tensorboard": None, "--executor": ["local"], "--ray-address": ["auto"],
                  "--workers": ["2"]},
    "bench": {"--levels": ["1"], "--worlds": ["1"], "--seconds": ["0.1"], "--out": ["b.json"], "--preset": ["fast"]},
    "nothing": {},
}  # fmt: skip
TINY = ["--suite", "smoke", "--episodes", "1", "--videos", "0", "--agent", "stop"]
SETS = ["--set", "horizon=2", "--set", "map_size=20.0", "--set", "goal_distance=(6,12)", "--set", "num_pedestrians=2"]


@st.composite
def command_lines(draw, commands, program):
    """A command with some of its flags, each with a valid or a broken value, and now and then something that is no
    flag."""
    command = draw(st.sampled_from(sorted(commands)))
    words, flags = [command], commands[command]
    if program == "bson" and command in ("evaluate", "demo"):
        words += TINY
    if command == "record":
        words += ["--out", "out", "--agent", "stop"]
    if program == "bson" and command in ("evaluate", "demo", "render", "record", "export", "train"):
        words += SETS
        for _ in range(draw(st.integers(0, 2))):
            value = draw(st.one_of(st.sampled_from(VALUES), st.sampled_from(BROKEN), st.text(max_size=5)))
            words += ["--set", f"{draw(st.sampled_from(KEYS))}={value}"]
    if command in ("compare", "leaderboard", "replay", "verify"):
        words += draw(
            st.lists(st.sampled_from(["folder", "results.json", "junk.json", *BROKEN]), min_size=1, max_size=3)
        )
    if program == "macid" and command == "evaluate":
        words += ["--pedestrian", "orca"]
    if command == "watch":  # films and pictures take too long here: it is refused at the latest for that ending
        words += ["--out", "a.gif"]
    for flag in draw(st.lists(st.sampled_from(sorted(flags)), max_size=4, unique=True)) if flags else []:
        words.append(flag)
        if flags[flag] is not None:
            count = draw(st.integers(1, 2)) if flag in ("--levels", "--worlds", "--lcf", "--sensors") else 1
            for _ in range(count):
                good = draw(st.booleans())
                words.append(
                    draw(st.sampled_from(flags[flag]) if good else st.one_of(st.sampled_from(BROKEN), st.text()))
                )
    if draw(st.integers(0, 9)) == 0:
        words.insert(draw(st.integers(0, len(words))), draw(st.sampled_from(["--unknown", *BROKEN])))
    return words


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder to run in, with agents and documents of all kinds. What takes long is replaced by what it writes."""
    folder = tmp_path_factory.mktemp("lines")
    row = macid.evaluate.evaluate_level("standing", 1, 1, config=macid.crowd.CrowdConfig(period=1.0, duration=1.0))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "path", list(sys.path))

        def level(pedestrian, level, episodes, seed, config, engine):
            return {**row, "pedestrian": pedestrian, "level": level, "config": {"lcf": config.lcf}}

        def train(config, out, seeds, resume, show, tensorboard):
            for seed in range(config.seed, config.seed + seeds):
                training_folder(pathlib.Path(out) / f"{config.name}-{seed}", config, resume)

        patch.setattr(macid.evaluate, "evaluate_level", level)
        patch.setattr(macid.learning.train, "train", train)
        patch.setattr(macid.bench, "measure", lambda config, seconds: (1.0, 1.0))
        patch.setattr(bson.bench, "measure_speed", lambda config, sensors, nworld, seconds: (1.0, 0.5))
        patch.setattr(bson.bench, "measure_recording", lambda config, sensors, seconds: (1.0, 1))
        patch.setattr(bson.bench, "measure_learning", lambda algo, config, nworld, seconds: (1.0, 0.5, 0.5))
        with contextlib.suppress(ImportError):
            import bson.learning.train as learning

            def train_robot(config, out, resume, tensorboard):
                return training_folder(pathlib.Path(out) / f"{config.name}-{config.seed}", config, resume)

            patch.setattr(learning, "train_with_bar", train_robot)
        yield folder


def fresh(folder):
    """Empties the folder but for what command lines name."""
    for path in folder.iterdir():
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    for name, content in FILES.items():
        (folder / name).write_text(content)
    (folder / "folder").mkdir()
    (folder / "file").write_text("mine")


def check(program, words, folder):
    """Runs a command line in-process and asserts that it ends as it should; its exit code."""
    fresh(folder)
    main = {"bson": bson_cli.main, "macid": macid_cli.main}[program]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = main(words)
        except SystemExit as stop:
            code = stop.code
    text = err.getvalue()
    errors = [line for line in text.splitlines() if ": error: " in line]
    assert code in (0, 2), (code, text)
    assert "Traceback" not in text and (folder / "file").read_text() == "mine"
    if code == 2:
        assert len(errors) == 1 and errors[0] == text.rstrip("\n").splitlines()[-1], text
        assert errors[0].startswith(program) and errors[0].isprintable() and len(errors[0]) <= 4100
        assert not any(name in names for _, _, names in os.walk(folder) for name in ("report.html", "policy.npz"))
    return code


QUICK = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}


@pytest.mark.parametrize(("program", "commands", "number"), [("bson", BSON, 150), ("macid", MACID, 350)])
def test_any_command_line_ends_in_success_or_one_line(place, program, commands, number):
    codes = []

    @settings(max_examples=number, derandomize=True, **QUICK)
    @given(command_lines(commands, program))
    def hold(words):
        codes.append(check(program, words, place))

    hold()
    assert codes.count(2) > 80 and codes.count(0) > 2


@pytest.mark.slow
@pytest.mark.parametrize(("program", "commands"), [("bson", BSON), ("macid", MACID)])
def test_ten_thousand_command_lines_of_each_command(place, program, commands):
    codes = []

    @settings(max_examples=10_000, **QUICK)
    @given(command_lines(commands, program))
    def hold(words):
        codes.append(check(program, words, place))

    hold()
    print(
        f"{program}: {len(codes)} command lines, {codes.count(0)} succeeded, {codes.count(2)} were refused in one line"
    )


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["evaluate", "--set", "self=1"], "Unknown option 'self'. Choose among num_pedestrians"),
        (["evaluate", "--set", "config=1"], "Unknown option 'config'"),
        (["evaluate", "--set", "changes={}"], "Unknown option 'changes'"),
        (["evaluate", "--set", "lcf={[]: 1}"], "--set lcf: '{[]: 1}' is no value"),
        (["evaluate", "--set", "lcf=" + "-" * 90_000 + "1"], "--set lcf: the value is nested too deeply"),
        (["evaluate", "--set", "lcf=1e400"], "--set lcf: a number from -1e+18 to 1e+18 is wanted, not inf"),
        (["evaluate", "--set", "lcf=1j"], "--set lcf takes numbers, texts, lists and dicts, not 1j"),
        (["evaluate", "--seed", str(2**63)], "--seed must be at most 9000000000000, not 9223372036854775808"),
        (["evaluate", "--videos", str(2**62)], "--videos must be at most 10000"),
        (["evaluate", "--out", "a\udcff"], "'a\\udcff' is not UTF-8"),
        (["evaluate", "--agent", "x" * 5000], "argument --agent: a name has 1 to 1000 characters, not 5,000"),
        (["evaluate", "--agent", "leaves:agent"], "Agent 'leaves:agent': importing 'leaves' called exit(7) in"),
        (["train", "--steps", "nan"], "--steps must be a number from 1 to 1e+12, not nan"),
        (["train", "--worlds", str(2**62)], "--worlds must be at most 65536"),
        (["bench", "--pedestrians", "10001"], "--pedestrians must be at most 10000"),
        (["bench", "--seconds", "-inf"], "--seconds must be a number from 0 to 1e+06, not -inf"),
    ],
)
def test_what_is_wrong_is_told_with_what_is_valid(place, monkeypatch, capsys, words, told):
    fresh(place)
    monkeypatch.chdir(place)
    try:
        code = bson_cli.main(words)
    except SystemExit as stop:
        code = stop.code
    err = capsys.readouterr().err
    assert code == 2 and err.count("\n") == 1 and told in err
    assert {path.name for path in place.iterdir()} - {"__pycache__"} == {*FILES, "folder", "file"}
