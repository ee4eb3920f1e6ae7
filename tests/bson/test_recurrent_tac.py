"""SAC and TAC of robots with a memory: replay of pieces, the losses, and the training in native worlds."""

import copy
import dataclasses
import json
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_draws import DRAW
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution

from bson import recurrent
from bson.agents import learned, load_agent
from bson.agents.contract import Setting
from bson.episodes.session import Session
from bson.episodes.tracks import make_track
from bson.learning.recurrent_sac import Actor, Critic, RecurrentSacConfig, losses
from bson.learning.replay import Batch, Recorder, Replay
from bson.learning.train import TrainConfig, is_done, train
from bson.learning.tsallis import TsallisActor, entropic, log_q
from bson.recurrent import UNITS
from bson.task import TaskConfig
from macid.files import UsageError

# --- replay


def driven(lengths, piece, burn, capacity=1000, cut=True):
    """A Replay of one world with episodes of these `lengths`, every second of which was cut off. In step t of all,
    counted through all episodes, x is (episode, step in it), the action and the reward are t, and the memory of both
    networks before it is the step in its episode."""
    replay, t = Replay(capacity, piece, burn, 2, 1), 0
    recorder = Recorder(replay, 1)
    recorder.begin(np.array([[0.0, 0.0]]))
    for episode, length in enumerate(lengths):
        for now in range(length):
            done = np.array([now == length - 1])
            states = np.full((2, 1, 1), float(now), np.float32)
            after = np.array([[float(episode), now + 1.0]])
            recorder.note(
                states, np.full((1, 2), t), np.array([float(t)]), after, done, done & np.array([episode % 2 == 0])
            )
            t += 1
        recorder.begin(np.array([[episode + 1.0, 0.0]]), [0])
    if cut:
        recorder.cut()
    return replay


def pieces_of(replay):
    """Each piece that is kept, as a Batch of one."""

    class Chosen:
        def __init__(self, index):
            self.index = index

        def integers(self, most, size):
            assert self.index < most == len(replay)
            return np.full(size, self.index)

    chosen: list = [Chosen(index) for index in range(len(replay))]
    return [replay.sample(one, 1) for one in chosen]


@settings(max_examples=60, deadline=None)
@given(
    lengths=st.lists(st.integers(1, 17), min_size=1, max_size=5),
    piece=st.integers(1, 6),
    share=st.floats(0.0, 1.0),
)
def test_pieces_follow_each_other_through_each_episode_and_end_with_it(lengths, piece, share):
    burn, found = round(share * piece), []
    for one in pieces_of(driven(lengths, piece, burn)):
        count = int(one.there.sum())
        assert one.there[:count].all() and one.x.shape == (piece + 1, 1, 2) and one.warm.shape == (burn, 1, 2)
        episode, first = (int(number) for number in one.x[0, 0])
        # Steps of one episode, then what was seen after the last; what is not there is zero.
        assert [tuple(row) for row in one.x[: count + 1, 0]] == [(episode, first + now) for now in range(count + 1)]
        begin = sum(lengths[:episode]) + first
        assert list(one.reward[:count, 0]) == list(range(begin, begin + count))
        assert not one.reward[count:].any() and not one.action[count:].any() and not one.x[count + 1 :].any()
        assert np.array_equal(one.action[..., 0], one.reward) and np.array_equal(one.action[..., 1], one.reward)
        # The memory is that of the first step before the piece.
        assert one.begins[0] == (first == 0)
        if first:
            assert [tuple(row) for row in one.warm[:, 0]] == [(episode, first - burn + now) for now in range(burn)]
            assert (one.states == first - burn).all()
        else:
            assert not one.states.any()
        # Nothing follows the last step of an episode that was not cut off, and of no other.
        ends = first + count == lengths[episode] and episode % 2 == 0
        assert one.terminal.sum() == ends and (not ends or one.terminal[count - 1, 0])
        found += list(one.reward[:count, 0])
    assert found == list(range(sum(lengths)))  # each step once


def test_what_is_under_way_is_cut_as_the_worlds_begin_anew():
    replay = Replay(10, 4, 2, 1, 1)
    recorder = Recorder(replay, 2)
    recorder.begin(np.zeros((2, 1)))
    no, states = np.zeros(2, bool), np.zeros((2, 2, 1), np.float32)
    for now in range(6):
        recorder.note(states, np.zeros((2, 2)), np.ones(2), np.full((2, 1), now + 1.0), no, no)
    assert replay.added == 2
    recorder.cut()
    assert replay.added == 4 and sorted(int(one.there.sum()) for one in pieces_of(replay)) == [2, 2, 4, 4]
    assert not any(one.terminal.any() for one in pieces_of(replay))
    recorder.begin(np.zeros((2, 1)))
    recorder.cut()  # nothing is under way
    assert replay.added == 4


def test_replay_is_bounded_and_comes_back_from_its_arrays():
    whole, small = driven([9, 8, 7, 12], 3, 2), driven([9, 8, 7, 12], 3, 2, capacity=4)
    assert len(small) == 4 and small.added == whole.added > 8
    kept = {one.reward[0, 0] for one in pieces_of(small)}
    assert kept == {one.reward[0, 0] for one in pieces_of(whole)[-4:]}
    for replay in (whole, small):
        other = Replay(replay.capacity, 3, 2, 2, 1)
        found = replay.collect()
        assert {name: rows.shape for name, rows in other.wanted(replay.added).items()} == {
            name: rows.shape for name, rows in found.items()
        }
        other.restore({name: rows.copy() for name, rows in found.items()}, replay.added)
        for one, its in zip(*(each.sample(np.random.default_rng(0), 64) for each in (replay, other)), strict=True):
            assert np.array_equal(one, its)
    with pytest.raises(ValueError, match="pieces of no length"):
        small.restore(small.collect() | {"count": np.array([1, 2, 4, 0], np.int32)}, 9)


# --- losses


def networks(eye="none", output="tanh", seed=0):
    torch.manual_seed(seed)
    actor, critic, target = Actor(eye, output, -0.7), Critic(eye), Critic(eye)
    torch.nn.init.normal_(actor.spread.weight, std=0.1)
    return actor, critic, target


def batch_of(eye="none", piece=5, burn=3, number=4, seed=0):
    """A random Batch: a whole piece, one that begins its episode, one that ends, and one that is cut off."""
    rng = np.random.default_rng(seed)
    counts = np.array([piece, piece, 3, 2])[:number]
    now = np.arange(piece)[:, None]
    return Batch(
        warm=rng.normal(size=(burn, number, recurrent.size(eye))).astype(np.float32),
        states=rng.normal(size=(2, number, UNITS)).astype(np.float32) * np.float32(0.3),
        begins=np.array([False, True, False, True])[:number],
        x=rng.normal(size=(piece + 1, number, recurrent.size(eye))).astype(np.float32),
        action=rng.uniform(-1, 1, (piece, number, 2)).astype(np.float32),
        reward=rng.normal(size=(piece, number)).astype(np.float32),
        there=now < counts,
        terminal=(now == counts - 1) & np.array([False, False, True, False])[:number],
    )


def all_losses(batch, config, output="tanh", alpha=0.3, seed=0):
    noise = torch.from_numpy(np.random.default_rng(7).normal(size=(*batch.x.shape[:2], 2)).astype(np.float32))
    nets = networks(output=output, seed=seed)
    log_alpha = torch.tensor(math.log(alpha), requires_grad=True)
    return losses(*nets, log_alpha, batch, noise, config), nets, log_alpha, noise


def one_by_one(batch, nets, noise, value, alpha, gamma, target):
    """SAC's losses as the papers and stable-baselines3 have them, of each step alone: (critic, actor, temperature).

    value: what stands for log pi of mean, standard deviation and noise."""
    actor, critic, follower = nets
    critics, actors, temperatures = [], [], []
    for row in range(batch.x.shape[1]):

        def states(network, state, row=row):
            """The state after each x of the row."""
            encode = network.network.encode if isinstance(network, Actor) else network.encoder.encode
            state = torch.from_numpy(state[None, None].copy())
            before = [] if batch.begins[row] else list(batch.warm[:, row])
            state, found = torch.zeros_like(state) if batch.begins[row] else state, []
            for x in [*before, *batch.x[:, row]]:
                seen = recurrent.parted(network.eye, torch.from_numpy(x)[None, None])
                state = encode(*seen, state)[1]
                found.append(state[0])
            return found[len(before) :]

        mine, judged, followed = (
            states(network, batch.states[index, row]) for network, index in ((actor, 0), (critic, 1), (follower, 1))
        )
        for t in np.flatnonzero(batch.there[:, row]):
            chosen = []
            for at in (t, t + 1):
                mean, std = actor.network.head(mine[at]), actor.spread(mine[at]).exp()
                chosen.append(value(mean, std, noise[at, row][None]))
            (action, surprise), (after, its) = chosen
            follows = follower.judge(followed[t + 1], after).min() - alpha * its
            wanted = torch.tensor([batch.reward[t, row]])
            wanted = wanted if batch.terminal[t, row] else wanted + gamma * follows
            for found in critic.judge(judged[t], torch.from_numpy(batch.action[t, row].copy())[None]):
                critics.append(0.5 * torch.nn.functional.mse_loss(found, wanted))
            actors.append(alpha * surprise - critic.judge(judged[t], action).min())
            temperatures.append(-math.log(alpha) * (surprise + target))
    steps = batch.there.sum()
    return tuple(float(sum(each).detach() / steps) for each in (critics, actors, temperatures))  # type: ignore[arg-type]


def squashed(mean, std, noise):
    """Action and log pi by stable-baselines3's squashed Gaussian."""
    found = SquashedDiagGaussianDistribution(2).proba_distribution(mean, std.log())
    raw = mean + std * noise
    return torch.tanh(raw), found.log_prob(torch.tanh(raw), raw)


@pytest.mark.parametrize("burn", [0, 3])
def test_with_q_1_the_losses_are_sac_s(burn):
    batch, config = batch_of(burn=burn), RecurrentSacConfig(piece=5, burn=burn, gamma=0.9)
    found, nets, _, noise = all_losses(batch, config)
    assert config.target == -2.0
    wanted = one_by_one(batch, nets, noise, squashed, 0.3, 0.9, -2.0)
    np.testing.assert_allclose([one.item() for one in found[:3]], wanted, rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize("joint", [False, True])
def test_with_other_q_they_have_the_tsallis_values_that_the_mlp_s_actor_has(joint):
    import gymnasium

    q, box = 1.2, gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def value(mean, std, noise):
        """By bson.learning.tsallis's actor, made to give this mean and standard deviation."""
        actor = TsallisActor(box, box, [], torch.nn.Identity(), 2)
        actor.q, actor.joint = q, joint
        actor.get_action_dist_params = lambda obs: (mean, std.log(), {})  # type: ignore[method-assign]
        actor.action_dist.actions_from_params = lambda *_: drawn(actor.action_dist)  # type: ignore[method-assign]

        def drawn(dist):
            dist.proba_distribution(mean, std.log())
            dist.gaussian_actions = mean + std * noise
            return torch.tanh(dist.gaussian_actions)

        return actor.action_log_prob(mean)

    batch, config = batch_of(), RecurrentSacConfig(piece=5, burn=3, gamma=0.9, q=q, joint=joint)
    found, nets, _, noise = all_losses(batch, config)
    wanted = one_by_one(batch, nets, noise, value, 0.3, 0.9, config.target)
    np.testing.assert_allclose([one.item() for one in found[:3]], wanted, rtol=2e-5, atol=2e-6)
    plain, *_ = all_losses(batch, dataclasses.replace(config, q=1.0))
    assert abs(plain.actor.item() - found.actor.item()) > 1e-3


@settings(max_examples=40, deadline=None)
@given(q=st.floats(1.0, 2.0), entropy=st.floats(-3.0, 1.0), joint=st.booleans())
def test_the_target_is_the_tsallis_entropy_of_a_uniform_density(q, entropy, joint):
    width = math.exp(entropy)  # of the interval in each dimension
    density = torch.full((2,), math.log(1.0 / width), dtype=torch.float64)
    wanted = -entropic(density, q, joint).item()
    config = RecurrentSacConfig(q=q, entropy=entropy, joint=joint)
    assert config.target == pytest.approx(wanted, abs=1e-9)
    alone = -log_q(density[0] * (2 if joint else 1), q).item() * (1 if joint else 2)
    assert config.target == pytest.approx(alone, abs=1e-9)


def test_what_is_not_there_and_what_was_before_a_beginning_have_no_part():
    config = RecurrentSacConfig(piece=5, burn=3)
    batch = batch_of()
    found, *_ = all_losses(batch, config)
    other = batch._replace(**{name: getattr(batch, name).copy() for name in ("x", "warm", "states", "reward")})
    other.reward[3:, 2], other.reward[2:, 3] = 99.0, 99.0
    other.x[4:, 2], other.x[3:, 3] = 9.0, 9.0
    other.warm[:, [1, 3]], other.states[:, [1, 3]] = 9.0, 9.0
    again, *_ = all_losses(other, config)
    assert all(torch.equal(one, its) for one, its in zip(found, again, strict=True))
    other.x[3, 2] = 9.0  # what follows an episode's end is not looked at
    assert torch.equal(all_losses(other, config)[0].critic, found.critic)
    other.x[2, 3] = 9.0  # what follows where one was cut off is
    assert not torch.equal(all_losses(other, config)[0].critic, found.critic)


@pytest.mark.parametrize("output", ["tanh", "clip"])
def test_gradients_reach_each_network_through_the_piece_and_not_before(output):
    config, batch = RecurrentSacConfig(piece=5, burn=3), batch_of()
    found, (actor, critic, target), log_alpha, _ = all_losses(batch, config, output)
    own = {"actor": [*actor.parameters()], "critic": [*critic.parameters()], "temperature": [log_alpha]}
    for name, parameters in own.items():
        gradients = torch.autograd.grad(getattr(found, name), parameters, retain_graph=True)
        assert all(bool((one != 0).any()) for one in gradients), name
        if name != "actor":  # the actor's own has the critics' judgement in it
            others = [one for key, each in own.items() if key != name for one in each]
            none = torch.autograd.grad(getattr(found, name), others, retain_graph=True, allow_unused=True)
            assert all(one is None for one in none)
    none = torch.autograd.grad(found.critic, [*target.parameters()], allow_unused=True)
    assert all(one is None for one in none)


def test_a_clipped_actor_is_the_given_policy_and_comes_back_from_beyond_the_bounds():
    actor = Actor("none", "clip", -30.0)  # almost no noise
    noise = torch.tensor([[0.3, -0.4]])
    mean = torch.tensor([[1.7, -2.0]], requires_grad=True)
    for target, moves in ((0.5, (True, True)), (3.0, (False, True)), (-3.0, (True, False))):
        action, log_density = actor.draw(mean, torch.full((1, 2), -5.0), noise)
        assert torch.equal(action, torch.tensor([[1.0, -1.0]]))
        normal = torch.distributions.Normal(mean, math.exp(-5.0))
        wanted = normal.log_prob(mean + math.exp(-5.0) * noise)
        np.testing.assert_allclose(log_density.detach(), wanted.detach(), atol=1e-4)
        (gradient,) = torch.autograd.grad(((action - target) ** 2).sum(), mean)
        assert tuple((gradient != 0)[0].tolist()) == moves  # only towards the bounds


# --- networks


@pytest.mark.parametrize("inputs", ["gru", "gru-map", "camera", "gru-scans"])
def test_the_written_policy_drives_in_numpy_as_in_torch(inputs, tmp_path):
    kind = learned.KINDS[inputs]
    track = make_track(kind.track, kind.sensor)
    config = TaskConfig(map_size=14.0, goal_distance=(3.0, 6.0), num_pedestrians=2)
    setting = Setting.of(config, track)
    for output in ("tanh", "clip"):
        actor = networks(kind.eye, output)[0]
        with torch.no_grad():
            actor.network.head[2].weight *= 20.0  # beyond the bounds at times
        layers = [layer for part in actor.network.parts().values() for layer in part]
        written = learned.setting_document(Setting.of(config, make_track("local", kind.sensor)), kind.pictures)
        recipe = {"output": output, "inputs": inputs, "setting": written}
        learned.write(tmp_path / "mine", layers, recipe)
        agent, session = load_agent(str(tmp_path / "mine.npz"))(setting), Session(config, track, 1)
        agent.reset(0)
        sight, state = kind.sight(setting), None
        sight.reset()
        observation = session.reset([0], [3])
        for _ in range(6):
            one = {name: value[0] for name, value in observation.items()}
            vector, picture = kind.look(sight, one)
            x = vector if picture is None else np.append(vector, picture.ravel()).astype(np.float32)
            with torch.no_grad():
                mean, log_std, state = actor(torch.from_numpy(x)[None, None], state)
                wanted = actor.draw(mean, log_std, torch.zeros(1, 1, 2))[0][0, 0].numpy()
            action = agent(one)
            np.testing.assert_allclose(action, wanted, atol=2e-5)
            observation, *_ = session.step([0], action[None])
        session.close()


@pytest.mark.parametrize("eye", recurrent.EYES)
def test_a_network_takes_what_another_gave(eye):
    first, other = networks(eye, seed=0)[0].network, networks(eye, seed=1)[0].network
    assert not all(torch.equal(one, its) for one, its in zip(first.parameters(), other.parameters(), strict=True))
    other.take(first.parts())
    assert all(torch.equal(one, its) for one, its in zip(first.parameters(), other.parameters(), strict=True))


# --- in native worlds

SMALL = {"rollout": 8, "piece": 4, "burn": 2, "batch": 4, "buffer": 64, "learning_starts": 40, "steps_per_update": 8}


def training(tmp_path, people=0, steps=128, inputs="gru", start=None, algo="tac", **chosen):
    (tmp_path / "mine.toml").write_text(DRAW.format(people=people))
    config = RecurrentSacConfig(**{**SMALL, "leg": 2, "q": 1.2, **chosen})
    return TrainConfig(algo, 0, steps, {}, 4, 64, 1, config, inputs, str(tmp_path / "mine.toml"), start)


def arrays_of(folder):
    from bson.learning.recurrent_sac import Noted
    from macid.learning.curves import read_checkpoint

    found = read_checkpoint(folder, Noted)
    assert found
    return found


@pytest.mark.parametrize("inputs", ["gru", "gru-scans"])
def test_an_interrupted_training_ends_as_an_uninterrupted_one(inputs, tmp_path, monkeypatch):
    from bson.learning.recurrent_sac import RecurrentSac

    start = "gru" if inputs == "gru" else None
    config = training(tmp_path, 2, inputs=inputs, start=start, warmup=3 if start else 0)
    whole = train(config, tmp_path / "whole")
    assert whole.name == f"tac-{inputs}-mine{'-from-gru' if start else ''}-0" and is_done(config, whole)

    once, count = RecurrentSac.update, []

    def stopped(self):
        if len(count) == 3:  # within the second leg
            raise KeyboardInterrupt
        count.append(1)
        return once(self)

    monkeypatch.setattr(RecurrentSac, "update", stopped)
    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path / "parts")
    monkeypatch.undo()
    assert arrays_of(tmp_path / "parts" / whole.name)[1]["updates"] == 2
    parts = train(config, tmp_path / "parts", resume=True)
    (one, first), (other, second) = arrays_of(whole), arrays_of(parts)
    assert first["updates"] == second["updates"] == 4 and first["learned"] == second["learned"] > 8
    assert first["pieces"] == second["pieces"] > 16  # more than are kept
    assert first["keeper"]["validations"] == second["keeper"]["validations"]
    assert one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)
    recipe = json.loads((parts / "policy.json").read_text())
    assert recipe["output"] == ("clip" if start else "tanh") and recipe.get("start") == start
    assert recipe["hyperparameters"]["q"] == 1.2 and recipe["validations"]
    factory = load_agent(str(parts / "policy.npz"))
    assert factory.kind is learned.KINDS[inputs] and factory.output == recipe["output"]
    held = one["replay/x"]
    assert held.shape == (16, 7, recurrent.size(factory.kind.eye)) and len(one["replay/count"]) == 16

    path = parts / "checkpoint.npz"
    damage = json.loads((parts / "config.json").read_text()) | {"steps": 256}
    (parts / "config.json").write_text(json.dumps(damage))
    from macid.learning.curves import write_checkpoint

    write_checkpoint(parts, other | {"replay/count": np.zeros_like(other["replay/count"])}, second)
    with pytest.raises(UsageError, match=f"'{path}' is damaged .* pieces of no length"):
        train(dataclasses.replace(config, steps=256), tmp_path / "parts", resume=True)


def test_a_training_begins_with_the_policy_that_it_is_given(tmp_path):
    with pytest.raises(UsageError, match="--start gru: its inputs are gru, .* --inputs gru-map and the output clip or"):
        train(training(tmp_path, inputs="gru-map", start="gru"), tmp_path)
    with pytest.raises(UsageError, match="--start tac: its inputs are scans"):
        train(training(tmp_path, start="tac"), tmp_path)
    with pytest.raises(UsageError, match="control_period"):
        train(dataclasses.replace(training(tmp_path, start="gru"), task={"control_period": 0.2}), tmp_path)
    assert not list(tmp_path.glob("tac*"))
    # While the critics learn alone, the policy stays; then it moves, from a policy of each output.
    folder = train(training(tmp_path, 0, 64, start="gru", warmup=99), tmp_path)
    ours, theirs = (learned.load(name)().network for name in (str(folder / "policy.npz"), "gru"))
    assert all(
        np.array_equal(one, its)
        for name in ours
        for layer, other in zip(ours[name], theirs[name], strict=True)
        for one, its in zip(layer, other, strict=True)
    )
    first = train(training(tmp_path, 0, 64, algo="sac", q=1.0), tmp_path)
    other = train(training(tmp_path, 0, 64, start=str(first / "policy.npz")), tmp_path)
    recipes = [json.loads((each / "policy.json").read_text()) for each in (first, other)]
    assert [recipe["output"] for recipe in recipes] == ["tanh", "tanh"] and recipes[0]["hyperparameters"]["q"] == 1.0
    with pytest.raises(UsageError, match="its output is tanh; .* and the output clip"):
        train(TrainConfig("ppo", inputs="gru", start=str(first / "policy.npz")), tmp_path)


def test_the_targets_follow_the_critics(tmp_path):
    from bson.learning.guided_env import GuidedVecEnv
    from bson.learning.recurrent_sac import RecurrentSac

    config = dataclasses.replace(training(tmp_path).hyperparameters, learning_starts=0, tau=0.25, steps_per_update=32)
    task = TaskConfig(map_size=14.0, num_pedestrians=0, goal_distance=(3.0, 6.0), horizon=30)
    env = GuidedVecEnv(4, 0, None, task, pupil=learned.ScanPupil)
    sac = RecurrentSac(env, "none", 64, config, 0, 0)
    before = copy.deepcopy(sac.target.state_dict())
    ended, figures = sac.update()
    assert figures.keys() == {"critic", "entropy", "value", "alpha"} and np.isfinite([*figures.values()]).all()
    assert figures["alpha"] != config.alpha and ended == [] and sac.learned == 1
    for name, tensor in sac.critic.state_dict().items():
        wanted = 0.75 * before[name] + 0.25 * tensor
        np.testing.assert_allclose(sac.target.state_dict()[name], wanted, atol=1e-6)
    env.close()


@pytest.mark.parametrize(
    ("field", "value", "told"),
    [
        ("burn", 40, r"burn must be from 0 to piece \(32\), not 40"),
        ("buffer", 5, r"buffer must be at least piece \(32\), not 5"),
    ],
)
def test_hyperparameters_that_are_none_are_refused(field, value, told):
    with pytest.raises(ValueError, match=told):
        RecurrentSacConfig(**{field: value})


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--algo", "tac", "--inputs", "eyes"], "inputs must be one of scans, .* gru-scans, not 'eyes'"),
        (
            ["--algo", "tac", "--start", "gru"],
            "--start is for bc, ppo, sac, tac with --inputs of gru, .* not tac on scans",
        ),
        (
            ["--algo", "tac", "--inputs", "gru", "--start", "tac"],
            "--start tac: its inputs are scans, its output is tanh",
        ),
        (["--algo", "bc", "--inputs", "gru-map", "--start", "gru"], "--start gru: its inputs are gru, .*gru-map"),
        (["--algo", "sac", "--inputs", "gru", "--preset", "paper"], "--inputs gru learns with no SacConfig"),
        (["--algo", "sac", "--inputs", "gru", "--teacher", "mppi"], "--teacher is whom bc imitates"),
        (
            ["--algo", "sac", "--inputs", "gru", "--shield"],
            "--shield is of bc with --inputs gru or gru-map or gru-scans",
        ),
        (["--algo", "bc", "--inputs", "gru", "--shield", "--preset", "paper"], "gru learns with no BcConfig"),
        (["--algo", "bc", "--inputs", "camera", "--shield"], "not of bc on camera"),
        (
            ["--algo", "bc", "--inputs", "gru", "--teacher", "tac", "--set", "robot=diffbot"],
            "Agent 'tac' was trained with robot jackal, not with robot diffbot.$",
        ),
        (
            ["--algo", "ppo", "--inputs", "gru", "--set", "control_period=1.0"],
            "A robot with --inputs gru needs",
        ),
        (
            ["--algo", "bc", "--inputs", "gru-map", "--teacher", "goal", "--shield", "--set", "control_period=1.0"],
            "The shield needs a control_period of at most 0.5 s",
        ),
        (["--algo", "tac", "--inputs", "gru-scans", "--engine", "warp"], "--engine warp trains ppo, not 'tac'"),
    ],
)
def test_the_command_refuses_what_does_not_fit(arguments, told, tmp_path, capsys):
    import re

    from bson.cli import main

    assert main(["train", *arguments, "--out", str(tmp_path / "runs")]) == 2
    said = capsys.readouterr().err.strip()
    assert "\n" not in said and re.search(told, said)
    assert not list((tmp_path / "runs").glob("*")) if (tmp_path / "runs").exists() else True


@pytest.mark.slow
def test_the_return_rises(tmp_path):
    chosen = {"rollout": 64, "piece": 16, "burn": 8, "batch": 16, "buffer": 30_000, "learning_starts": 2000, "leg": 8}
    config = training(tmp_path, 0, 40 * 64 * 8, "gru-scans", **chosen, steps_per_update=16, learning_rate=1e-3)
    config = dataclasses.replace(config, num_envs=8, validate_every=10**6)
    rows = []

    def show(steps, figures, validation=False):
        if figures and not validation:
            rows.append(figures["r"])

    train(config, tmp_path, show=show)
    assert rows[-1] > rows[0] + 1.0
