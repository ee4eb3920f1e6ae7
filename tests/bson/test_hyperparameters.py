"""Hyperparameters: what they may be, what `bson train` takes of them, and the command that a recipe tells."""

import dataclasses
import json
import pathlib
import re
import shlex

import pytest

from bson.cli import main
from macid import assets
from macid.files import UsageError

pytest.importorskip("stable_baselines3")

from bson.learning import train as train_module
from bson.learning.algorithms import PpoConfig, SacConfig
from bson.learning.dagger import DaggerConfig
from bson.learning.device_ppo import STARTED, DevicePpoConfig, DeviceTrainConfig
from bson.learning.hyperparameters import changed, read_changes
from bson.learning.imitation import BcConfig
from bson.learning.presets import PRESETS, hyperparameters
from bson.learning.recurrent_ppo import RecurrentPpoConfig
from bson.learning.recurrent_sac import RecurrentSacConfig
from bson.learning.train import TrainConfig

CONFIGS = (PpoConfig, SacConfig, BcConfig, DaggerConfig, RecurrentPpoConfig, RecurrentSacConfig, DevicePpoConfig)
ODD = (None, "x", "", -1, -0.5, float("nan"), float("inf"), 10**12, [0], (1.5,), (), {}, True)
# Odd values that a field of some name may have all the same.
ALLOWED = {
    "log_std": (-1, -0.5),
    "entropy": (-1, -0.5),
    "expert": ("x",),
    "demonstrations": (None, "x"),
    "shield": (True,),
    "joint": (True,),
}


@pytest.mark.parametrize("kind", CONFIGS)
def test_odd_values_are_refused_by_name(kind):
    for field in dataclasses.fields(kind):
        for value in ODD:
            if any(value is one or (type(value), value) == (type(one), one) for one in ALLOWED.get(field.name, ())):
                kind(**{field.name: value})
            elif field.name != "demonstrations":
                with pytest.raises(ValueError, match=rf"^{field.name} must be "):
                    kind(**{field.name: value})


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (PpoConfig, {"batch": 1}),
        (PpoConfig, {"gamma": 1.01}),
        (SacConfig, {"q": 0.99}),
        (SacConfig, {"hidden": (256, 0)}),
        (SacConfig, {"hidden": (8,) * 17}),
        (BcConfig, {"keep": 0.0}),
        (DaggerConfig, {"rounds": 0}),
        (RecurrentPpoConfig, {"rollout": 100}),
        (RecurrentSacConfig, {"tau": 1.5}),
        (DevicePpoConfig, {"batches": 0}),
    ],
)
def test_values_just_beyond_what_is_valid_are_refused(kind, values):
    with pytest.raises(ValueError, match=f"^{next(iter(values))} must be "):
        kind(**values)


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (PpoConfig, {"batch": 2, "gamma": 1.0, "lam": 0.0, "hidden": (1,)}),
        (SacConfig, {"q": 1.0, "hidden": (8,) * 16, "learning_starts": 0}),
        (BcConfig, {"keep": 1.0}),
        (DaggerConfig, {"rounds": 1, "noise": 0}),
        (RecurrentSacConfig, {"tau": 1.0, "burn": 0}),
    ],
)
def test_values_at_the_border_are_valid(kind, values):
    made = kind(**values)
    assert {name: getattr(made, name) for name in values} == values


def test_words_become_the_fields_values():
    words = ["rounds=9", "updates=2e3", "noise=0", "learning_rate=3e-4"]
    assert changed(DaggerConfig(), read_changes(words)) == DaggerConfig(
        rounds=9, updates=2000, noise=0, learning_rate=3e-4
    )
    assert changed(PpoConfig(), read_changes(["hidden=[32, 16]"])).hidden == (32, 16)
    assert changed(SacConfig(), read_changes(["joint=True"])).joint
    assert changed(PpoConfig(), {}) == PpoConfig()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["round=9"], "Unknown hyperparameter 'round'. Choose among rounds, noise, learning_rate, .*updates.$"),
        (["rounds"], "--hyperparameter takes KEY=VALUE, not 'rounds'"),
        (["rounds=2.5"], "--hyperparameter: rounds must be a whole number of at least 1, .*not 2.5"),
        (["rounds=nine"], "rounds must be a whole number .* not 'nine'"),
        (["noise=1e999"], "--hyperparameter noise: a number .* is wanted, not inf"),
        (["noise=__import__('os')"], "noise must be a number from 0 to 10, not "),
        (["expert=mppi"], "--hyperparameter expert: it has a flag of its own, --teacher"),
        (["shield=True"], "it has a flag of its own, --shield"),
        (["rounds=1", "batch=0"], "batch must be a whole number of at least 1"),
    ],
)
def test_the_command_refuses_what_is_none(arguments, told, tmp_path, capsys):
    flags = [word for pair in arguments for word in ("--hyperparameter", pair)]
    out = tmp_path / "runs"
    assert main(["train", "--algo", "bc", "--inputs", "gru", *flags, "--out", str(out)]) == 2
    said = capsys.readouterr().err.strip()
    assert "\n" not in said and re.search(told, said), said
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--validate-episodes", "0"], "--validate-episodes"),
        (["--validate-every", "nan"], "--validate-every"),
        (["--algo", "bc", "--hyperparameter", "demonstrations=x"], "a flag of its own, --demonstrations"),
        (["--engine", "warp", "--hyperparameter", "batch=3"], "Unknown hyperparameter 'batch'. Choose among .*batches"),
        (["--engine", "warp", "--hyperparameter", "piece=7"], "rollout must be a multiple of piece"),
    ],
)
def test_other_trainings_refuse_it_too(arguments, told, tmp_path, capsys):
    assert main(["train", *arguments, "--out", str(tmp_path / "runs")]) == 2
    assert re.search(told, capsys.readouterr().err) and not (tmp_path / "runs").exists()


def as_trained(command, monkeypatch, tmp_path):
    """The configurations that the command line `command` trains."""
    words, found = shlex.split(command), []
    assert words[:2] == ["bson", "train"]

    def noted(config, out, *more, **rest):
        found.append(config)
        return tmp_path

    monkeypatch.setattr(train_module, "train_with_bar", noted)
    monkeypatch.setattr("bson.learning.device_ppo.train", noted)
    assert main([*words[1:], "--out", str(tmp_path)]) == 0
    return found


@pytest.mark.parametrize(
    "config",
    [
        TrainConfig(),
        TrainConfig("tac", 3, 12345, {"pedestrian_model": "orca", "lcf": (-1.0, 1.0)}, 8),
        TrainConfig("sac", hyperparameters=dataclasses.replace(PRESETS["paper"]["sac"], buffer=5000)),
        TrainConfig("bc", hyperparameters=BcConfig("tac", hidden=(8,))),
        TrainConfig("bc", inputs="gru", draw="standard", hyperparameters=DaggerConfig("mppi-local", 9, shield=True)),
        TrainConfig("bc", inputs="gru", hyperparameters=DaggerConfig("tac", noise=0.0), validate_episodes=5),
        TrainConfig("ppo", inputs="gru", start="gru", validate_every=7),
        TrainConfig("ppo", inputs="gru", start="gru", hyperparameters=RecurrentPpoConfig(log_std=-2.5)),
        TrainConfig("sac", inputs="gru-scans", hyperparameters=RecurrentSacConfig(entropy=-2.0)),
        DeviceTrainConfig(),
        DeviceTrainConfig(2, 10**6, {"num_pedestrians": 3}, 64, hyperparameters=DevicePpoConfig(batches=4)),
        DeviceTrainConfig(inputs="gru-scans", draw="crowds", validate_every=5, validate_episodes=3),
        DeviceTrainConfig(inputs="gru-scans", start="gru-scans.npz", hyperparameters=STARTED),
    ],
)
def test_a_configurations_command_trains_it(config, monkeypatch, tmp_path):
    assert as_trained(config.command, monkeypatch, tmp_path) == [config]


def test_an_algorithm_of_ones_own_has_a_command_too(monkeypatch, tmp_path):
    monkeypatch.chdir(pathlib.Path(__file__).parents[1] / "examples")  # each time it is loaded, its class is a new one
    for changes in ({}, {"learning_rate": 0.5}):
        chosen = changed(hyperparameters("own_algorithm.py:A2c"), changes)
        [config] = as_trained(
            TrainConfig("own_algorithm.py:A2c", hyperparameters=chosen).command, monkeypatch, tmp_path
        )
        assert dataclasses.asdict(config.hyperparameters) == dataclasses.asdict(chosen)
        assert config.algo == "own_algorithm.py:A2c" and ("--hyperparameter" in config.command) == bool(changes)


@pytest.mark.parametrize("path", sorted((assets.root() / "agents").glob("*.json")), ids=lambda path: path.stem)
def test_a_shipped_recipes_command_has_its_hyperparameters(path, monkeypatch, tmp_path):
    recipe = json.loads(path.read_text())
    [config] = as_trained(recipe["command"], monkeypatch, tmp_path)
    noted = json.loads(json.dumps(dataclasses.asdict(config)))
    for name, value in recipe["hyperparameters"].items():
        assert noted["hyperparameters"][name] == value, name
    for name in ("algo", "seed", "steps", "num_envs", "validate_episodes", "task"):
        assert noted[name] == recipe[name], name
    assert (noted["inputs"], noted["draw"]) == (recipe.get("inputs", "scans"), recipe.get("draw"))
    assert config.name == recipe["name"]


def test_a_training_by_the_command_notes_what_was_changed(tmp_path):
    task = ["num_pedestrians=2", "pedestrian_model=social-force", "horizon=20", "map_size=20.0"]
    words = ["train", "--steps", "64", "--worlds", "2", "--validate-episodes", "1", "--validate-every", "64"]
    words += [word for pair in (*task, "goal_distance=(4.0, 8.0)") for word in ("--set", pair)]
    for pair in ("hidden=(8,)", "rollout=16", "batch=16", "epochs=1"):
        words += ["--hyperparameter", pair]
    assert main([*words, "--out", str(tmp_path)]) == 0
    [folder] = tmp_path.iterdir()
    recipe = json.loads((folder / "policy.json").read_text())
    assert recipe["hyperparameters"]["hidden"] == [8] and recipe["hyperparameters"]["rollout"] == 16
    assert recipe["validate_episodes"] == 1 and "--hyperparameter rollout=16" in recipe["command"]
    assert hyperparameters("ppo") == PpoConfig()


def test_an_algorithm_of_ones_own_can_be_changed_too():
    @dataclasses.dataclass(frozen=True)
    class Mine:
        momentum: float = 0.9
        layers: tuple = (4,)

        def build(self, env, seed):
            raise NotImplementedError

    assert changed(Mine(), {"momentum": 0.5, "layers": [2]}) == Mine(0.5, (2,))
    with pytest.raises(UsageError, match="Choose among momentum, layers"):
        changed(Mine(), {"gamma": 1})
