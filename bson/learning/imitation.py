"""Behaviour cloning: regression on the better episodes of an expert (paper, sec. VI-D)."""

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
import torch

from bson.agents.contract import Setting, made_for
from bson.agents.learned import Learned
from bson.episodes.record import Recorder
from bson.episodes.session import Session
from bson.episodes.tracks import LocalTrack
from bson.evaluation.metrics import sns
from bson.features import FEATURES, Features
from bson.learning.algorithms import DEVICE, linear_layers
from bson.learning.hyperparameters import check
from bson.task import TaskConfig


@dataclasses.dataclass(frozen=True)
class BcConfig:
    """Behaviour cloning. `steps` of training are control steps of demonstrations."""

    expert: str = "ppo"  # a shipped agent or a .npz file
    keep: float = 0.5  # share of the episodes to keep, those with the highest SNS
    hidden: tuple[int, ...] = (256, 256)
    learning_rate: float = 1e-3
    final_learning_rate: float = 5e-5  # reached linearly over training
    batch: int = 256
    epochs: int = 20
    demonstrations: str | None = None  # a Minari dataset in place of the expert: its id or folder

    def __post_init__(self):
        check(self)


def demonstrate(
    expert: Callable[..., Any],
    config: TaskConfig,
    track: LocalTrack,
    steps: int,
    seed: int,
    nworld: int = 16,
    progress: Callable[[int], object] | None = None,
) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Episodes of `expert` (an agent's factory) until they hold `steps` control steps: [(SNS, features (T, FEATURES),
    actions (T, 2)), ...]. progress: called after each step of the batch with its number of control steps."""
    setting = Setting.of(config, track)
    agent = cast(Learned, made_for(expert, setting))
    session = Session(config, track, nworld, seeds=[seed + index for index in range(nworld)])
    everyone = np.arange(nworld)
    features, its = Features(nworld, setting.top), Features(nworld, agent.top)
    begun = session.reset(everyone, session.next_seeds(everyone))
    x, its_x = features.begin(everyone, begun), its.begin(everyone, begun)
    recorders = [Recorder(session, int(index)) for index in everyone]
    seen, done = [([], []) for _ in everyone], []
    collected = 0
    while collected < steps:
        action = agent.act(its_x)
        for index in everyone:
            seen[index][0].append(x[index])
            seen[index][1].append(action[index])
        observation, _, terminated, truncated = session.step(everyone, action)
        x, its_x = features.step(everyone, observation), its.step(everyone, observation)
        for index in everyone:
            recorders[index].snap()
        ended = np.flatnonzero(terminated | truncated)
        for index in ended:
            episode = recorders[index].episode()
            if not episode.fault:
                done.append((sns(episode), *map(np.array, seen[index])))
            collected += len(seen[index][0])
            seen[index] = ([], [])
        if len(ended):
            begun = session.reset(ended, session.next_seeds(ended))
            x[ended], its_x[ended] = features.begin(ended, begun), its.begin(ended, begun)
            for index in ended:
                recorders[index] = Recorder(session, int(index))
        if progress:
            progress(nworld)
    return done


def select(episodes: Sequence[tuple[float, np.ndarray, np.ndarray]], keep: float) -> tuple[np.ndarray, np.ndarray]:
    """Features (N, FEATURES) and actions (N, 2) of the share `keep` of `episodes` with the highest SNS."""
    best = sorted(episodes, key=lambda episode: -episode[0])[: max(1, round(keep * len(episodes)))]
    return np.concatenate([x for _, x, _ in best]), np.concatenate([action for _, _, action in best])


def clone(
    x: np.ndarray,
    action: np.ndarray,
    config: BcConfig,
    seed: int,
    show: Callable[[int, float, float], object] = lambda epoch, loss, held_out: None,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Layers that map features `x` (N, FEATURES) to `action` (N, 2), by least squares; a twentieth of the rows is held
    out.

    show: called after each epoch with its number, the loss, and the loss on the held-out rows.
    """
    torch.manual_seed(seed)
    sizes = (FEATURES, *config.hidden, action.shape[1])
    linear = [torch.nn.Linear(*pair) for pair in itertools.pairwise(sizes)]
    between = [layer for each in linear[:-1] for layer in (each, torch.nn.ReLU())]
    network = torch.nn.Sequential(*between, linear[-1]).to(DEVICE.get())
    optimizer = torch.optim.Adam(network.parameters(), config.learning_rate)
    order = torch.randperm(len(x))
    given, wanted = torch.as_tensor(x)[order], torch.as_tensor(action, dtype=torch.float32)[order]
    given, wanted = given.to(DEVICE.get()), wanted.to(DEVICE.get())
    held = max(1, len(x) // 20)
    batches = max(1, (len(x) - held) // config.batch)
    last = config.final_learning_rate / config.learning_rate
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, last, config.epochs * batches)
    for epoch in range(1, config.epochs + 1):
        total = 0.0
        for rows in (held + torch.randperm(len(x) - held)).chunk(batches):
            loss = torch.nn.functional.mse_loss(network(given[rows]), wanted[rows])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            total += loss.item()
        with torch.no_grad():
            held_out = torch.nn.functional.mse_loss(network(given[:held]), wanted[:held]).item()
        show(epoch, total / batches, held_out)
    return linear_layers(network)
