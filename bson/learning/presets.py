"""The algorithms that train a robot, what robots may see as they learn, and the hyperparameters of each."""

import dataclasses
from typing import Any

from bson.agents import learned
from bson.learning.algorithms import PpoConfig, SacConfig
from bson.learning.dagger import DaggerConfig
from bson.learning.imitation import BcConfig
from bson.learning.recurrent_ppo import RecurrentPpoConfig
from bson.learning.recurrent_sac import RecurrentSacConfig
from macid.documents import shown
from macid.files import UsageError
from macid.registry import Kind

ALGORITHMS: dict[str, Any] = {"ppo": PpoConfig(), "sac": SacConfig(), "tac": SacConfig(q=1.2), "bc": BcConfig()}
# Configurations for robots with a recurrent network, and for those that go on from another policy.
RECURRENT: dict[str, Any] = {
    "bc": DaggerConfig(),
    "ppo": RecurrentPpoConfig(),
    "sac": RecurrentSacConfig(),
    "tac": RecurrentSacConfig(q=1.2),
}
# Targets follow ten times as fast as usual: the critics have to come to the values of a policy that is good already.
_STARTED_SAC = RecurrentSacConfig(
    actor_learning_rate=1e-4,
    tau=0.05,
    alpha=0.005,
    log_std=-2.0,
    learning_starts=4096,
    steps_per_update=16,
    warmup=1000,
)
STARTED: dict[str, Any] = {
    "bc": DaggerConfig(rounds=6, learning_rate=5e-4),
    "ppo": RecurrentPpoConfig(learning_rate=1e-4, final_learning_rate=1e-5, log_std=-1.5, warmup=16),
    "sac": _STARTED_SAC,
    "tac": dataclasses.replace(_STARTED_SAC, q=1.2),
}
_PAPER_SAC = SacConfig(hidden=(1024, 1024), alpha=0.2, joint=True)
# Named sets of hyperparameters: {preset: {algorithm: configuration}}.
PRESETS = {
    "fast": ALGORITHMS,
    # The paper's values (secs. IV-C, VI-D). The paper gives no weight of the entropy: it is taken from TAC's authors
    # (Lee et al. 2020).
    "paper": {
        "ppo": PpoConfig(final_learning_rate=1e-3, gamma=0.999, batch=128, epochs=10),
        "sac": _PAPER_SAC,
        "tac": dataclasses.replace(_PAPER_SAC, q=1.2),
        "bc": BcConfig(hidden=(1024, 1024), final_learning_rate=1e-3),
    },
}


def _own(found, name):
    """The user's own algorithm: a dataclass, or its class, with `build(env, seed)`, which gives a stable-baselines3
    model. If it has `export(model)`, that method gives layers and output as algorithms.export does."""
    with KIND.running(name, "making one"):
        found = found() if isinstance(found, type) else found
    if not (dataclasses.is_dataclass(found) and callable(getattr(found, "build", None))):
        raise UsageError(f"Algorithm '{name}' must be a dataclass with a method build(env, seed), not {shown(found)}.")
    return found


KIND: Kind[Any] = Kind("algorithm", ALGORITHMS, own="class", check=_own)


INPUTS = learned.KINDS  # what a robot may see, and the agent that sees it
PUPILS = [name for name, kind in INPUTS.items() if issubclass(kind, learned.Pupil)]  # those with a recurrent network

SHIELDED = [name for name in PUPILS if not INPUTS[name].pictures]  # those who may learn behind a shield: with a LIDAR


def hyperparameters(algo: str, preset: str = "fast", inputs: str = "scans", start: str | None = None) -> Any:
    """The configuration of the algorithm `algo` in a preset; the user's own algorithm has the same one in every preset,
    and those of RECURRENT have that in the preset "fast" for the `inputs` PUPILS, or STARTED from a policy `start`.
    Raises UsageError, naming the valid choices."""
    if preset not in PRESETS:
        raise UsageError(f"Unknown preset {shown(preset)}. Choose one of {', '.join(PRESETS)}.")
    usual = KIND.load(algo)
    if algo in RECURRENT and preset == "fast" and inputs in PUPILS:
        return STARTED.get(algo, RECURRENT[algo]) if start is not None else RECURRENT[algo]
    return PRESETS[preset].get(algo, usual)
