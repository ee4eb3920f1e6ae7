"""PPO of robots with a memory: pieces of episodes, their networks, and the training in native worlds."""

import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_draws import DRAW

from bson import recurrent
from bson.agents import learned, load_agent
from bson.learning import pieces
from bson.learning.pieces import Gru, Learner, Mlp, Pieces
from macid.learning import ppo

NETWORKS = [Gru("none"), Gru("people"), Gru("picture"), Mlp(5, (8,))]


def inputs_of(network):
    return network.inputs if isinstance(network, Mlp) else recurrent.size(network.eye)


@functools.cache
def driven(network, steps=12, worlds=3, seed=0):
    """What was noted of a rollout (T, N, ...) with random inputs, in which episodes begin; parameters; the value of
    what follows."""
    rng, key = np.random.default_rng(seed), jax.random.key(seed)
    key, *first = jax.random.split(key, 3)
    parameters = pieces.init(first, network, -0.7)
    big = jax.tree.map(lambda x: np.asarray(x) + np.float32(0.02) * rng.normal(size=x.shape).astype("f"), parameters)
    big = jax.tree.map(jnp.asarray, big)
    before, rows = pieces.memories(network, worlds), []
    act = jax.jit(functools.partial(pieces.act, network))
    for now in range(steps):
        x = jnp.asarray(rng.normal(size=(worlds, inputs_of(network))), jnp.float32)
        began = jnp.asarray(rng.random(worlds) < (1.0 if now == 0 else 0.2))
        noted, before = act(big, x, began, before, jax.random.fold_in(key, now))
        ends = jnp.asarray(rng.random(worlds) < 0.2)
        rows.append(noted | {"reward": jnp.asarray(rng.normal(size=worlds), jnp.float32), "ends": ends})
    data = jax.tree.map(lambda *each: jnp.stack(each), *rows)
    return big, data, jnp.zeros(worlds)


def cut(data, piece, name):
    found = pieces.cut(data, piece)
    return Pieces(found["x"], found["began"], found["memories"][name][:, 0]), found


@pytest.mark.parametrize("network", NETWORKS)
def test_under_the_same_parameters_the_ratio_is_one_and_the_value_as_it_was(network):
    parameters, data, _ = driven(network)
    x, found = cut(data, 4, "policy")
    log = jax.jit(functools.partial(ppo.log_probability, network=network))(parameters["policy"], x, found["action"])
    np.testing.assert_allclose(np.exp(log - found["log_probability"]), 1.0, atol=2e-5)
    x, found = cut(data, 4, "value")
    np.testing.assert_allclose(jax.jit(network)(parameters["value"], x)[..., 0], found["value"], atol=2e-5)


@pytest.mark.parametrize("network", NETWORKS[:1])
def test_nothing_is_remembered_across_the_beginning_of_an_episode(network):
    parameters, data, _ = driven(network)
    (x, began, state), layers = cut(data, 12, "policy")[0], parameters["policy"]["layers"]
    began = jnp.zeros_like(began).at[:, 5].set(True)
    before, after = (
        network(layers, Pieces(x, began, state)),
        network(layers, Pieces(x.at[:, :5].add(1.0), began, state)),
    )
    assert not np.allclose(before[:, :5], after[:, :5], atol=1e-4)
    np.testing.assert_array_equal(before[:, 5:], after[:, 5:])
    alone = network(layers, Pieces(x[:, 5:], began[:, 5:], state + 1.0))
    np.testing.assert_allclose(alone, before[:, 5:], atol=1e-6)


@pytest.mark.parametrize("inputs", ["gru", "gru-scans"])
def test_the_policy_in_numpy_acts_as_the_learner_does(inputs):
    kind = learned.KINDS[inputs]
    network = Gru(kind.eye)
    parameters, data, _ = driven(network)
    parts = {
        name: [(np.asarray(weight), np.asarray(bias)) for weight, bias in part]
        for name, part in parameters["policy"]["layers"].items()
    }
    state = np.zeros((3, recurrent.UNITS), np.float32)
    wanted = np.asarray(network(parameters["policy"]["layers"], cut(data, 12, "policy")[0]))  # (worlds, steps, 2)
    for now, (x, began) in enumerate(zip(np.asarray(data["x"]), np.asarray(data["began"]), strict=True)):
        action, state = recurrent.step(parts, *recurrent.parted(kind.eye, x), np.where(began[:, None], 0, state))
        np.testing.assert_allclose(action, wanted[:, now], atol=1e-5)


def test_pieces_are_stretches_of_one_world_each():
    whole = jnp.arange(24).reshape(6, 4)  # 6 steps of 4 worlds
    found = pieces.cut(whole, 3)
    assert found.shape == (8, 3)
    assert {tuple(map(int, row)) for row in found} == {
        tuple(int(whole[begin + now, world]) for now in range(3)) for begin in (0, 3) for world in range(4)
    }


def test_while_the_value_warms_up_the_policy_stays():
    network = Gru("none")
    parameters, data, last = driven(network)
    config = ppo.PpoConfig(batch=2, epochs=2)
    optimizer = ppo.make_optimizer(config, 100, ("policy", "value"))
    learner = Learner(parameters, optimizer.init(parameters), jax.random.key_data(jax.random.key(0)), jnp.int32(0))

    @jax.jit
    def update(learner):
        return pieces.update(learner, data, last, jax.random.key(1), network, optimizer, config, 4, warmup=1)[0]

    after = update(learner)
    assert int(after.done) == 1
    same = jax.tree.map(lambda x, y: bool((x == y).all()), parameters, after.parameters)
    assert all(jax.tree.leaves(same["policy"])) and not any(jax.tree.leaves(same["value"][recurrent.HEAD]))
    later = update(after)
    moved = jax.tree.map(lambda x, y: bool((x != y).any()), parameters, later.parameters)
    assert all(jax.tree.leaves(moved["policy"]["layers"][recurrent.HEAD]))


# --- in native worlds


def training(tmp_path, people=0, steps=96, inputs="gru", start=None, **chosen):
    from bson.learning.recurrent_ppo import RecurrentPpoConfig
    from bson.learning.train import TrainConfig

    (tmp_path / "mine.toml").write_text(DRAW.format(people=people))
    chosen = RecurrentPpoConfig(**{"rollout": 8, "piece": 4, "batch": 4, "epochs": 1, "leg": 1, **chosen})
    return TrainConfig("ppo", 0, steps, {}, 4, 64, 1, chosen, inputs, str(tmp_path / "mine.toml"), start)


def arrays_of(folder):
    from bson.learning.recurrent_ppo import Noted
    from macid.learning.curves import read_checkpoint

    found = read_checkpoint(folder, Noted)
    assert found
    return found


@pytest.mark.parametrize("inputs", ["gru", "gru-scans"])
def test_an_interrupted_training_ends_as_an_uninterrupted_one(inputs, tmp_path, monkeypatch):
    from bson.learning.recurrent_ppo import RecurrentPpo
    from bson.learning.train import is_done, train

    config, start = training(tmp_path, 2, inputs=inputs, leg=2), None
    if inputs == "gru-scans":  # from the first one's policy, then
        start = str(train(config, tmp_path / "start") / "policy.npz")
        config = dataclasses.replace(config, start=start)
    whole = train(config, tmp_path / "whole")
    assert whole.name == f"ppo-{inputs}-mine{'-from-policy' if start else ''}-0" and is_done(config, whole)

    once, count = RecurrentPpo.update, []

    def stopped(self):
        if len(count) == 2:
            raise KeyboardInterrupt
        count.append(1)
        return once(self)

    monkeypatch.setattr(RecurrentPpo, "update", stopped)
    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path / "parts")
    monkeypatch.undo()
    parts = train(config, tmp_path / "parts", resume=True)
    (one, first), (other, second) = arrays_of(whole), arrays_of(parts)
    assert first["updates"] == second["updates"] == 3
    assert first["keeper"]["validations"] == second["keeper"]["validations"]
    assert one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)
    recipe = json.loads((parts / "policy.json").read_text())
    assert recipe["inputs"] == inputs and recipe["validations"] and recipe.get("start") == start
    factory = load_agent(str(parts / "policy.npz"))
    assert factory.track == "local" and factory.kind is learned.KINDS[inputs]


def test_a_training_begins_with_the_policy_that_it_is_given(tmp_path):
    from bson.learning.train import train
    from macid.files import UsageError

    with pytest.raises(UsageError, match="--start gru: its inputs are gru, its output is clip; .* --inputs gru-map"):
        train(training(tmp_path, inputs="gru-map", start="gru"), tmp_path)
    with pytest.raises(UsageError, match="--start tac: its inputs are scans"):
        train(training(tmp_path, start="tac"), tmp_path)
    with pytest.raises(UsageError, match="control_period"):
        train(dataclasses.replace(training(tmp_path, start="gru"), task={"control_period": 0.2}), tmp_path)
    assert not list(tmp_path.glob("ppo*"))
    folder = train(training(tmp_path, start="gru", warmup=99), tmp_path)
    ours, theirs = (learned.load(name)().network for name in (str(folder / "policy.npz"), "gru"))
    same = jax.tree.map(np.array_equal, ours, {name: list(part) for name, part in theirs.items()})
    assert all(jax.tree.leaves(same))


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (
            {"algo": "bc", "start": "gru"},
            "--start is for bc, ppo, sac, tac with --inputs of gru, .* not bc on scans",
        ),
        ({"start": "gru"}, "not ppo on scans"),
    ],
)
def test_what_does_not_fit_is_refused(arguments, told):
    from bson.learning.train import TrainConfig
    from macid.files import UsageError

    with pytest.raises(UsageError, match=told):
        TrainConfig(**arguments)


@pytest.mark.slow
def test_the_return_rises(tmp_path):
    from bson.learning.train import train

    chosen = {"rollout": 128, "piece": 16, "epochs": 6, "leg": 20, "learning_rate": 3e-3, "batch": 16}
    config = training(tmp_path, 0, 20 * 128 * 8, "gru-scans", **chosen)
    config = dataclasses.replace(config, num_envs=8, validate_every=10**6)
    rows = []

    def show(steps, figures, validation=False):
        if figures and not validation:
            rows.append(figures["r"])

    train(config, tmp_path, show=show)
    assert rows[-1] > rows[0] + 1.0
