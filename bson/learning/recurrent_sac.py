"""Recurrent robots learn by SAC and TAC in native worlds, from nothing or from another policy.

SAC by Haarnoja et al., "Soft actor-critic algorithms and applications", 2018, with the temperature that is tuned there;
TAC by Lee et al., "Generalized Tsallis entropy reinforcement learning", RSS 2020: ln_q in the place of ln
(bson.learning.tsallis). What a memory changes is after Kapturowski et al. 2019 (bson.learning.replay) and Ni et al.,
"Recurrent model-free RL can be a strong baseline for many POMDPs", ICML 2022: actor and critics have memories of their
own, since one that both shape learns badly; the two critics are heads on one memory, as there, which saves a third of
the time.

The actor's mean is the network of bson.recurrent, so that the policy is written as those of PPO and of imitation are.
Its actions are squashed by tanh; where training goes on from a policy whose actions are clipped, they are clipped too,
and the policy is the given one to begin with. The density is the Gaussian's before clipping then, as in PPO, and where
an action is beyond the bounds, only gradients that lead back pass ("inverting gradients": Hausknecht and Stone, "Deep
reinforcement learning in parameterized action space", ICLR 2016).

Worlds can't be stored: every `leg` updates all begin new episodes, whose seeds follow from the steps done. A training
that goes on from there is the one that was not interrupted, bit for bit.
"""

import copy
import dataclasses
import math
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
import torch

from bson import recurrent
from bson.learning.hyperparameters import check
from bson.learning.keeper import Count, Keeper, collect_keeper, restore_keeper, wanted_keeper
from bson.learning.legs import Legs
from bson.learning.recurrent_network import Encoder, Network
from bson.learning.replay import Batch, Recorder, Replay
from bson.learning.tsallis import EPSILON, entropic
from bson.recurrent import UNITS
from macid.learning.curves import check_arrays

ACTIONS = 2
_LOG_STD = (-5.0, 2.0)  # the least and the most
_HIDDEN = 128  # width of the critics' heads
_LARGEST = 10.0  # norm of a gradient
_LEG = 0x7AC5  # what the random numbers of a leg begin with, beside the seed and the updates done
_ADAM = ("step", "exp_avg", "exp_avg_sq")  # Adam's state for each parameter


@dataclasses.dataclass(frozen=True)
class RecurrentSacConfig:
    """Hyperparameters; with q above 1, TAC's."""

    learning_rate: float = 5e-4
    actor_learning_rate: float = 5e-4
    gamma: float = 0.99  # per control step
    tau: float = 0.005  # share by which the target critics follow, each time
    alpha: float = 0.02  # weight of the entropy, to begin with
    entropy: float = -1.0  # to which alpha is tuned: of each dimension's density, as if it was uniform [nat]
    q: float = 1.0  # entropic index
    joint: bool = False  # True: ln_q of the action's density; False: the sum of ln_q of each dimension's density
    log_std: float = -0.7  # initial
    batch: int = 16  # pieces
    piece: int = 32  # control steps through which gradients go back
    burn: int = 16  # control steps before a piece, through which the memories come to it
    buffer: int = 100_000  # control steps that are kept for replay
    learning_starts: int = 10_000  # steps before learning; without another policy to begin from, random ones
    rollout: int = 64  # control steps of each world in an update
    steps_per_update: int = 32  # control steps of all worlds for each gradient step
    warmup: int = 0  # gradient steps in which the critics alone learn, to begin with
    leg: int = 8  # updates after which the worlds begin anew, and a checkpoint is written

    def __post_init__(self):
        check(self)
        if not 0 <= self.burn <= self.piece:
            raise ValueError(f"burn must be from 0 to piece ({self.piece}), not {self.burn}.")
        if self.buffer < self.piece:
            raise ValueError(f"buffer must be at least piece ({self.piece}), not {self.buffer}.")

    @property
    def target(self) -> float:
        """The entropy to which alpha is tuned: Tsallis's of a uniform density whose Shannon entropy is `entropy` in
        each dimension. At q = 1 and with -1 it is SAC's usual one, minus the number of dimensions."""
        log_density = torch.full((ACTIONS,), -self.entropy, dtype=torch.float64)
        return -float(entropic(log_density, self.q, self.joint))


class _Clipped(torch.autograd.Function):
    """x, clipped to [-1, 1]; gradients by which an x beyond would go on outwards don't pass."""

    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(x)
        return x.clamp(-1.0, 1.0)

    @staticmethod
    def backward(ctx, *gradients):
        (x,), (gradient,) = ctx.saved_tensors, gradients
        outwards = ((x > 1.0) & (gradient < 0.0)) | ((x < -1.0) & (gradient > 0.0))
        return gradient.masked_fill(outwards, 0.0)


class Actor(torch.nn.Module):
    """The policy's network, and how far its actions spread: a layer on its memory's state that no policy's file has.

    output: what makes actions of the network's numbers, "tanh" or "clip"."""

    def __init__(self, eye: str, output: str, log_std: float):
        super().__init__()
        self.eye, self.output, self.network, self.spread = eye, output, Network(eye), torch.nn.Linear(UNITS, ACTIONS)
        torch.nn.init.zeros_(self.spread.weight)
        torch.nn.init.constant_(self.spread.bias, log_std)

    def forward(self, x: torch.Tensor, state: Any) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """(mean (T, N, 2) before `output`, logarithm of the standard deviation (T, N, 2), the last state) of what is
        seen, x (T, N, size)."""
        states, last = self.network.encode(*recurrent.parted(self.eye, x), state)
        return self.network.head(states), self.spread(states).clamp(*_LOG_STD), last

    def draw(self, mean: torch.Tensor, log_std: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Actions (..., 2), and the logarithms of their dimensions' densities (..., 2); noise: standard normal."""
        log_density = -0.5 * noise**2 - log_std - 0.5 * math.log(2.0 * math.pi)
        raw = mean + log_std.exp() * noise
        if self.output == "clip":
            return _clipped(raw), log_density
        action = torch.tanh(raw)
        return action, log_density - torch.log(1.0 - action**2 + EPSILON)


def _clipped(raw: torch.Tensor) -> torch.Tensor:
    found = _Clipped.apply(raw)
    assert isinstance(found, torch.Tensor)
    return found


class Critic(torch.nn.Module):
    """A memory, and on it two heads that judge actions."""

    def __init__(self, eye: str):
        super().__init__()
        self.eye, self.encoder = eye, Encoder(eye)

        def head():
            one, two, three = torch.nn.Linear(UNITS + ACTIONS, _HIDDEN), torch.nn.Linear(_HIDDEN, _HIDDEN), _HIDDEN
            return torch.nn.Sequential(one, torch.nn.ReLU(), two, torch.nn.ReLU(), torch.nn.Linear(three, 1))

        self.heads = torch.nn.ModuleList([head(), head()])

    def encode(self, x: torch.Tensor, state: Any) -> Any:
        """(states (T, N, UNITS), the last one) of what is seen, x (T, N, size)."""
        return self.encoder.encode(*recurrent.parted(self.eye, x), state)

    def judge(self, states: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Values (2, T, N) of actions (T, N, 2) by both heads."""
        x = torch.cat([states, action], dim=-1)
        return torch.stack([head(x)[..., 0] for head in self.heads])


class Losses(NamedTuple):
    """The losses of a batch, each ()."""

    critic: torch.Tensor
    actor: torch.Tensor
    temperature: torch.Tensor
    entropy: torch.Tensor  #: mean over the batch, no loss
    value: torch.Tensor  #: mean over the batch, no loss


def losses(
    actor: Actor,
    critic: Critic,
    target: Critic,
    log_alpha: torch.Tensor,
    batch: Batch,
    noise: torch.Tensor,
    config: RecurrentSacConfig,
) -> Losses:
    """SAC's losses over the steps that are there. noise: standard normal (P + 1, B, 2), of the actions that the actor
    would choose now. Those after a step are the same ones that the next step's loss of the actor has."""
    warm, states, begins, x, action, reward, there, terminal = (torch.from_numpy(each.copy()) for each in batch)

    def warmed(encode, state):
        """The memory before the pieces (1, B, UNITS)."""
        with torch.no_grad():
            last = encode(warm, state[None])[-1] if len(warm) else state[None]
        return torch.where(begins[None, :, None], 0.0, last)

    def mean(values):
        return (values * there).sum() / there.sum()

    alpha = log_alpha.detach().exp()
    mean_action, log_std, _ = actor(x, warmed(actor, states[0]))
    chosen, log_density = actor.draw(mean_action, log_std, noise)
    surprise = entropic(log_density, config.q, config.joint)  # in the place of log pi
    with torch.no_grad():
        after = target.encode(x, warmed(target.encode, states[1]))[0][1:]
        follows = target.judge(after, chosen[1:]).amin(dim=0) - alpha * surprise[1:]
        wanted = reward + config.gamma * torch.where(terminal, 0.0, follows)
    known = critic.encode(x[:-1], warmed(critic.encode, states[1]))[0]
    values = critic.judge(known, action)
    now = critic.judge(known.detach(), chosen[:-1]).amin(dim=0)
    return Losses(
        critic=0.5 * sum((mean((value - wanted) ** 2) for value in values), torch.zeros(())),
        actor=mean(alpha * surprise[:-1] - now),
        temperature=-log_alpha * mean(surprise[:-1].detach() + config.target),
        entropy=-mean(surprise[:-1].detach()),
        value=mean(values[0].detach()),
    )


class Noted(msgspec.Struct):
    """A checkpoint's values beside its arrays."""

    keeper: Keeper
    updates: Annotated[int, msgspec.Meta(ge=0, le=10**9)]
    learned: Count  #: gradient steps
    pieces: Count  #: that replay got


class RecurrentSac(Legs):
    """The training of a network with an `eye` (bson.recurrent.EYES) in `env`, a GuidedVecEnv that shows what it sees.

    steps: control steps of all worlds together; seed: of networks and actions; first_seed: the env's, to which the
    steps done are added; start: the parts of a policy to begin from, as bson.recurrent takes them, with its `output`.
    """

    def __init__(
        self,
        env: Any,
        eye: str,
        steps: int,
        config: RecurrentSacConfig,
        seed: int,
        first_seed: int,
        start: Any = None,
        output: str = "tanh",
    ):
        torch.manual_seed(seed)
        super().__init__(env, steps, config)
        self._seed, self._first_seed = seed, first_seed
        self.output = output  #: of the policy's file
        self.actor, self.critic = Actor(eye, output, config.log_std), Critic(eye)
        if start is not None:
            self.actor.network.take(start)
            self.critic.encoder.take(start)
        self.target = copy.deepcopy(self.critic).requires_grad_(False)
        self.log_alpha = torch.tensor(math.log(config.alpha), requires_grad=True)
        self._own = {
            "actor": list(self.actor.parameters()),
            "critic": list(self.critic.parameters()),
            "temperature": [self.log_alpha],
        }
        rates = dict.fromkeys(self._own, config.learning_rate) | {"actor": config.actor_learning_rate}
        self._optimizers = {name: torch.optim.Adam(own, rates[name]) for name, own in self._own.items()}
        self.learned = 0  #: gradient steps
        dtype = np.float16 if eye == "picture" else np.float32
        capacity = config.buffer // config.piece
        self.replay = Replay(capacity, config.piece, config.burn, recurrent.size(eye), UNITS, dtype=dtype)
        self._recorder = Recorder(self.replay, env.num_envs)
        self._random = start is None  # whether the first actions are
        self._x = self._rng = self._states = None

    @property
    def layers(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """The present policy's, as its agent takes them."""
        return [layer for part in self.actor.network.parts().values() for layer in part]

    def update(self) -> tuple[list[dict[str, float]], dict[str, float]]:
        """Control steps of all worlds, and the gradient steps that they are worth: what the infos tell as `episode` of
        the episodes that ended, and figures of the gradient steps."""
        number, config = self._env.num_envs, self._config
        if self.rests:
            self._rng = np.random.default_rng((_LEG, self._seed, self.updates))
            self._env.seed(self._first_seed + self.steps)
            self._x = self._env.reset()
            self._states = torch.zeros(2, number, UNITS)  # of actor and critic
            self._recorder.begin(self._x)
        ended = []
        for now in range(config.rollout):
            wild = self._random and self.steps + now * number < config.learning_starts
            ended += self._step(wild)
        figures = []
        if self.steps + self._per >= config.learning_starts:
            figures = [self._learn() for _ in range(max(1, self._per // config.steps_per_update))]
        self.updates += 1
        if self.rests:
            self._recorder.cut()
        names = figures[0] if figures else ()
        return ended, {name: float(np.mean([one[name] for one in figures])) for name in names}

    def _step(self, wild):
        """A control step of all worlds, with random actions where it is `wild`."""
        assert self._x is not None and self._rng is not None and self._states is not None
        before, x = self._states, torch.from_numpy(self._x)[None]
        noise = self._rng.standard_normal((1, len(self._x), ACTIONS), np.float32)
        with torch.no_grad():
            mean, log_std, mine = self.actor(x, before[:1])
            action = self.actor.draw(mean, log_std, torch.from_numpy(noise))[0][0].numpy()
            self._states = torch.cat([mine, self.critic.encode(x, before[1:])[1]])
        if wild:
            action = self._rng.uniform(-1.0, 1.0, action.shape).astype(np.float32)
        self._x, reward, done, infos = self._env.step(action)
        cut = np.array([info.get("TimeLimit.truncated", False) for info in infos])
        last = np.array([info.get("terminal_observation", x) for info, x in zip(infos, self._x, strict=True)])
        self._recorder.note(before.numpy(), action, reward, last, done, done & ~cut)
        over = np.flatnonzero(done)
        self._states[:, over] = 0.0
        self._recorder.begin(self._x[over], over)
        return [info["episode"] for info in infos if "episode" in info]

    def _learn(self):
        """A gradient step of each network; figures of it."""
        assert self._rng is not None
        config = self._config
        batch = self.replay.sample(self._rng, config.batch)
        noise = self._rng.standard_normal((config.piece + 1, config.batch, ACTIONS), np.float32)
        found = losses(self.actor, self.critic, self.target, self.log_alpha, batch, torch.from_numpy(noise), config)
        for name, own in self._own.items():
            if name != "critic" and self.learned < config.warmup:
                continue
            self._optimizers[name].zero_grad()
            getattr(found, name).backward(inputs=own)
            torch.nn.utils.clip_grad_norm_(own, _LARGEST)
        for name, optimizer in self._optimizers.items():
            if name == "critic" or self.learned >= config.warmup:
                optimizer.step()
        with torch.no_grad():
            for follower, leader in zip(self.target.parameters(), self.critic.parameters(), strict=True):
                follower.lerp_(leader, config.tau)
        self.learned += 1
        figures = {"critic": found.critic, "entropy": found.entropy, "value": found.value}
        return {name: figure.item() for name, figure in figures.items()} | {"alpha": math.exp(self.log_alpha.item())}

    def _tensors(self):
        """{name: tensor} of networks, temperature and Adam's moments."""
        networks = {"actor": self.actor, "critic": self.critic, "target": self.target}
        found = {
            f"{name}/{key}": one for name, network in networks.items() for key, one in network.state_dict().items()
        }
        found["temperature"] = self.log_alpha.detach()
        for name, optimizer in self._optimizers.items():
            for index, parameter in enumerate(self._own[name]):
                # Adam makes its state with the first step: zeros.
                state = optimizer.state[parameter]
                if not state:
                    zeros = (torch.zeros(()), torch.zeros_like(parameter), torch.zeros_like(parameter))
                    state |= dict(zip(_ADAM, zeros, strict=True))
                found |= {f"moments/{name}/{index}/{key}": state[key] for key in _ADAM}
        return found

    def collect(self, keeper: dict[str, Any]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """({name: array}, the values of a Noted) of a training that rests, with a keeper's state."""
        found, noted = collect_keeper(keeper)
        found |= {name: tensor.numpy() for name, tensor in self._tensors().items()}
        found |= {f"replay/{name}": rows for name, rows in self.replay.collect().items()}
        counts = {"updates": self.updates, "learned": self.learned, "pieces": self.replay.added}
        return found, {"keeper": noted, **counts}

    def restore(self, found: dict[str, np.ndarray], noted: dict[str, Any]) -> dict[str, Any]:
        """Goes on from a checkpoint; returns the keeper's state. Raises ValueError for one of another training."""
        tensors, pieces = self._tensors(), noted["pieces"]
        wanted = {name: tensor.numpy() for name, tensor in tensors.items()}
        wanted |= {f"replay/{name}": rows for name, rows in self.replay.wanted(pieces).items()}
        check_arrays(found, wanted | wanted_keeper(noted["keeper"], self.layers))
        keeper = restore_keeper(found, noted["keeper"], len(self.layers))
        self.replay.restore({name: found[f"replay/{name}"] for name in self.replay.collect()}, pieces)
        with torch.no_grad():
            for name, tensor in tensors.items():
                tensor.copy_(torch.from_numpy(found[name].copy()))
        self.learned = noted["learned"]
        self._go_on_after(noted["updates"])
        return keeper
