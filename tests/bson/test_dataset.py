"""Datasets: what is in them is what was played, plain Minari reads it, and BC learns the same from it."""

import sys

import numpy as np
import pytest

pytest.importorskip("h5py", reason="needs the extra data")
pytest.importorskip("minari", reason="needs the extra data")

import minari

from bson import benchmark, cli
from bson.agents import load_agent
from bson.evaluation.suites import Cell, load_suite
from bson.learning import dataset
from bson.task import TaskConfig
from macid.files import UsageError

SETS = {"horizon": 12, "map_size": 20.0, "goal_distance": (6.0, 12.0), "num_pedestrians": 2, "pedestrian_model": "orca"}
WORDS = [word for key, value in SETS.items() for word in ("--set", f"{key}={value}")]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A folder of datasets with one in it: three episodes of `vfh`."""
    folder = tmp_path_factory.mktemp("datasets")
    benchmark.dataset("vfh", folder, suite="smoke", episodes=3, overrides=SETS, quiet=True)
    return folder


@pytest.fixture
def loaded(root, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    return minari.load_dataset("bson/smoke/vfh-v0")


def test_plain_minari_knows_where_a_dataset_comes_from(root, loaded):
    told, suite = loaded.storage.metadata, load_suite("smoke")
    scored = benchmark.evaluate("vfh", "smoke", episodes=3, overrides=SETS, quiet=True)
    seeds = suite.drawn(3, 0)
    assert told["seeds"] == seeds and told["suite"] == "smoke" and told["suite_digest"] is None  # as --set changed it
    assert told["task_digest"] == scored.content["task_digest"] and told["algorithm_name"] == "vfh"
    assert "bson-macid" in told["versions"] and told["overrides"]["horizon"] == "12"
    each = list(loaded.storage.get_episode_metadata(range(3)))
    assert [one["seed"] for one in each] == seeds and [one["options"]["cell"] for one in each] == ["all"] * 3
    assert np.allclose([one["options"]["SNS"] for one in each], scored.metrics["SNS"], rtol=1e-3)
    assert loaded.total_episodes == 3 and loaded.total_steps == sum(len(one) for one in loaded.iterate_episodes())
    assert list(minari.list_local_datasets()) == ["bson/smoke/vfh-v0"]
    assert [path.name for path in root.iterdir()] == ["bson"]


def test_its_actions_played_again_in_its_environment_bring_the_same(loaded):
    env = loaded.recover_environment()
    for episode in loaded.iterate_episodes():
        seed = next(iter(loaded.storage.get_episode_metadata([episode.id])))["seed"]
        observation, info = env.reset(seed=seed)
        played = [(observation, info, 0.0, False, False)]
        for action in episode.actions:
            observation, reward, terminated, truncated, info = env.step(action)
            played.append((observation, info, reward, terminated, truncated))
        assert env.observation_space == loaded.observation_space and env.action_space == loaded.action_space
        assert len(played) == len(episode.rewards) + 1 and (played[-1][3] or played[-1][4])
        for step, (observation, info, reward, terminated, truncated) in enumerate(played):
            for key, value in observation.items():
                assert np.array_equal(episode.observations[key][step], value)
                assert episode.observations[key].dtype == value.dtype
            for key, values in episode.infos.items():
                assert np.array_equal(values[step], info[key]), key
            if step:
                row = episode.rewards[step - 1], episode.terminations[step - 1], episode.truncations[step - 1]
                assert row == (reward, terminated, truncated)
    env.close()


def test_expert_medium_and_random_sets_are_one_command(tmp_path, capsys):
    command = ["dataset", "--suite", "smoke", "--episodes", "1", "--set", "horizon=3", "--out", str(tmp_path)]
    left = tmp_path / "bson" / "smoke" / ".other-v0.381def3a"  # by a run that was killed
    (left / "data").mkdir(parents=True)
    for name in ("main_data.hdf5", "metadata.json"):
        (left / "data" / name).touch()
    assert cli.main(command) == 0 and not left.exists()
    told = {}
    for level in ("expert", "medium", "random"):
        told[level] = dataset.load(str(tmp_path / "bson" / "smoke" / f"{level}-v0")).storage.metadata
        assert told[level]["total_steps"] == 3 and told[level]["command"].startswith("bson dataset --suite smoke")
    assert [one["algorithm_name"] for one in told.values()] == list(dataset.LEVELS.values())
    assert cli.main(command) == 2  # none is overwritten
    assert "is a dataset in" in capsys.readouterr().err


def test_bc_learns_the_same_from_a_dataset_as_from_our_own_demonstrations(tmp_path):
    imitation = pytest.importorskip("bson.learning.imitation", reason="needs the extra agents")
    from bson.episodes.session import Session
    from bson.episodes.tracks import make_track
    from bson.learning.train import TrainConfig, train

    config, track = TaskConfig().replace(**SETS), make_track("local", "lidar2d")
    session = Session(config, track, 1, seeds=[1_000_000])  # as BC's training of seed 0 makes its own
    seeds = [session.next_seeds([0])[0] for _ in range(4)]
    expert = load_agent("ppo")
    folder = tmp_path / "bson" / "own-v0"
    dataset.write(folder, "bson/own-v0", expert, "ppo", [Cell((), config)], ("local", "lidar2d"), seeds, {})
    own = imitation.demonstrate(expert, config, track, 30, 1_000_000, nworld=1)
    from_it = dataset.demonstrations(str(folder), config, 30)
    assert len(own) == len(from_it) == 3
    for (score, x, action), (its_score, its_x, its_action) in zip(own, from_it, strict=True):
        assert score == its_score and np.array_equal(x, its_x) and np.array_equal(action, its_action)
    small = {"hidden": (8,), "batch": 8, "epochs": 3}
    policies = []
    for name, more in (("own", {}), ("dataset", {"demonstrations": str(folder)})):
        hyperparameters = imitation.BcConfig(**small, **more)
        whole = TrainConfig("bc", 0, 30, SETS, 1, validate_episodes=1, hyperparameters=hyperparameters)
        policies.append(load_agent(str(train(whole, tmp_path / name) / "policy.npz"))())
    x = np.concatenate([x for _, x, _ in own])
    assert np.array_equal(policies[0].act(x), policies[1].act(x)) and policies[0].act(x).std() > 0
    recurrent = {"inputs": "gru", "overrides": SETS}
    for more in ({}, {"teacher": "goal"}):  # it has a teacher, and no demonstrations
        with pytest.raises(UsageError, match="--inputs gru learns with no BcConfig"):
            benchmark.train("bc", tmp_path / "runs", demonstrations=str(folder), **recurrent, **more)


def refused(capsys, *words):
    assert cli.main(list(words)) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    return line


def test_what_can_not_be_is_refused_before_anything_is_played(tmp_path, root, capsys, monkeypatch):
    new = ["--out", str(tmp_path / "new")]
    assert "version" in refused(capsys, "dataset", "--agent", "vfh", "--id", "a b", *new)
    assert "--agent" in refused(capsys, "dataset", "--id", "a-v0", *new)
    assert "no cell 'x'" in refused(capsys, "dataset", "--agent", "vfh", "--cell", "x", *new)
    assert "differ: name one by --cell" in refused(
        capsys, "dataset", "--agent", "orca-oracle", "--suite", "standard", "--episodes", "1", *new)  # fmt: skip
    assert "is a dataset in" in refused(
        capsys, "dataset", "--agent", "vfh", "--suite", "smoke", "--out", str(root), *WORDS)  # fmt: skip
    monkeypatch.setitem(sys.modules, "minari", None)
    assert "pip install 'bson-macid[data]'" in refused(capsys, "dataset", "--agent", "vfh", *new)
    assert not (tmp_path / "new").exists()


def test_an_agent_that_fails_leaves_no_dataset(tmp_path, capsys):
    (tmp_path / "late.py").write_text("def agent(observation):\n    return 1 / 0\n")
    agent = str(tmp_path / "late.py")
    assert "ZeroDivisionError" in refused(
        capsys, "dataset", "--agent", agent, "--suite", "smoke", "--episodes", "1", *WORDS, "--out", str(tmp_path / "d")
    )
    assert not (tmp_path / "d").exists()


def test_demonstrations_that_can_not_be_learned_from_are_told(tmp_path, root):
    with pytest.raises(UsageError, match="Can't read the dataset 'nothing-v0'"):
        dataset.load("nothing-v0")
    broken = tmp_path / "broken-v0" / "data"
    broken.mkdir(parents=True)
    (broken / "metadata.json").write_text("{")
    with pytest.raises(UsageError, match="Can't read the dataset"):
        dataset.load(str(broken.parent))
    benchmark.dataset(
        "stop", tmp_path, name="a-v0", suite="smoke", episodes=1, sensor="lidar3d", overrides={**SETS, "horizon": 1},
        quiet=True,
    )  # fmt: skip
    with pytest.raises(UsageError, match="its observations need goal, velocity"):
        dataset.demonstrations(str(tmp_path / "a-v0"), TaskConfig(), 10)
    pytest.importorskip("torch", reason="needs the extra agents")
    with pytest.raises(UsageError, match="not ppo"):
        benchmark.train("ppo", tmp_path / "runs", demonstrations=str(root))
