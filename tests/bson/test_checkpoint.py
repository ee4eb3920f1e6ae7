"""What lies in a training's folder may be damaged or somebody else's: it runs no code, and is told of in one line."""

import json
import pickle

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

from bson.learning import keeper as keeper_module
from bson.learning import train as train_module
from bson.learning.algorithms import PpoConfig, SacConfig, export
from bson.learning.train import TrainConfig, train
from macid import arrays
from macid.files import UsageError
from macid.learning.curves import plain

TASK = {"num_pedestrians": 1, "pedestrian_model": "standing", "map_size": 20.0, "goal_distance": (4.0, 8.0)}
TASK |= {"horizon": 20}


def config(algo):
    hyperparameters = {
        "ppo": PpoConfig(hidden=(8,), rollout=16, batch=16, epochs=1),
        "sac": SacConfig(hidden=(8,), learning_starts=16, batch=16, steps_per_update=4, buffer=200),
    }[algo]
    return TrainConfig(algo, steps=64, task=TASK, num_envs=2, validate_episodes=1, hyperparameters=hyperparameters)


@pytest.fixture(scope="module", params=["ppo", "sac"])
def begun(request, tmp_path_factory):
    """A training's configuration, its arrays and what was noted after 32 of 64 steps."""
    whole, folder = config(request.param), tmp_path_factory.mktemp("begun")
    keeper = keeper_module.BestKeeper(whole, folder)
    model = whole.hyperparameters.build(train_module._env(whole), 0).learn(32)
    layers, output = export(model)
    keeper.best = {"layers": layers, "output": output, "steps": 32, "validation": {"SNS": 3.0}}
    train_module._save_checkpoint(model, keeper)
    found, documents = arrays.unpack(folder / "checkpoint.npz", 10**8)
    return whole, found, documents["training"]


def place(out, whole, content):
    """The folder of a training in `out`, with a checkpoint of `content` (bytes)."""
    folder = out / f"{whole.name}-{whole.seed}"
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps(plain(whole)))
    (folder / "checkpoint.npz").write_bytes(content)
    return folder


def refused(whole, out, told):
    with pytest.raises(UsageError, match=told) as caught:
        train(whole, out, resume=True)
    assert "\n" not in str(caught.value) and "delete it to begin anew" in str(caught.value).lower()


class Bomb:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def test_no_pickle_is_ever_read(begun, tmp_path):
    whole, found, noted = begun
    bomb = pickle.dumps(Bomb(tmp_path / "ran"))
    folder = place(tmp_path, whole, bomb)
    refused(whole, tmp_path, "damaged")
    name = next(iter(found))
    evil = np.empty(1, object)
    evil[0] = Bomb(tmp_path / "ran")
    np.savez(folder / "checkpoint.npz", **{**found, name: evil})
    refused(whole, tmp_path, "no array of numbers")
    (folder / "checkpoint.npz").unlink()
    (folder / "checkpoint.pkl").write_bytes(bomb)
    refused(whole, tmp_path, "checkpoint.pkl' is of an earlier version")
    assert not (tmp_path / "ran").exists()
    assert b"PyObject" not in arrays.pack(found, {"training": noted})


def test_a_checkpoint_that_is_another_trainings_is_refused_before_anything_changes(begun, tmp_path):
    whole, found, noted = begun
    folder = place(tmp_path, whole, b"")
    some = next(name for name in found if name.startswith("policy/"))
    wrongs = [
        ({name: array for name, array in found.items() if name != some}, noted, "is missing"),
        ({**found, "more": np.zeros(3)}, noted, "nothing that it has"),
        ({**found, some: found[some][:-1]}, noted, "has float32"),
        ({**found, some: found[some].astype(float)}, noted, "has float64"),
        ({**found, "random/torch": found["random/torch"] * 0 + 255}, noted, "none of torch's"),
        ({**found, "best/bias0": found["best/bias0"] * np.nan}, noted, "bias0 holds nan"),
        (found, {**noted, "numpy": {**noted["numpy"], "pos": 10**6}}, "numpy.pos"),
        (found, {**noted, "steps": -1}, "steps"),
        (found, {**noted, "keeper": 3}, "keeper"),
        (
            found,
            {**noted, "keeper": {**noted["keeper"], "best": {"output": "clip", "steps": 1, "validation": {}}}},
            "no SNS",
        ),
        (found, {**noted, "rates": {}}, "other optimisers"),
        (found, {**noted, "replay": None if noted["replay"] else {"pos": 1, "full": False}}, "replay buffer"),
        (found, [noted], "training.json"),
    ]
    if noted["replay"]:
        wrongs.append((found, {**noted, "replay": {"pos": 10**9, "full": True}}, "1000000000 rows of 100"))
    for arrays_now, noted_now, told in wrongs:
        (folder / "checkpoint.npz").write_bytes(arrays.pack(arrays_now, {"training": noted_now}))
        refused(whole, tmp_path, told)
    assert {file.name for file in folder.iterdir()} == {"config.json", "checkpoint.npz"}


def test_a_damaged_file_is_named_with_what_to_do(begun, tmp_path):
    whole, found, noted = begun
    content = arrays.pack(found, {"training": noted})
    other = content.replace(b"NUMPY", b"NUMPX")
    for damaged in (b"", b"{}", content[: len(content) // 2], content[:-1], content[1000:], other):
        folder = place(tmp_path, whole, damaged)
        refused(whole, tmp_path, "checkpoint.npz' is damaged")
        for file in folder.iterdir():
            file.unlink()
        folder.rmdir()
    folder = place(tmp_path, whole, content)
    for wrong in ("", "[]", "{", '{"steps": NaN}', "[" * 3000, '{"a": 1, "a": 2}', b"\xff\xfe\xfd"):
        (folder / "config.json").write_bytes(wrong if isinstance(wrong, bytes) else wrong.encode())
        with pytest.raises(UsageError, match="config.json") as caught:
            train(whole, tmp_path, resume=True)
        assert "delete the folder, or use another --out" in str(caught.value) and "\n" not in str(caught.value)
    (folder / "config.json").write_text(json.dumps(plain(whole)))
    (folder / "policy.npz").write_bytes(b"")
    for wrong in ("", "[]", "{", "{}", '{"steps_done": "64"}', '{"steps_done": 1e999}', '{"steps_done": true}'):
        (folder / "policy.json").write_text(wrong)
        with pytest.raises(UsageError, match="policy.json': --resume writes it anew"):
            train(whole, tmp_path, resume=True)


def test_what_was_saved_goes_on(begun, tmp_path):
    whole, found, noted = begun
    folder = place(tmp_path, whole, arrays.pack(found, {"training": noted}))
    assert train(whole, tmp_path, resume=True) == folder
    assert json.loads((folder / "policy.json").read_text())["steps_done"] == 64
