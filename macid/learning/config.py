"""How a policy is trained: a TrainConfig, and named sets of its fields."""

import dataclasses
from typing import Any

from macid.learning import ppo as learning
from macid.learning.methods import get_method
from macid.learning.scene_trainer import SceneConfig
from macid.policy import ENCOUNTERS, INPUTS
from macid.reward import WEIGHTS, RewardWeights
from macid.state import PHYSICS_STEP, physics_steps

# Named sets of TrainConfig's fields: one that learns more in less time, one for GPUs, and the paper's. At 50
# decisions a second the paper's lambda credits a decision with the rewards of the next 0.4 s, too short to turn away
# from somebody; 0.985 makes it 1.3 s.
PRESETS = {
    "fast": {"ppo": learning.PpoConfig(batch=4096, epochs=2, lam=0.985)},
    # For a GPU: many worlds and short rollouts. In 300 million agent-steps it has as many updates as `fast` has in 30
    # million, each from ten times as many samples.
    "gpu": {
        "ppo": learning.PpoConfig(batch=32_000, epochs=2, lam=0.985),
        "nworld": 1024,
        "rollout": 25,
        "episode": 40,
        "agent_steps": 300_000_000,
    },
    # All values that the paper gives (secs. III-C, IV-C): an update after each episode of T = 1000, M = 1000 episodes,
    # constant rate, eq. 2's advantages and eq. 4's returns without scaling, and the 41 numbers without scaling.
    "paper": {
        "ppo": learning.PpoConfig(
            final_learning_rate=1e-3,
            max_gradient_norm=None,
            reward_scale=1.0,
            standardize=False,
            targets="episode",
            arrival="end",
        ),
        "inputs": "observation",
        "nworld": 1,
        "rollout": 1000,
        "episode": 1,
        "agent_steps": 50_000_000,
    },
    # Two sets with only the paper's batch, epochs and lambda: its method's, then its PPO's. The rest is as in `fast`.
    "paper-batch": {"ppo": learning.PpoConfig()},
    "paper-ppo": {"ppo": learning.PpoConfig(batch=128, epochs=10)},
    # People in small scenes, who learn from gradients instead of samples (macid.learning.scene_trainer), 10 decisions a
    # second.
    "human": {
        "scenes": SceneConfig(),
        "inputs": ENCOUNTERS,
        "period": 0.1,
        "nworld": 1,
        "rollout": 5,
        "episode": 80,
        "agent_steps": 4_060_000,  # 2,000 updates
    },
}


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """How a policy is trained. Lengths in metres, times in seconds."""

    method: str = "macid"
    level: int = 2
    seed: int = 0
    engine: str = "native"
    nworld: int = 16
    period: float = PHYSICS_STEP  # between two decisions
    rollout: int = 125  # decisions between two updates
    episode: int = 8  # rollouts in an episode: 8 x 125 = T = 1000; then a new crowd and new LCFs
    agent_steps: int = 20_000_000  # the budget
    reward: RewardWeights = WEIGHTS
    ppo: learning.PpoConfig = PRESETS["fast"]["ppo"]
    inputs: str = "features"  # the networks' inputs, see macid.policy.INPUTS
    scenes: SceneConfig | None = (
        None  # learning in scenes (macid.learning.scene_trainer), without level, reward and ppo
    )

    @property
    def name(self) -> str:
        """The method, and the differences from the defaults: "macid", "ipo-paper-ppo", "macid-10hz"."""
        presets = [
            name
            for name, fields in PRESETS.items()
            if (fields.get("ppo"), fields.get("inputs", "features")) == (self.ppo, self.inputs)
        ]
        parts = [get_method(self.method).name]
        if self.scenes is not None:
            if self.scenes != SceneConfig():
                parts.append("custom")
        elif "fast" not in presets:
            parts += presets or ["custom"]
        if self.period != (PHYSICS_STEP if self.scenes is None else PRESETS["human"]["period"]):
            parts.append(f"{1 / self.period:.3g}hz")
        return "-".join(parts)

    def __post_init__(self):
        get_method(self.method)
        for name in ("nworld", "rollout", "episode", "agent_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}.")
        physics_steps(self.period)
        if isinstance(self.scenes, dict):
            object.__setattr__(self, "scenes", SceneConfig(**self.scenes))
        in_scenes = get_method(self.method).in_scenes
        if in_scenes != (self.scenes is not None):
            needs = "the preset 'human'" if in_scenes else "another preset than 'human'"
            raise ValueError(f"The method '{self.method}' needs {needs}.")
        if (self.inputs == ENCOUNTERS) != in_scenes or self.inputs not in (*INPUTS, ENCOUNTERS):
            choices = ENCOUNTERS if in_scenes else f"one of {', '.join(INPUTS)}"
            raise ValueError(f"inputs must be {choices}, not '{self.inputs}'.")
        if self.ppo.targets == "episode" and self.episode != 1:
            raise ValueError(
                f"Returns to the episode's end need rollouts of whole episodes: episode must be 1, not {self.episode}."
            )


def preset(name: str, **fields: Any) -> TrainConfig:
    """The TrainConfig of the preset `name`, with `fields` changed, TrainConfig's or its PpoConfig's. Raises ValueError,
    naming the valid presets."""
    if name not in PRESETS:
        raise ValueError(f"Unknown preset '{name}'. Choose one of {', '.join(PRESETS)}.")
    whole = {**PRESETS[name], **fields}
    learned = {field.name for field in dataclasses.fields(learning.PpoConfig)} & fields.keys()
    if learned:
        whole["ppo"] = dataclasses.replace(whole["ppo"], **{field: whole.pop(field) for field in learned})
    return TrainConfig(**whole)


def seeds_of(config: TrainConfig, seeds: int) -> list[TrainConfig]:
    """`config` with its own seed and the following ones, `seeds` in all."""
    return [dataclasses.replace(config, seed=seed) for seed in range(config.seed, config.seed + seeds)]
