"""Training robots: against hand-computed cases, and against stable-baselines3's own SAC."""

import dataclasses
import json
import os

import gymnasium
import numpy as np
import pytest

from bson.agents import Setting, learned
from bson.episodes.tracks import make_track
from bson.features import FEATURES, Features
from bson.interfaces.gym import BsonEnv
from bson.learning import keeper as keeper_module
from bson.task import TaskConfig
from macid.files import UsageError, lock_folder
from macid.policy import write_network

torch = pytest.importorskip("torch")
stable_baselines3 = pytest.importorskip("stable_baselines3")
train_module = pytest.importorskip("bson.learning.train")
presets = pytest.importorskip("bson.learning.presets")
algorithms = pytest.importorskip("bson.learning.algorithms")
imitation = pytest.importorskip("bson.learning.imitation")
PpoConfig, SacConfig, export = algorithms.PpoConfig, algorithms.SacConfig, algorithms.export
BcConfig, clone, select = imitation.BcConfig, imitation.clone, imitation.select
PRESETS, TrainConfig = presets.PRESETS, train_module.TrainConfig
one_thread, train = train_module.one_thread, train_module.train
log_q = pytest.importorskip("bson.learning.tsallis").log_q
FeatureVecEnv = pytest.importorskip("bson.learning.vec_env").FeatureVecEnv

torch.set_num_threads(1)  # the networks are too small for more

QUICK = {"num_pedestrians": 2, "pedestrian_model": "social-force", "map_size": 20.0, "goal_distance": (4.0, 8.0)}
TASK = {**QUICK, "horizon": 40}
SMALL_PPO = PpoConfig(hidden=(16, 16), rollout=32, batch=32, epochs=2)
SMALL_SAC = SacConfig(hidden=(16, 16), learning_starts=32, batch=16, steps_per_update=4, buffer=1000)


def config(algo, hyperparameters, steps=256, **more):
    return TrainConfig(
        algo, steps=steps, task=TASK, num_envs=2, validate_every=10**6, validate_episodes=2,
        hyperparameters=hyperparameters, **more,
    )  # fmt: skip


class OnLine(gymnasium.Env):
    """A point on a line that is rewarded near the origin."""

    observation_space = gymnasium.spaces.Box(-5.0, 5.0, (3,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self._place, self._steps = np.array([1.0, -1.0, 0.5], np.float32), 0
        return self._place.copy(), {}

    def step(self, action):
        self._place[:2] = np.clip(self._place[:2] + 0.2 * action, -5.0, 5.0)
        self._steps += 1
        return self._place.copy(), -float(np.abs(self._place).sum()), False, self._steps == 30, {}


def line_env():
    return stable_baselines3.common.vec_env.DummyVecEnv([OnLine])


def test_log_q_of_known_numbers():
    x = torch.tensor([0.25, 1.0, 4.0], dtype=torch.float64)
    assert log_q(x.log(), 1.0).tolist() == pytest.approx(np.log([0.25, 1.0, 4.0]))
    assert log_q(x.log(), 2.0).tolist() == pytest.approx([-0.75, 0.0, 3.0])  # x - 1
    assert log_q(x.log(), 1.5).tolist() == pytest.approx([-1.0, 0.0, 2.0])  # 2 (sqrt x - 1)


def test_log_q_is_bounded_below_and_tends_to_the_logarithm():
    log_x = torch.linspace(-200.0, 3.0, 500, dtype=torch.float64)
    value = log_q(log_x, 1.2)
    assert value.min() >= -5.0 - 1e-12 and value[0] == pytest.approx(-5.0)
    assert (value.diff() >= 0).all() and (value >= log_x - 1e-12).all()  # equal at x = 1 only
    assert log_q(log_x[-50:], 1.0 + 1e-7).numpy() == pytest.approx(log_x[-50:].numpy(), abs=1e-4)


def snapshots(model):
    """Parameters after 40, 80 and 160 steps."""
    for steps in (40, 80, 160):
        model.learn(steps - model.num_timesteps, reset_num_timesteps=model.num_timesteps == 0)
        yield model._n_updates, {name: value.numpy().copy() for name, value in model.policy.state_dict().items()}


def test_tac_at_q_one_is_sac_update_by_update():
    tac = dataclasses.replace(SMALL_SAC, q=1.0).build(line_env(), seed=3)
    ours = list(snapshots(tac))
    sac = stable_baselines3.SAC(
        "MlpPolicy", line_env(), learning_rate=1e-3, gamma=0.99, ent_coef=0.02, batch_size=16, buffer_size=1000,
        learning_starts=32, train_freq=tac.train_freq.frequency, gradient_steps=tac.gradient_steps,
        policy_kwargs={"net_arch": [16, 16]}, seed=3, device="cpu",
    )  # fmt: skip
    for (updates, a), (expected_updates, b) in zip(ours, snapshots(sac), strict=True):
        assert updates == expected_updates > 0
        for name in b:
            assert a[name] == pytest.approx(b[name], abs=1e-5), name


def test_another_q_is_another_algorithm():
    models = [dataclasses.replace(SMALL_SAC, q=q).build(line_env(), seed=3).learn(100) for q in (1.0, 1.2)]
    first, second = (model.actor.mu.weight.detach().numpy() for model in models)
    assert np.abs(first - second).max() > 1e-4


@pytest.mark.parametrize("hyperparameters", [SMALL_PPO, SMALL_SAC], ids=["ppo", "sac"])
def test_what_is_exported_acts_as_the_model_does(hyperparameters, tmp_path):
    env = FeatureVecEnv(2, seed=0, **TASK)
    model = hyperparameters.build(env, seed=0)
    layers, output = export(model)
    write_network(tmp_path / "policy", layers, {"output": output})
    x = np.random.default_rng(0).normal(0.0, 1.0, (50, FEATURES)).astype(np.float32)
    expected, _ = model.predict(x, deterministic=True)
    assert learned.load(str(tmp_path / "policy.npz"))().act(x) == pytest.approx(expected, abs=1e-5)


def test_the_worlds_are_the_environments():
    """An episode seen through FeatureVecEnv is the one that BsonEnv plays: features, rewards, end and score."""
    worlds = FeatureVecEnv(2, seed=5, **TASK)
    x = worlds.reset()
    alone = BsonEnv(**TASK)
    observation, info = alone.reset(seed=6)
    assert info["seed"] == 6
    features, total = Features(1), 0.0
    batched = {name: value[None] for name, value in observation.items()}
    assert (features.begin([0], batched)[0] == x[1]).all()
    for _ in range(TASK["horizon"]):
        x, reward, done, infos = worlds.step(np.tile([0.5, 0.1], (2, 1)))
        observation, single, terminated, truncated, info = alone.step(np.array([0.5, 0.1]))
        total += single
        seen = features.step([0], {name: value[None] for name, value in observation.items()})[0]
        assert reward[1] == pytest.approx(single, abs=1e-6) and done[1] == (terminated or truncated)
        assert (seen == (infos[1]["terminal_observation"] if done[1] else x[1])).all()
        if done[1]:
            break
    assert infos[1]["TimeLimit.truncated"] == truncated
    assert infos[1]["episode"]["r"] == pytest.approx(total) and infos[1]["episode"]["Coll"] == info["collisions"]


def test_stable_baselines3_and_our_evaluation_agree(tmp_path):
    """evaluate_policy's return of an episode is the one that the exported agent earns on the same seed."""
    from stable_baselines3.common.evaluation import evaluate_policy

    model = SMALL_PPO.build(FeatureVecEnv(1, seed=11, **TASK), seed=0)
    returns, lengths = evaluate_policy(model, FeatureVecEnv(1, seed=11, **TASK), 1, return_episode_rewards=True)
    agent, env = learned.Learned(*export(model)), BsonEnv(**TASK)
    observation, _ = env.reset(seed=11)
    agent.reset(11)
    total, steps, over = 0.0, 0, False
    while not over:
        observation, reward, terminated, truncated, _ = env.step(agent(observation))
        total, steps, over = total + reward, steps + 1, terminated or truncated
    assert returns == [pytest.approx(total, abs=1e-4)] and lengths == [steps]


@pytest.mark.parametrize(
    ("algo", "hyperparameters"), [("ppo", SMALL_PPO), ("tac", dataclasses.replace(SMALL_SAC, q=1.2))]
)
def test_a_training_writes_what_can_be_evaluated_and_goes_on(algo, hyperparameters, tmp_path):
    class Stop(Exception):
        pass

    whole = config(algo, hyperparameters)

    def stop(steps, figures, validation=False):
        raise Stop

    with pytest.raises(Stop):
        train(dataclasses.replace(whole), tmp_path, show=stop, seconds_between_checkpoints=0)
    folder = tmp_path / f"{algo}-social-force-0"
    assert (folder / "checkpoint.npz").exists()
    assert train(whole, tmp_path, resume=True) == folder
    recipe = json.loads((folder / "policy.json").read_text())
    assert recipe["steps_done"] >= whole.steps and recipe["algo"] == algo
    agent = learned.load(str(folder / "policy.npz"))()
    observation, _ = BsonEnv(**TASK).reset(seed=0)
    assert np.abs(agent(observation)).max() <= 1.0
    with pytest.raises(ValueError, match="another configuration"):
        train(dataclasses.replace(whole, steps=512), tmp_path, resume=True)


@pytest.mark.parametrize(
    ("algo", "hyperparameters"), [("ppo", SMALL_PPO), ("tac", dataclasses.replace(SMALL_SAC, q=1.2))]
)
def test_a_checkpoint_holds_all_but_the_worlds(algo, hyperparameters, tmp_path):
    keeper = keeper_module.BestKeeper(config(algo, hyperparameters), tmp_path)
    model = hyperparameters.build(FeatureVecEnv(2, seed=0, **TASK), seed=0).learn(128)
    keeper.curve.append({"steps": 128})
    layers, output = export(model)
    keeper.best = {"layers": layers, "output": output, "steps": 64, "validation": {"SNS": 1.5}}
    train_module._save_checkpoint(model, keeper)
    drawn = torch.rand(3), np.random.random(3)
    fresh = keeper_module.BestKeeper(keeper.config, tmp_path)
    restored = train_module._restored(fresh)
    assert (torch.rand(3) == drawn[0]).all() and (np.random.random(3) == drawn[1]).all()
    assert restored.num_timesteps == model.num_timesteps == 128 and restored._n_updates == model._n_updates > 0
    assert fresh.curve == keeper.curve
    kept = [
        np.concatenate([array.ravel() for layer in one.best.pop("layers") for array in layer])
        for one in (keeper, fresh)
    ]
    assert (kept[0] == kept[1]).all() and fresh.best == keeper.best
    for before, after in zip(model.policy.parameters(), restored.policy.parameters(), strict=True):
        assert (before == after).all()
    optimizers = [one.policy.optimizer if algo == "ppo" else one.critic.optimizer for one in (model, restored)]
    moments = [[state["exp_avg"] for state in one.state_dict()["state"].values()] for one in optimizers]
    assert len(moments[0]) > 0 and all((a == b).all() for a, b in zip(*moments, strict=True))
    if algo == "tac":
        assert restored.replay_buffer.pos == model.replay_buffer.pos > 0
        assert (restored.replay_buffer.observations == model.replay_buffer.observations).all()
    for one in (model, restored):  # and what they learn next, in the same worlds from the same draws, is the same
        train_module._restored(
            keeper_module.BestKeeper(keeper.config, tmp_path)
        )  # sets torch's and NumPy's random numbers
        one.set_env(FeatureVecEnv(2, seed=5, **TASK))
        one.action_space.seed(1)
        one.learn(64, reset_num_timesteps=False)
    for name, tensor in model.policy.state_dict().items():
        assert (tensor == restored.policy.state_dict()[name]).all(), name


def test_tensorboard_shows_the_curve_the_validations_and_the_losses(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    plain = train(config("ppo", SMALL_PPO), tmp_path / "plain")
    folder = train(config("ppo", SMALL_PPO), tmp_path / "logged", tensorboard=True)
    assert (folder / "policy.npz").read_bytes() == (plain / "policy.npz").read_bytes()
    assert not (plain / "tensorboard").exists()
    events = accumulator.EventAccumulator(str(folder / "tensorboard")).Reload()
    found = {tag: [(one.step, one.value) for one in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
    recipe = json.loads((folder / "policy.json").read_text())
    for rows, prefix in ((recipe["curve"], ""), (recipe["validations"], "validation/")):
        assert rows
        for name in rows[0].keys() - {"steps"}:
            expected = [(row["steps"], pytest.approx(row[name], abs=1e-4, rel=1e-5)) for row in rows]
            assert found[prefix + name] == expected
    assert any(tag.startswith("train/") and "loss" in tag for tag in found)


def test_the_policy_that_validates_best_is_kept(tmp_path, monkeypatch):
    scores = iter([10.0, 30.0, 20.0, 5.0])

    def measured(episode):
        return dict.fromkeys(keeper_module.SCORES, 0.0) | {"SNS": score[0]}

    score, validate = [0.0], keeper_module.BestKeeper.validate

    def scored(self, *arguments):
        score[0] = next(scores)
        return validate(self, *arguments)

    monkeypatch.setattr(keeper_module, "measure", measured)
    monkeypatch.setattr(keeper_module.BestKeeper, "validate", scored)
    whole = dataclasses.replace(config("ppo", SMALL_PPO), validate_every=64)
    folder = train(whole, tmp_path)
    recipe = json.loads((folder / "policy.json").read_text())
    assert [(each["steps"], each["SNS"]) for each in recipe["validations"]] == [
        (64, 10.0), (128, 30.0), (192, 20.0), (256, 5.0)
    ]  # fmt: skip
    assert recipe["from_steps"] == 128 and recipe["validation"]["SNS"] == 30.0


def test_a_training_done_is_never_done_again(tmp_path):
    whole = config("ppo", SMALL_PPO, steps=64)
    folder = train(whole, tmp_path)
    before = (folder / "policy.json").read_bytes()
    train(whole, tmp_path, resume=True)
    assert (folder / "policy.json").read_bytes() == before
    (folder / "policy.json").unlink()  # as if killed before it was written
    (folder / "checkpoint.npz").write_bytes(b"")
    with pytest.raises(UsageError, match="damaged"):
        train(whole, tmp_path, resume=True)
    (folder / "checkpoint.npz").unlink()
    with pytest.raises(UsageError, match="already"):
        train(whole, tmp_path)
    assert (folder / "policy.npz").exists()
    train(whole, tmp_path, resume=True)
    assert json.loads((folder / "policy.json").read_text())["steps_done"] == 64
    with pytest.raises(UsageError, match="another configuration: steps is 64, not 128"):
        train(dataclasses.replace(whole, steps=128), tmp_path)
    assert json.loads((folder / "config.json").read_text())["steps"] == 64


def test_a_training_that_cannot_begin_leaves_nothing(tmp_path):
    crowded = {"num_pedestrians": None, "pedestrian_density": 1.0, "map_size": 12.0}
    with pytest.raises(ValueError, match="no free goal"):  # told by the first reset
        train(dataclasses.replace(config("ppo", SMALL_PPO), task=crowded), tmp_path / "new" / "runs")
    assert not list(tmp_path.iterdir())
    whole = config("ppo", SMALL_PPO)
    folder = tmp_path / f"{whole.name}-0"
    folder.mkdir()
    os.mkfifo(folder / "curve.csv")
    with pytest.raises(UsageError, match="curve.csv': it is no regular file"):
        train(whole, tmp_path)
    assert os.listdir(folder) == ["curve.csv"]


def test_a_training_has_its_folder_for_itself_and_removes_what_killed_ones_left(tmp_path):
    whole = config("ppo", SMALL_PPO, steps=64)
    folder = tmp_path / f"{whole.name}-0"
    with lock_folder(folder), pytest.raises(UsageError, match="Another run is at work"):
        train(whole, tmp_path)
    for name in (".checkpoint.npz.0123abcd", ".policy.npz._bc_ef01", ".checkpoint.pkl.01234567"):
        (folder / name).write_bytes(bytes(1000))
    assert train(whole, tmp_path) == folder
    assert not [name for name in os.listdir(folder) if name.startswith(".")]


@pytest.mark.parametrize(("worlds", "per_update"), [(16, 16), (16, 8), (24, 16), (1, 4), (6, 4)])
def test_sac_updates_as_often_as_it_says(worlds, per_update):
    env = stable_baselines3.common.vec_env.DummyVecEnv([OnLine] * worlds)
    model = dataclasses.replace(SMALL_SAC, steps_per_update=per_update).build(env, seed=0)
    assert model.train_freq.frequency * worlds == per_update * model.gradient_steps


def test_a_clone_does_what_the_better_episodes_did(tmp_path):
    rng = np.random.default_rng(0)

    def episode(score, sign):
        x = rng.normal(0.0, 1.0, (400, FEATURES)).astype(np.float32)
        return score, x, sign * np.clip(x[:, :2], -1.0, 1.0)

    x, action = select([episode(90.0, 1.0), episode(10.0, -1.0), episode(80.0, 1.0), episode(0.0, -1.0)], keep=0.5)
    assert len(x) == 800 and (action == np.clip(x[:, :2], -1.0, 1.0)).all()
    losses = []
    layers = clone(
        x, action, BcConfig(hidden=(32,), batch=50, epochs=30), seed=0, show=lambda e, loss, held: losses.append(held)
    )
    assert losses[-1] < 0.6 * losses[0]
    assert np.corrcoef(learned.Learned(layers, "clip").act(x)[:, 0], action[:, 0])[0, 1] > 0.9


def test_bc_learns_from_an_expert_file(tmp_path):
    env = FeatureVecEnv(1, seed=0, **TASK)
    layers, output = export(SMALL_PPO.build(env, seed=0))
    layers[-1] = (100 * layers[-1][0], layers[-1][1])  # whose actions are small before it has learned
    write_network(tmp_path / "expert", layers, {"output": output})
    hyperparameters = BcConfig(expert=str(tmp_path / "expert.npz"), keep=1.0, hidden=(16,), batch=32, epochs=60)
    whole = config("bc", hyperparameters, steps=400)
    folder = train(whole, tmp_path)
    expert, clone = (learned.load(str(file))() for file in (tmp_path / "expert.npz", folder / "policy.npz"))
    x = [env.reset()]
    for _ in range(30):
        x.append(env.step(expert.act(x[-1]))[0])
    x = np.concatenate(x)
    wanted = expert.act(x)
    assert np.square(clone.act(x) - wanted).mean() < 0.5 * np.square(wanted).mean()
    before = (folder / "policy.json").read_bytes()
    train(whole, tmp_path, resume=True)  # it was done
    assert (folder / "policy.json").read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"algo": "dqn"}, "Choose one of ppo, sac, tac, bc"),
        ({"steps": 0}, "steps must be at least 1"),
        ({"seed": -1}, "seed must be at least 0"),
        ({"task": {"pedestrians": 3}}, "Unknown option 'pedestrians'"),
    ],
)
def test_a_wrong_setting_is_told(arguments, told):
    with pytest.raises(ValueError, match=told):
        TrainConfig(**arguments)


def test_the_papers_preset_is_the_papers():
    """Secs. IV-C and VI-D: PPO as the pedestrians' but for a batch of 128 and 10 epochs; the others on (1024, 1024), q
    1.2."""
    ppo, sac, tac, bc = (PRESETS["paper"][algo] for algo in ("ppo", "sac", "tac", "bc"))
    assert (ppo.hidden, ppo.gamma, ppo.lam, ppo.clip) == ((64, 64, 64), 0.999, 0.95, 0.2)
    assert (ppo.batch, ppo.epochs) == (128, 10)
    assert sac.hidden == tac.hidden == bc.hidden == (1024, 1024)
    assert (sac.q, tac.q) == (1.0, 1.2) and dataclasses.replace(tac, q=1.0) == sac
    assert {each.learning_rate for each in (ppo, sac, tac, bc)} == {1e-3}
    assert ppo.final_learning_rate == bc.final_learning_rate == 1e-3
    names = [TrainConfig(algo, hyperparameters=PRESETS["paper"][algo]).name for algo in PRESETS["paper"]]
    assert names == ["ppo-paper", "sac-paper", "tac-paper", "bc-paper"] and TrainConfig("sac").name == "sac"
    assert TrainConfig("ppo", task={"pedestrian_model": "orca"}, hyperparameters=ppo).name == "ppo-paper-orca"


def test_the_joint_tsallis_entropy_is_of_the_whole_actions_density():
    env, x = FeatureVecEnv(2, seed=0, **TASK), torch.zeros(5, FEATURES)
    found = []
    for q, joint in ((1.0, False), (1.2, True), (1.2, False)):
        actor = dataclasses.replace(SMALL_SAC, q=q, joint=joint).build(env, seed=3).actor
        torch.manual_seed(0)
        found.append(actor.action_log_prob(x))
    (action, log_density), (same, joint), (_, summed) = found
    assert torch.equal(action, same)
    assert joint.detach().numpy() == pytest.approx((np.exp(0.2 * log_density.detach().numpy()) - 1) / 0.2, rel=1e-4)
    assert not torch.allclose(joint, summed)


def test_training_leaves_torchs_threads_as_they_were():
    def fail():
        with one_thread():
            assert torch.get_num_threads() == 1
            raise KeyError

    torch.set_num_threads(2)
    try:
        with pytest.raises(KeyError):
            fail()
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(1)


def test_what_was_trained_on_another_robot_tells_so_and_sees_shares_of_its_speeds(tmp_path):
    task = {**TASK, "robot": "diffbot", "control_period": 0.2}
    folder = train(dataclasses.replace(config("ppo", SMALL_PPO, steps=64), task=task), tmp_path)
    factory = learned.load(str(folder / "policy.npz"))
    agent = factory(Setting.of(TaskConfig(robot="diffbot", control_period=0.2), make_track("local", "lidar2d")))
    assert agent.top == (1.0, 2.0)
    with pytest.raises(
        ValueError, match=r"trained with control_period 0.2 s, robot diffbot, not with control_period 0.1"
    ):
        factory(Setting.default())
    seen, _ = BsonEnv(**task).reset(seed=0)
    seen["velocity"] = np.array([0.5, 1.0], np.float32)
    worlds = FeatureVecEnv(1, seed=0, **task)
    assert worlds._features.step([0], {name: value[None] for name, value in seen.items()})[0, 4:6].tolist() == [
        0.5,
        0.5,
    ]
