import csv
import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from macid.learning import methods, ppo
from macid.learning.train import PRESETS, TrainConfig, Trainer, train
from macid.policy import FEATURES, load_policy

TINY = TrainConfig(
    level=1, nworld=2, rollout=10, episode=2, agent_steps=2_000, ppo=ppo.PpoConfig(batch=128, epochs=2)
)  # 500 agent-steps an iteration, four iterations


def same(first, second):
    return all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True))


def test_gae_by_hand():
    reward, value = jnp.array([[1.0], [2.0], [3.0]]), jnp.array([[0.5], [1.0], [1.5]])
    advantage, returns = ppo.gae(reward, value, jnp.array([2.0]), gamma=0.9, lam=0.8)
    delta = [1 + 0.9 * 1.0 - 0.5, 2 + 0.9 * 1.5 - 1.0, 3 + 0.9 * 2.0 - 1.5]
    last = delta[2]
    middle = delta[1] + 0.72 * last
    first = delta[0] + 0.72 * middle
    np.testing.assert_allclose(advantage[:, 0], [first, middle, last], rtol=1e-6)
    np.testing.assert_allclose(returns, advantage + value, rtol=1e-6)


def test_gae_with_lambda_one_is_the_discounted_return_less_the_value():
    rng = np.random.default_rng(0)
    reward, value, last = rng.normal(size=(20, 3)), rng.normal(size=(20, 3)), rng.normal(size=3)
    _, returns = ppo.gae(jnp.asarray(reward), jnp.asarray(value), jnp.asarray(last), gamma=0.99, lam=1.0)
    expected = last
    for step in reversed(range(20)):
        expected = reward[step] + 0.99 * expected
    np.testing.assert_allclose(returns[0], expected, rtol=1e-4)


def test_coordinated_advantage_is_eq_2_standardised():
    rng = np.random.default_rng(1)
    own, others, lcf = (jnp.asarray(rng.normal(size=500)) for _ in range(3))
    for coordination, expected in (
        (methods.linear, own + lcf * others),
        (methods.trigonometric, jnp.cos(lcf) * own + jnp.sin(lcf) * others),
    ):
        expected = (expected - expected.mean()) / expected.std()
        np.testing.assert_allclose(ppo.coordinated_advantage(own, others, lcf, coordination), expected, atol=1e-5)


def test_clipped_objective_is_eq_3():
    policy = {"layers": [(jnp.zeros((3, 2)), jnp.zeros(2))], "log_std": jnp.zeros(2)}
    x, action = jnp.zeros((4, 3)), jnp.zeros((4, 2))
    now = ppo.log_probability(policy, x, action)
    np.testing.assert_allclose(now, -np.log(2 * np.pi), rtol=1e-6)
    ratio, advantage = np.array([0.5, 0.5, 1.5, 1.5]), np.array([1.0, -1.0, 1.0, -1.0])
    objective = ppo.clipped_objective(policy, x, action, now - np.log(ratio), jnp.asarray(advantage), 0.2)
    assert objective == pytest.approx(np.mean([0.5, -0.8, 1.2, -1.5]))


def test_value_loss_is_eq_4_and_its_gradient_moves_the_value_towards_the_return():
    layers = [(jnp.zeros((2, 1)), jnp.array([1.0]))]
    x, target = jnp.ones((3, 2)), jnp.array([3.0, 3.0, 0.0])
    assert ppo.value_loss(layers, x, target) == pytest.approx((4 + 4 + 1) / 3)
    assert jax.grad(ppo.value_loss)(layers, x, target)[0][1][0] < 0


def test_each_networks_gradient_is_its_own_losss():
    key = jax.random.key(0)
    config = ppo.PpoConfig()
    parameters = ppo.init_parameters(key, config)
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.normal(size=(16, FEATURES + 1)), jnp.float32)
    batch = {
        "x": x, "critic": x, "action": jnp.asarray(rng.normal(size=(16, 2)), jnp.float32),
        "log_probability": jnp.zeros(16), "advantage": jnp.asarray(rng.normal(size=16), jnp.float32),
        "return_individual": jnp.ones(16), "return_neighborhood": -jnp.ones(16),
    }  # fmt: skip
    together = jax.grad(ppo.loss)(parameters, batch, config)
    alone = jax.grad(ppo.value_loss)(parameters["neighborhood"], x, batch["return_neighborhood"])
    for a, b in zip(jax.tree.leaves(together["neighborhood"]), jax.tree.leaves(alone), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_macid_with_the_lcf_at_zero_is_ipo_update_for_update(monkeypatch):
    zeroed = dataclasses.replace(methods.get_method("macid"), name="zeroed", lcf=(0.0, 0.0))
    monkeypatch.setitem(methods.METHODS, "zeroed", zeroed)
    parameters = []
    for name in ("ipo", "zeroed"):
        trainer = Trainer(dataclasses.replace(TINY, method=name))
        state = trainer.init()
        for _ in range(3):
            state, _ = trainer.iterate(state)
        parameters.append(state.parameters)
    assert same(*parameters)


@pytest.mark.parametrize("method", methods.METHODS)
def test_every_method_learns_from_its_own_signal(method):
    trainer = Trainer(dataclasses.replace(TINY, method=method))
    begin = trainer.init()
    end, log = trainer.iterate(begin)
    assert all(np.isfinite(value) for value in log.values())
    for network in begin.parameters:
        assert not same(begin.parameters[network], end.parameters[network])
    low, high = trainer.method.lcf
    assert (begin.walk.lcf >= low).all() and (begin.walk.lcf <= high).all()


def test_an_episode_keeps_its_lcfs_and_the_next_draws_new_ones():
    trainer = Trainer(TINY)
    states = [trainer.init()]
    for _ in range(2):
        states.append(trainer.iterate(states[-1])[0])
    assert np.array_equal(states[0].walk.lcf, states[1].walk.lcf)
    assert not np.array_equal(states[1].walk.lcf, states[2].walk.lcf)


def test_resuming_equals_not_stopping(tmp_path):
    quiet = {"show": lambda line: None}
    whole = train(TINY, tmp_path / "whole", **quiet)
    train(TINY, tmp_path / "parts", stop_after=2, **quiet)
    parts = train(TINY, tmp_path / "parts", resume=True, **quiet)
    assert same(whole.layers, parts.layers)
    rows = list(csv.DictReader((tmp_path / "parts" / "curve.csv").open()))
    assert [float(row["agent_steps"]) for row in rows] == [500, 1000, 1500, 2000]
    assert load_policy(str(tmp_path / "parts" / "policy.npz")).recipe["method"] == "macid"
    assert json.loads((tmp_path / "parts" / "config.json").read_text())["seed"] == 0
    with pytest.raises(ValueError, match="another configuration"):
        train(dataclasses.replace(TINY, seed=1), tmp_path / "parts", resume=True, **quiet)


def test_the_same_seed_trains_the_same_policy_and_another_seed_another():
    ends = []
    for seed in (0, 0, 1):
        trainer = Trainer(dataclasses.replace(TINY, seed=seed))
        ends.append(trainer.iterate(trainer.init())[0].parameters)
    assert same(ends[0], ends[1]) and not same(ends[0], ends[2])


def test_new_goals_are_free_and_at_a_fitting_distance():
    trainer = Trainer(TINY)
    position = trainer._starts[:2]
    goals = np.asarray(trainer._new_goals(jax.random.key(3), position))
    distance = np.linalg.norm(goals - np.asarray(position), axis=-1)
    assert ((distance >= 8) & (distance <= 24)).mean() > 0.95


def test_the_papers_preset_is_the_papers():
    paper = PRESETS["paper"]
    assert (paper.learning_rate, paper.clip, paper.gamma, paper.lam) == (1e-3, 0.2, 0.999, 0.95)
    assert (paper.batch, paper.epochs) == (2048, 5)
    assert (PRESETS["paper-ppo"].batch, PRESETS["paper-ppo"].epochs) == (128, 10)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"method": "mappo"}, "ipo, mfpo, copo, macid, macid-tri"),
        ({"period": 0.03}, "multiple"),
        ({"nworld": 0}, "at least 1"),
    ],
)
def test_a_wrong_setting_is_told(changes, told):
    with pytest.raises(ValueError, match=told):
        dataclasses.replace(TINY, **changes)
