import csv
import dataclasses
import importlib.util
import json
import os
import pickle
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from macid.files import UsageError
from macid.layout import clearance, load_level
from macid.learning import curves, methods, ppo
from macid.learning import train as train_module
from macid.learning.config import PRESETS, TrainConfig, preset
from macid.learning.curves import completed, plain
from macid.learning.train import train
from macid.learning.trainer import Trainer
from macid.observation import SIZE
from macid.policy import FEATURES, load_policy, mlp, to_velocity
from macid.state import RADIUS

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


def test_gae_credits_no_one_with_a_redrawn_state():
    reward, value = jnp.array([[1.0, 4.0], [2.0, 5.0], [3.0, 6.0]]), jnp.array([[0.5, 0.1], [1.0, 0.2], [1.5, 0.3]])
    redrawn = jnp.array([[False, True], [True, False], [False, False]])
    advantage, returns = ppo.gae(reward, value, jnp.array([2.0, 0.4]), gamma=0.9, lam=0.8, redrawn=redrawn)
    typical = (0.2 + 1.5) / 2  # of the values after the two redrawn steps
    second = 2 + 0.9 * typical - 1.0
    np.testing.assert_allclose(advantage[:2, 0], [1 + 0.9 * 1.0 - 0.5 + 0.72 * second, second], rtol=1e-6)
    np.testing.assert_allclose(advantage[0, 1], 4 + 0.9 * typical - 0.1, rtol=1e-6)
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
        plain = ppo.coordinated_advantage(own, others, lcf, coordination, False)
        np.testing.assert_allclose(plain, expected, atol=1e-6)
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
    zeroed = dataclasses.replace(methods.get_method("macid"), name="zeroed", lcf=(-0.0, 1e-30))  # both values learn
    monkeypatch.setitem(methods.METHODS, "zeroed", zeroed)
    parameters = []
    for name in ("ipo", "zeroed"):
        trainer = Trainer(dataclasses.replace(TINY, method=name))
        state = trainer.init()
        for _ in range(3):
            state, _ = trainer.iterate(state)
        parameters.append(state.parameters)
    assert "neighborhood" in parameters[1] and "neighborhood" not in parameters[0]
    for network in ("policy", "individual"):
        for a, b in zip(*(jax.tree.leaves(each[network]) for each in parameters), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-6)


def test_what_a_touch_costs_by_lcf():
    weights = TINY.reward
    lcf = jnp.asarray([-2.0, -1.0, 0.0, 1.0, 2.0])
    own, others = methods.considerate(lcf)
    two = methods.cost_of_touch(jnp.full(5, 7.0), None, jnp.full(5, 2), weights)  # one's progress is not the others'
    np.testing.assert_allclose(two, -1.2, rtol=1e-6)
    one = own * -weights.collision + others * two / 2
    price = weights.collision * np.array([0.0, 0.5, 1.0, 1.0 + methods.CARE, 1.0 + 2 * methods.CARE])
    np.testing.assert_allclose(one, -price, atol=1e-6)


def test_who_touches_somebody_pays_for_them_and_for_nobody_else():
    trainer = Trainer(dataclasses.replace(TINY, method="macid-touch", period=0.04))
    state = trainer.init()
    crowd = trainer.engine.read(state.walk.physics)
    position = np.array(crowd.position)
    position[:, 1] = position[:, 0] + [2 * RADIUS, 0.0]  # 0 and 1 of each world side by side
    together = trainer.engine.init(jnp.asarray(position), crowd.yaw)
    _, steps, _ = trainer._rollout(state.parameters, state.walk._replace(physics=together), jax.random.key(2))
    first = np.asarray(steps["neighborhood"])[0]
    np.testing.assert_allclose(first[:, :2], -TINY.reward.collision, rtol=1e-6)
    np.testing.assert_array_equal(first[:, 2:], 0.0)


@pytest.mark.parametrize("method", methods.LEVEL_METHODS)
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


def test_the_progress_tells_of_whole_episodes():
    trainer = Trainer(TINY)
    state = trainer.init()
    contact, reached = np.zeros((2, *state.walk.lcf.shape), np.int32)
    contact[0], reached[:, :5] = 12, 1  # before they set out: half of them collided, five of each crowd arrived
    state = state._replace(walk=state.walk._replace(contact=jnp.asarray(contact), reached=jnp.asarray(reached)))
    for number in range(3):  # two make an episode; what the third has so far is not told
        state, log = trainer.iterate(state)
        told = [float(log[name]) for name in ("SR10", "CP", "arrived", "goals")]
        assert told == pytest.approx([10.0, 6.0, 20.0, 0.2])
        assert bool(state.walk.contact.any()) == (number == 0)


def test_a_reward_for_everybody_at_all_times_does_not_count_as_global():
    trainer = Trainer(dataclasses.replace(TINY, method="copo"))  # with gamma 1 its value would grow for ever
    state = trainer.init()
    _, steps, last = trainer._rollout(state.parameters, state.walk, jax.random.key(5))
    before = trainer._estimates(state.parameters, steps, last)
    richer = {**steps, "global": steps["global"] + 3.0, "individual": steps["individual"] + 3.0}
    after = trainer._estimates(state.parameters, richer, last)
    np.testing.assert_allclose(after["global"][0], before["global"][0], atol=1e-4)
    assert (after["individual"][0] > before["individual"][0] + 0.2).all()


def test_who_is_alone_has_a_mean_field_of_zeros():
    trainer = Trainer(dataclasses.replace(TINY, method="mfpo"))
    seen, x = jnp.ones((1, 3, FEATURES)), jnp.ones((1, 3, FEATURES + 1))
    position = jnp.asarray([[[0.0, 0.0], [1.0, 0.0], [40.0, 0.0]]])
    action = jnp.asarray([[[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]])
    critic = trainer._critic_input(x, seen, action, position)
    np.testing.assert_array_equal(critic[..., : FEATURES + 1], x)
    np.testing.assert_array_equal(
        critic[0, 0, FEATURES + 1 :], [*np.ones(FEATURES), 3.0, 4.0]
    )  # the other's, not one's own
    np.testing.assert_array_equal(critic[0, 2, FEATURES + 1 :], np.zeros(FEATURES + 2))


def logged(folder):
    """{tag: [(step, value), ...]} of what TensorBoard reads in a training's folder."""
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = accumulator.EventAccumulator(str(folder / "tensorboard")).Reload()
    return {tag: [(one.step, one.value) for one in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def test_resuming_after_ctrl_c_equals_not_stopping(tmp_path, monkeypatch):
    quiet = {"show": lambda line: None}
    whole = train(TINY, tmp_path / "whole", seeds=2, **quiet)
    arrived, fetch = [], jax.device_get

    def interrupted(logs):
        arrived.append(logs)
        if len(arrived) == 3:
            raise KeyboardInterrupt
        return fetch(logs)

    log = importlib.util.find_spec("tensorboard") is not None
    with monkeypatch.context() as patch:
        patch.setattr(jax, "device_get", interrupted)
        with pytest.raises(KeyboardInterrupt):
            train(TINY, tmp_path / "parts", seeds=2, tensorboard=log, **quiet)
    assert not (tmp_path / "parts" / f"{TINY.name}-0" / "policy.npz").exists()
    for seed in (0, 1) if log else ():  # a row that a killed run logged after its checkpoint
        with curves.Board(tmp_path / "parts" / f"{TINY.name}-{seed}", done=10**6) as board:
            board.write({"agent_steps": 1500, "reward": 1e6})
    parts = train(TINY, tmp_path / "parts", seeds=2, resume=True, tensorboard=log, **quiet)
    assert [same(a.layers, b.layers) for a, b in zip(whole, parts, strict=True)] == [True, True]
    assert not same(whole[0].layers, whole[1].layers)
    for seed in (0, 1):
        folder = tmp_path / "parts" / f"{TINY.name}-{seed}"
        rows = list(csv.DictReader((folder / "curve.csv").open()))
        assert [float(row["agent_steps"]) for row in rows] == [500, 1000, 1500, 2000]
        found = logged(folder) if log else {}
        assert found.keys() == (rows[0].keys() - {"agent_steps"} if log else set())
        for tag, series in found.items():
            expected = [float(row[tag]) for row in rows]
            assert [step for step, _ in series] == [500, 1000, 1500, 2000]
            assert [value for _, value in series] == pytest.approx(expected, rel=1e-5, abs=1e-9)
        policy = load_policy(str(folder / "policy.npz"))
        assert policy.recipe["method"] == "macid" and policy.recipe["seed"] == seed
        assert same(policy.layers, whole[seed].layers)
        assert json.loads((folder / "config.json").read_text())["seed"] == seed
    with pytest.raises(ValueError, match="already"):
        train(TINY, tmp_path / "parts", seeds=2, **quiet)
    with pytest.raises(ValueError, match="of 2 seeds, not 1"):
        train(TINY, tmp_path / "parts", seeds=1, resume=True, **quiet)


@pytest.mark.parametrize("method", ["macid", "copo"])
def test_seeds_at_once_are_the_seeds_alone(method):
    trainer = Trainer(dataclasses.replace(TINY, method=method))
    together = trainer.init_seeds([3, 4])
    alone = [trainer.init(3), trainer.init(4)]
    for _ in range(2):  # the second iteration ends the episode
        together, _ = trainer.iterate_seeds(together)
        alone = [trainer.iterate(state)[0] for state in alone]
    for index, state in enumerate(alone):
        one = trainer.seed_state(together, index)
        for a, b in zip(jax.tree.leaves(one.parameters), jax.tree.leaves(state.parameters), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-4)
        np.testing.assert_allclose(one.walk.lcf, state.walk.lcf, atol=1e-6)


def test_the_same_seed_trains_the_same_policy_and_another_seed_another():
    ends = []
    for seed in (0, 0, 1):
        trainer = Trainer(dataclasses.replace(TINY, seed=seed))
        ends.append(trainer.iterate(trainer.init())[0].parameters)
    assert same(ends[0], ends[1]) and not same(ends[0], ends[2])


def test_new_goals_are_free_and_at_a_fitting_distance():
    trainer = Trainer(TINY)
    layout = load_level(TINY.level)
    position = np.random.default_rng(3).uniform(-24.6, 24.6, (200, 25, 2)).astype(np.float32)
    goals = np.asarray(trainer._new_goals(jax.random.key(3), jnp.asarray(position)))
    distance = np.linalg.norm(goals - position, axis=-1)
    assert ((distance >= 8) & (distance <= 24)).all()
    assert (clearance(goals, layout.boxes) > RADIUS).all()
    assert distance.min() < 9.5 and distance.max() > 22.5


def test_the_papers_preset_is_the_papers():
    """Secs. III-C and IV-C: constant rate, T = 1000 and an update after each of M = 1000 episodes, Lv.2; nothing is
    scaled, clipped (but for eq. 3's ratio) or standardised."""
    paper = preset("paper")
    given = paper.ppo
    assert (given.learning_rate, given.final_learning_rate, given.clip, given.gamma, given.lam) == (
        1e-3, 1e-3, 0.2, 0.999, 0.95,
    )  # fmt: skip
    assert (given.batch, given.epochs, given.targets) == (2048, 5, "episode")
    assert (given.max_gradient_norm, given.reward_scale, given.standardize, given.arrival) == (None, 1.0, False, "end")
    assert (paper.level, paper.nworld, paper.rollout, paper.episode, paper.inputs) == (2, 1, 1000, 1, "observation")
    assert paper.agent_steps == 1000 * 1000 * load_level(2).pedestrians
    assert (paper.reward.distance, paper.reward.goal, paper.reward.collision) == (10.0, 1.0, 0.6)
    assert preset("paper", method="ipo").name == "ipo-paper" and preset("fast").name == "macid"
    assert (preset("paper-ppo").ppo.batch, preset("paper-ppo").ppo.epochs) == (128, 10)
    assert (preset("paper-batch").ppo.batch, preset("paper-batch").ppo.epochs) == (2048, 5)
    assert preset("paper-batch", method="ipo").name == "ipo-paper-batch"
    with pytest.raises(ValueError, match="fast, gpu, paper, paper-batch, paper-ppo"):
        preset("papers")


def test_eq_4s_targets_by_hand():
    reward = jnp.array([[1.0, 0.0], [2.0, 0.0], [4.0, 8.0]])
    expected = [[1 + 0.5 * (2 + 0.5 * 4), 2.0], [2 + 0.5 * 4, 4.0], [4.0, 8.0]]
    np.testing.assert_allclose(ppo.discounted_returns(reward, 0.5), expected, rtol=1e-6)


def test_the_papers_estimates_are_of_one_episode_that_ends():
    """Values learn the whole return, to the goal or to T, the neighbourhood's to T; nothing follows in GAE either."""
    small = preset("paper", level=1, rollout=10, agent_steps=250)
    trainer = Trainer(small)
    state = trainer.init()
    _, steps, last = trainer._rollout(state.parameters, state.walk, state.key)
    steps["arrived"] = jnp.zeros_like(steps["arrived"]).at[4, 0, 3].set(True)
    ended = np.asarray(steps["arrived"])
    for name in ("individual", "neighborhood"):
        advantage, returns = trainer._estimates(state.parameters, steps, last)[name]
        expected = np.zeros_like(steps[name][0])
        for now in reversed(range(10)):
            following = np.where(ended[now], 0.0, expected) if name == "individual" else expected
            expected = np.asarray(steps[name][now]) + 0.999 * following
            np.testing.assert_allclose(returns[now], expected, rtol=1e-4, atol=1e-4)
        left = steps[name] - mlp(state.parameters[name], steps["critic"])[..., 0]
        np.testing.assert_allclose(advantage[-1], left[-1], rtol=1e-4, atol=1e-4)
        at_the_goal = np.allclose(advantage[4, 0, 3], left[4, 0, 3], rtol=1e-4, atol=1e-4)
        assert at_the_goal == (name == "individual")
    with pytest.raises(ValueError, match="whole episodes"):
        preset("paper", episode=2)


def test_a_network_may_see_the_41_numbers_as_they_are(tmp_path):
    small = preset("paper", method="macid", level=1, rollout=20, agent_steps=500)
    (trained,) = train(small, tmp_path, show=lambda line: None)
    loaded = load_policy(str(tmp_path / "macid-paper-0" / "policy.npz"))
    weight, bias = loaded.layers[0]
    assert weight.shape[0] == SIZE + 1 and loaded.recipe["inputs"] == "observation"
    seen = np.random.default_rng(0).normal(size=(5, SIZE)).astype(np.float32)
    seen[:, 5::3] = np.abs(seen[:, 5::3])
    hidden = np.tanh(np.concatenate([seen, np.full((5, 1), 0.5, np.float32)], axis=-1) @ weight + bias)
    np.testing.assert_allclose(loaded(seen, 1.0), to_velocity(mlp(loaded.layers[1:], hidden)), atol=1e-6)
    np.testing.assert_array_equal(loaded(seen, 1.0), trained(seen, 1.0))
    if importlib.util.find_spec("torch"):
        assert loaded.to_torch()(seen, 1.0).detach().numpy() == pytest.approx(loaded(seen, 1.0), abs=1e-5)


def test_a_recipe_of_before_a_field_came_has_its_default():
    old = plain(TINY)
    del old["inputs"], old["ppo"]["targets"]
    assert completed(old, preset("paper")) == plain(TINY)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"method": "mappo"}, "ipo, mfpo, copo, macid, macid-tri, macid-touch"),
        ({"period": 0.03}, "multiple"),
        ({"nworld": 0}, "at least 1"),
    ],
)
def test_a_wrong_setting_is_told(changes, told):
    with pytest.raises(ValueError, match=told):
        dataclasses.replace(TINY, **changes)


_ON_TWO_DEVICES = """
import dataclasses, sys
import jax, numpy as np
from macid.learning import ppo
from macid.learning.config import TrainConfig
from macid.learning.trainer import Trainer

config = TrainConfig(engine="mjx", level=1, nworld=2, rollout=3, ppo=ppo.PpoConfig(batch=75, epochs=1))
assert jax.device_count() == 2
one, two = Trainer(config), Trainer(config, jax.devices())
for seeds in ([5], [5, 6]):
    ends = []
    for trainer in (one, two):
        states, _ = trainer.iterate_seeds(trainer.init_seeds(seeds))
        ends.append(states)
    for leaf in jax.tree.leaves(ends[1].walk):
        if not leaf.size:
            continue
        assert len(leaf.sharding.device_set) == 2 and not leaf.sharding.is_fully_replicated, (leaf.shape, leaf.sharding)
    parameters = jax.tree.leaves(ends[1].parameters)
    assert all(leaf.sharding.is_fully_replicated == (len(seeds) == 1) for leaf in parameters)
    for a, b in zip(jax.tree.leaves(ends[0].parameters), parameters, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)
try:
    Trainer(dataclasses.replace(config, nworld=3), jax.devices()).init_seeds([0])
except ValueError as error:
    assert "divide" in str(error)
else:
    sys.exit("3 worlds on 2 devices were taken")
"""


@pytest.mark.slow
def test_two_devices_train_what_one_does():
    environment = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu"}
    ran = subprocess.run([sys.executable, "-c", _ON_TWO_DEVICES], env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr


@pytest.mark.slow
def test_both_engines_train_to_the_same_curve():
    config = TrainConfig(level=1, nworld=4, agent_steps=400_000, ppo=PRESETS["fast"]["ppo"])
    curves = {}
    for engine in ("native", "mjx"):
        trainer = Trainer(dataclasses.replace(config, engine=engine))
        states, curve = trainer.init_seeds([0, 1, 2]), []
        for _ in range(trainer.iterations):
            states, log = trainer.iterate_seeds(states)
            curve.append(log["reward"])
        curves[engine] = np.array(curve)  # (iterations, seeds)
    native, mjx = curves["native"], curves["mjx"]
    assert native[-4:].mean() > native[:4].mean()  # it learns
    noise = np.maximum(native.std(axis=1), 0.02)
    assert (np.abs(native.mean(axis=1) - mjx.mean(axis=1)) < 4 * noise).all()


class Bomb:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def test_a_damaged_training_is_told_and_no_pickle_is_read(tmp_path):
    quiet = {"show": lambda line: None, "resume": True}
    folder = tmp_path / f"{TINY.name}-0"
    trainer = Trainer(dataclasses.replace(TINY, method="copo"))
    states, begin = trainer.init_seeds([1]), trainer.init_seeds([0])
    states = states._replace(iteration=states.iteration + 1)
    curve = [{"agent_steps": 500, "reward": 0.1}]
    config = dataclasses.replace(TINY, method="copo")
    noted = {"configs": [curves.plain(config)], "curves": [curve], "seconds": 1.5}
    named = train_module._named(states)
    curves.write_checkpoint(tmp_path, named, noted)

    def restored():
        saved = curves.read_checkpoint(tmp_path, train_module._Noted)
        return train_module._restored(*saved, tmp_path / curves.CHECKPOINT, [config], begin)

    read, curve_read, seconds = restored()
    assert same(*(jax.tree.map(train_module._keep, each) for each in (states, read)))
    assert (curve_read, seconds) == ([curve], 1.5)
    assert jax.tree.structure(read) == jax.tree.structure(states)
    some = next(name for name in named if "policy" in name)
    for arrays_now, noted_now, told in (
        ({**named, some: named[some][..., :-1]}, noted, "has float32"),
        ({name: each for name, each in named.items() if name != some}, noted, "is missing"),
        (named, {**noted, "curves": [curve * 2]}, "not as long as the training"),
        (named, {**noted, "curves": [[{"reward": "high"}]]}, "curves"),
        (named, {**noted, "seconds": None}, "seconds"),
    ):
        curves.write_checkpoint(tmp_path, arrays_now, noted_now)
        with pytest.raises(UsageError, match=f"checkpoint.npz' is damaged .*{told}.*: delete it to begin anew"):
            restored()
    folder.mkdir()
    bomb = pickle.dumps(Bomb(tmp_path / "ran"))
    for name, content, told in (
        ("checkpoint.npz", bomb, "checkpoint.npz' is damaged .*: delete it"),
        ("checkpoint.npz", b"", "checkpoint.npz' is damaged .*: delete it"),
        ("checkpoint.pkl", bomb, "checkpoint.pkl' is of an earlier version .* Delete it"),
        ("config.json", b"", "config.json.*delete the folder, or use another --out"),
    ):
        for file in folder.iterdir():
            file.unlink()
        (folder / "checkpoint.npz").write_bytes(content)
        (folder / "checkpoint.npz").rename(folder / name)
        if name == "config.json":
            (folder / "policy.json").write_bytes(b"{}")
        with pytest.raises(UsageError, match=told) as caught:
            train(TINY, tmp_path, **quiet)
        assert "\n" not in str(caught.value)
    assert not (tmp_path / "ran").exists()


@pytest.mark.slow
def test_a_training_that_diverges_is_told(tmp_path):
    config = dataclasses.replace(TINY, ppo=dataclasses.replace(TINY.ppo, learning_rate=1e38))
    with pytest.raises(FloatingPointError, match="diverged at iteration [12]: the .* is (nan|inf)"):
        train(config, tmp_path, show=lambda line: None)
    assert not list(tmp_path.glob("*/policy.npz"))


def test_a_log_that_begins_late_has_the_whole_curve(tmp_path):
    pytest.importorskip("tensorboard")
    rows = [{"steps": step, "score": step / 8} for step in (10, 20, 30, 40)]
    for count in (2, 3):
        with curves.Board(tmp_path, rows[:count]) as board:
            board.write(rows[count])
    assert logged(tmp_path) == {"score": [(row["steps"], row["score"]) for row in rows]}


@pytest.mark.parametrize("package", ["macid", "bson"])
def test_without_tensorboard_one_line_says_what_to_install(tmp_path, package):
    code = f"import sys; sys.modules['tensorboard'] = None; from {package} import cli; sys.exit(cli.main(sys.argv[1:]))"
    words = ["train", "--tensorboard", "--out", str(tmp_path / "runs")]
    told = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, timeout=120)
    assert told.returncode == 2
    wanted = "--tensorboard needs tensorboard: pip install 'bson-macid[tensorboard]'."
    assert told.stderr.splitlines() == [f"{package}: error: {wanted}"]
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_people_learn_in_scenes_and_are_read_as_they_were_written(tmp_path):
    short = preset("human", method="macid-human", agent_steps=3 * 5 * 406)
    (whole,) = train(short, tmp_path / "whole", show=lambda line: None)
    assert short.name == "macid-human"
    read = load_policy(str(tmp_path / "whole" / "macid-human-0" / "policy.npz"))
    assert read.recipe["radius"] == 0.2 and read.recipe["preferred_speed"] == "human"
    for layers, others in zip(whole.network.values(), read.network.values(), strict=True):
        for (weight, bias), (weight_read, bias_read) in zip(layers, others, strict=True):
            assert (weight == weight_read).all() and (bias == bias_read).all()
    with pytest.raises(ValueError, match="needs the preset 'human'"):
        preset("fast", method="macid-human")
    with pytest.raises(ValueError, match="another preset"):
        preset("human", method="macid")
