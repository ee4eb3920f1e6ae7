"""Recurrent robots learn by imitation: behaviour cloning of a teacher, then DAgger (Ross et al., "A reduction of
imitation learning and structured prediction to no-regret online learning", AISTATS 2011), in which the pupil drives and
the teacher says what it would have done.

The teacher may see more than the pupil: another sensor, or the map and people's places ("learning by cheating", Chen et
al., CoRL 2019). So a planner that knows the map teaches one that sees by the LIDAR alone, and one with a LIDAR one
that sees depth pictures.
"""

import dataclasses
import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Annotated, Any

import msgspec
import numpy as np
import torch

from bson import recurrent
from bson.agents.contract import Setting, act, made_for, reset_agent
from bson.agents.learned import Pupil
from bson.agents.shield import Shield
from bson.episodes.session import Session
from bson.episodes.tracks import LocalTrack, make_track
from bson.learning.draw import Draw, training_seed
from bson.learning.hyperparameters import check
from bson.learning.keeper import Keeper, collect_keeper, restore_keeper, wanted_keeper
from bson.learning.recurrent_network import Network
from bson.recurrent import PICTURE, UNITS
from bson.task import TaskConfig
from macid.layout import NoFreeSpace
from macid.learning.curves import check_arrays


@dataclasses.dataclass(frozen=True)
class DaggerConfig:
    """Imitation by a recurrent robot. `steps` of training are control steps of all rounds together."""

    expert: str = "tac"  # the teacher: any agent that `bson evaluate` takes
    rounds: int = 4  # in the first of a new pupil the teacher drives, and is pushed off its way; else the pupil
    noise: float = 0.3  # standard deviation of what is added to the teacher's actions, in every second episode
    learning_rate: float = 1e-3
    final_learning_rate: float = 1e-4  # reached linearly over a round
    batch: int = 16  # pieces
    piece: int = 64  # control steps of an episode through which gradients go back
    updates: int = 1500  # of each round
    shield: bool = False  # whether the pupil drives behind bson.agents.shield.Shield, in validation too

    def __post_init__(self):
        check(self)


@dataclasses.dataclass
class Episodes:
    """What pupils saw and teachers said: an array (T, ...) of each episode."""

    vector: list[np.ndarray] = dataclasses.field(default_factory=list)
    picture: list[np.ndarray] = dataclasses.field(default_factory=list)
    wanted: list[np.ndarray] = dataclasses.field(default_factory=list)


def gather(
    teacher: Any,
    pupil: type[Pupil],
    network: Any,
    settings: Callable[[], TaskConfig],
    steps: int,
    rng: np.random.Generator,
    config: DaggerConfig,
    into: Episodes,
    nworld: int = 8,
    progress: Callable[[int], object] = lambda steps: None,
) -> None:
    """Adds whole episodes of at least `steps` control steps to `into`. teacher: an agent's factory; network: the parts
    with which the `pupil` drives, None where the teacher drives; settings: gives the setting of the next episodes.
    """
    track, done, session = common_track(teacher, pupil), 0, None
    try:
        while done < steps:
            setting = settings()
            if session is None:
                session = Session(setting, track, nworld)
            elif session.config != setting:
                session.configure(setting)
            try:
                done += _episodes(session, teacher, pupil, network, rng, config, into, progress)
            except NoFreeSpace:  # no room in this map for so many: another one
                continue
    finally:
        if session is not None:
            session.close()


def common_track(teacher: Any, pupil: type[Pupil]) -> LocalTrack:
    """A track with all that both see."""
    kind = "global" if "global" in (teacher.track, pupil.track) else "local"
    sensors = {one.key: one for each in (teacher, pupil) for one in make_track("local", each.sensor).sensors}
    if pupil.pictures:
        sensors.pop("rgb", None)  # it would be drawn for nobody
    return make_track(kind, tuple(sensors.values()))


def guard_of(sight: Any, setting: Setting) -> Shield:
    """The shield before a pupil with this `sight`, for its `guard` alone."""
    return Shield(SimpleNamespace(eyes=sight), setting)


def _episodes(session, teacher, pupil, network, rng, config, into, progress):
    """One episode in each world; returns the number of control steps."""
    setting = Setting.of(session.config, session.track)
    everyone = np.arange(session.nworld)
    seeds = [training_seed(rng) for _ in everyone]
    observation = session.reset(everyone, seeds)
    teachers = [made_for(teacher, setting) for _ in everyone]
    for one, seed in zip(teachers, seeds, strict=True):
        reset_agent(one, seed)
    sights = [pupil.sight(setting) for _ in everyone]
    shields = [guard_of(sight, setting) for sight in sights] if config.shield else None
    state = np.zeros((session.nworld, UNITS), np.float32)
    pushed = (np.arange(session.nworld) % 2 == 0)[:, None] * config.noise
    push = np.zeros((session.nworld, 2))
    rows: list[Any] = [([], [], []) for _ in everyone]
    going, count = everyone, 0
    while len(going):
        each = [{name: value[row] for name, value in observation.items()} for row in range(len(going))]
        wanted = np.stack([np.clip(act(teachers[i], one), -1.0, 1.0) for i, one in zip(going, each, strict=True)])
        seen = [pupil.look(sights[i], one) for i, one in zip(going, each, strict=True)]
        vector = np.stack([one for one, _ in seen])
        pictures = np.stack([one for _, one in seen]) if pupil.pictures else None
        for row, index in enumerate(going):
            rows[index][0].append(vector[row])
            rows[index][1].append(pictures[row] if pictures is not None else 0)
            rows[index][2].append(wanted[row])
        if network is None:
            push[going] = 0.8 * push[going] + 0.6 * rng.normal(size=(len(going), 2))
            action = np.clip(wanted + pushed[going] * push[going], -1.0, 1.0)
        else:
            action, state[going] = recurrent.step(network, vector, pictures, state[going])
            action = np.clip(action, -1.0, 1.0)
            if shields is not None:
                action = np.stack([shields[i].guard(*row) for i, *row in zip(going, action, each, strict=True)])
        observation, _, terminated, truncated = session.step(going, action)
        count += len(going)
        progress(len(going))
        on = ~(terminated | truncated)
        going = going[on]
        observation = {name: value[on] for name, value in observation.items()}
    for vector, pictures, wanted in rows:
        into.vector.append(np.array(vector, np.float32))
        into.picture.append(np.array(pictures, np.float16) if pupil.pictures else np.zeros(0, np.float16))
        into.wanted.append(np.array(wanted, np.float32))
    return count


def fit(
    network: Network,
    episodes: Episodes,
    config: DaggerConfig,
    rng: np.random.Generator,
    show: Callable[[int, float], object] = lambda update, loss: None,
) -> None:
    """Fits `network` to what the teachers said, by least squares. Pieces are drawn with equal chances for each control
    step; a piece begins with the state of so many steps before it as there are, up to its own length, through which no
    gradient goes."""
    lengths = np.array([len(one) for one in episodes.vector])
    optimizer = torch.optim.Adam(network.parameters(), config.learning_rate)
    last = config.final_learning_rate / config.learning_rate
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, last, config.updates)
    share, recent = lengths / lengths.sum(), []
    for update in range(1, config.updates + 1):
        chosen = rng.choice(len(lengths), config.batch, p=share)
        begins = [int(rng.integers(max(1, lengths[one] - config.piece + 1))) for one in chosen]
        begins = [first if first > config.piece // 2 or rng.random() < 0.5 else 0 for first in begins]
        loss = _loss(network, episodes, chosen, begins, config.piece)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        recent.append(loss.item())
        if update % 100 == 0:
            show(update, float(np.mean(recent[-100:])))


def _loss(network, episodes, chosen, begins, piece):
    warm = [max(0, first - piece) for first in begins]

    def part(rows, froms, tos, width):
        """Rows (width, N, ...) of the episodes, ended by zeros; and which of them there are (width, N)."""
        found = [rows[one][a:b] for one, a, b in zip(chosen, froms, tos, strict=True)]
        whole = np.zeros((width, len(chosen), *found[0].shape[1:]), np.float32)
        for column, each in enumerate(found):
            whole[: len(each), column] = each
        return torch.from_numpy(whole)

    def both(froms, tos, width):
        pictures = part(episodes.picture, froms, tos, width) if network.picture else None
        return part(episodes.vector, froms, tos, width), pictures

    lengths = [min(len(episodes.wanted[one]) - first, piece) for one, first in zip(chosen, begins, strict=True)]
    ends = [first + length for first, length in zip(begins, lengths, strict=True)]
    with torch.no_grad():
        state = _warmed(network, both, warm, begins, piece)
    action, _ = network(*both(begins, ends, piece), state)
    wanted = part(episodes.wanted, begins, ends, piece)
    there = torch.from_numpy(np.arange(piece)[:, None] < np.array(lengths))
    return ((action - wanted) ** 2).mean(dim=-1)[there].mean()


def _warmed(network, both, warm, begins, piece):
    """The states (1, N, UNITS) after the steps from `warm` to `begins`; 0 where there are none."""
    counts = np.array(begins) - np.array(warm)
    state = torch.zeros(1, len(begins), UNITS)
    for count in np.unique(counts[counts > 0]):
        who = counts == count
        vector, pictures = both(warm, begins, piece)
        seen = None if pictures is None else pictures[:count, who]
        state[:, who] = network(vector[:count, who], seen)[1]
    return state


class Noted(msgspec.Struct):
    """A checkpoint's values beside its arrays."""

    rounds: Annotated[int, msgspec.Meta(ge=0, le=10**6)]  #: done
    generator: dict[str, Any]  #: the state of NumPy's generator
    keeper: Keeper


class Imitation:
    """The training of a `pupil` by a `teacher`, an agent's factory, in `task` or settings of a `draw`, round by round.
    begun: the parts of the policy from which the pupil goes on, as bson.recurrent has them; None for a new one."""

    def __init__(
        self,
        teacher: Any,
        pupil: type[Pupil],
        task: TaskConfig,
        draw: Draw | None,
        steps: int,
        config: DaggerConfig,
        seed: int,
        begun: Any = None,
    ):
        torch.manual_seed(seed)
        self._teacher, self._pupil, self._task, self._draw, self._config = teacher, pupil, task, draw, config
        self._each = max(1, steps // config.rounds)
        self._rng, self.episodes = np.random.default_rng((0xDA66E5, seed)), Episodes()
        self.network, self.rounds, self._begun = Network(pupil.eye), 0, begun is not None
        if begun is not None:
            self.network.take(begun)

    @property
    def steps(self) -> int:
        """The control steps of the rounds done."""
        return self.rounds * self._each

    @property
    def layers(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """The present policy's, as its agent takes them."""
        return [layer for part in self.network.parts().values() for layer in part]

    def round(
        self,
        progress: Callable[[int], object] = lambda steps: None,
        show: Callable[[int, float], object] = lambda update, loss: None,
    ) -> None:
        """One more round: episodes, and a fit to all so far."""
        driver = self.network.parts() if self.rounds or self._begun else None

        def settings():
            return self._draw.setting(self._rng, self._task) if self._draw else self._task

        arguments = self._each, self._rng, self._config, self.episodes
        gather(self._teacher, self._pupil, driver, settings, *arguments, progress=progress)
        fit(self.network, self.episodes, self._config, self._rng, show)
        self.rounds += 1

    def collect(self, keeper: dict[str, Any]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """({name: array}, the values of a Noted) after a round, with a keeper's state."""
        found, noted = collect_keeper(keeper)
        found |= {f"network/{name}": tensor.numpy() for name, tensor in self.network.state_dict().items()}
        found |= {f"episodes/{name}": np.concatenate(getattr(self.episodes, name)) for name in _ROWS}
        found["episodes/lengths"] = np.array([len(one) for one in self.episodes.vector])
        found["random/torch"] = torch.get_rng_state().numpy()
        state = json.loads(json.dumps(self._rng.bit_generator.state, default=str))
        state["state"] = {name: str(value) for name, value in state["state"].items()}  # of more than 64 bits
        return found, {"rounds": self.rounds, "generator": state, "keeper": noted}

    def restore(self, found: dict[str, np.ndarray], noted: dict[str, Any]) -> dict[str, Any]:
        """Goes on from a checkpoint; returns the keeper's state. Raises ValueError for one of another training."""
        lengths = found.get("episodes/lengths", np.zeros(0, int))
        if lengths.ndim != 1 or lengths.dtype != int or (lengths < 1).any() or lengths.sum() > 10**9:
            raise ValueError("the lengths of its episodes are none")
        rows = int(lengths.sum())
        sizes = (recurrent.MOTION, *PICTURE) if self._pupil.pictures else (recurrent.size(self._pupil.eye), 0)
        pictures = np.zeros((rows, *sizes[1:]) if self._pupil.pictures else 0, np.float16)
        wanted = {
            "episodes/vector": np.zeros((rows, sizes[0]), np.float32),
            "episodes/picture": pictures,
            "episodes/wanted": np.zeros((rows, 2), np.float32),
            "episodes/lengths": lengths,
            "random/torch": torch.get_rng_state().numpy(),
            **{f"network/{name}": tensor.numpy() for name, tensor in self.network.state_dict().items()},
            **wanted_keeper(noted["keeper"], self.layers),
        }
        check_arrays(found, wanted)
        keeper = restore_keeper(found, noted["keeper"], len(self.layers))
        state = noted["generator"]
        try:
            torch.set_rng_state(torch.from_numpy(found["random/torch"]))
            self._rng.bit_generator.state = state | {
                "state": {name: int(value) for name, value in state["state"].items()}
            }
        except (RuntimeError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise ValueError(f"its random numbers are none: {str(error).splitlines()[0]}") from None
        self.network.load_state_dict(
            {name: torch.from_numpy(found[f"network/{name}"].copy()) for name in self.network.state_dict()}
        )
        ends = np.cumsum(lengths)[:-1]
        for name in _ROWS:
            parts = np.split(found[f"episodes/{name}"], ends) if len(found[f"episodes/{name}"]) else []
            setattr(self.episodes, name, parts or [np.zeros(0, np.float16)] * len(lengths))
        self.rounds = noted["rounds"]
        return keeper


_ROWS = ("vector", "picture", "wanted")
