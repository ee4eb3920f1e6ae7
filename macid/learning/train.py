"""The training loop: many worlds with a crowd that never stops; a rollout and the learning from it are one jitted
step."""

import contextlib
import dataclasses
import os
import pathlib
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import msgspec
import numpy as np

from macid import contacts, geometry, scene, start
from macid.engines import engine_kind, make_engine
from macid.engines.base import repeat
from macid.executors import Executor
from macid.files import UsageError, lock_folder, versions
from macid.layout import GOAL_DISTANCE, load_level, sample_goals, sample_people
from macid.learning import copo
from macid.learning import ppo as learning
from macid.learning.curves import (
    CHECKPOINT,
    FILES,
    Board,
    check_arrays,
    check_tensorboard,
    damaged,
    plain,
    read_checkpoint,
    thin,
    training_folder,
    write_checkpoint,
    write_curve,
)
from macid.learning.jobs import Group, folder_of, train_groups
from macid.learning.methods import get_method
from macid.learning.scene_trainer import SceneConfig, SceneTrainer
from macid.learning.state import SEEDS, TrainState
from macid.observation import observe
from macid.pedestrians.learned import to_command
from macid.policy import ENCOUNTERS, INPUTS, Policy, inputs, load_policy, mlp, to_velocity
from macid.reward import WEIGHTS, RewardWeights, individual_reward, neighborhood_mean, neighbors
from macid.state import GOAL_RADIUS, PHYSICS_STEP, physics_steps

_CELL = 1.0  # side of the squares of the map that share a list of goals [m]
_GOALS = 64  # goals in such a list
_STARTS = 32  # number of crowds from which episodes begin


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


class Walk(NamedTuple):
    """The state of a training's worlds; leading axes (nworld, K)."""

    physics: Any
    goals: Any
    lcf: Any
    reached: Any  #: goals reached in this episode so far
    contact: Any  #: steps of 0.02 s in contact, in this episode so far


def _figures(walk):
    """The figures of an episode for the progress, over all people: SR10 [%], the share that reached a goal with fewer
    than 10 steps in contact; CP, steps in contact per person; arrived [%], the share that reached a goal; goals, the
    number reached per person."""
    arrived = walk.reached > 0
    return {
        "SR10": 100.0 * jnp.mean(arrived & (walk.contact < 10)),
        "CP": jnp.mean(walk.contact * 1.0),
        "arrived": 100.0 * jnp.mean(arrived),
        "goals": jnp.mean(walk.reached * 1.0),
    }


class Trainer:
    """Trains policies. `iterate` is a pure jitted function of one seed's TrainState, `iterate_seeds` of stacked ones.

    devices: share the work, where the engine can (`Engine.shards`). With one seed its worlds are shared among the
    devices, with several seeds the seeds, which then run apart. Raises ValueError where it can't.
    """

    def __init__(self, config: TrainConfig, devices: Sequence[Any] | None = None):
        self.config, self.method = config, get_method(config.method)
        self._see, self._seen = INPUTS[config.inputs]
        layout = load_level(config.level)
        self.number = layout.people
        model = scene.crowd_spec(layout, self.number).compile()
        self.engine = make_engine(config.engine, model, self.number, layout.boxes, config.nworld)
        if devices and not self.engine.shards:
            raise ValueError(f"The engine '{config.engine}' runs on one device, not on {len(devices)}.")
        self.samples = config.nworld * self.number * config.rollout  # agent-steps in an iteration
        self.iterations = -(-config.agent_steps // self.samples)
        batches = max(1, self.samples // config.ppo.batch)
        networks = ("policy", *self.method.critics)
        self.optimizer = learning.make_optimizer(config.ppo, self.iterations * config.ppo.epochs * batches, networks)
        rng = np.random.default_rng(0x7EA1)
        starts = [sample_people(rng, layout, self.number) for _ in range(_STARTS)]
        goals = [sample_goals(rng, layout, s) for s in starts]
        self._starts, self._goals = jnp.asarray(starts, jnp.float32), jnp.asarray(goals, jnp.float32)
        cells = round(layout.size / _CELL)
        line = (np.arange(cells) + 0.5) * _CELL - layout.size / 2
        centres = np.repeat(np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2), _GOALS, axis=0)
        corner = _CELL / 2**0.5  # from the cell's middle to a corner, so that a goal fits from everywhere in the cell
        fitting = sample_goals(rng, layout, centres, (GOAL_DISTANCE[0] + corner, GOAL_DISTANCE[1] - corner))
        self._fitting = jnp.asarray(fitting.reshape(cells, cells, _GOALS, 2), jnp.float32)
        self._mesh = jax.sharding.Mesh(np.array(devices), ("device",)) if devices else None
        self._begin_jitted, self._spread_jitted = jax.jit(self._begin), jax.jit(self._spread)
        self.iterate = jax.jit(self._iterate)
        self.iterate_seeds = jax.jit(self._iterate_seeds)

    def init(self, seed: int | None = None) -> TrainState:
        """The TrainState of `seed` (default: the config's) before the first iteration."""
        seed = self.config.seed if seed is None else seed
        key, key_parameters, key_walk = jax.random.split(jax.random.key(seed), 3)
        parameters = learning.init_parameters(
            key_parameters, self.config.ppo, self.method.critics, self.method.mean_field, self._seen
        )
        meta = copo.init() if self.method.meta else None
        walk = self._begin_jitted(key_walk, meta)
        zero = jnp.zeros((), jnp.int32)
        return TrainState(parameters, self.optimizer.init(parameters), meta, walk, _figures(walk), key, zero)

    def init_seeds(self, seeds: Iterable[int]) -> TrainState:
        """The TrainStates of `seeds`, stacked."""
        states = [self.init(seed) for seed in seeds]
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
        return self._spread_jitted(stacked._replace(iteration=states[0].iteration))

    def seed_state(self, states: TrainState, index: int) -> TrainState:
        """The TrainState at `index` of stacked TrainStates."""
        one = jax.tree.map(lambda leaf: leaf[index], states._replace(iteration=None))
        return one._replace(iteration=states.iteration)

    def _iterate_seeds(self, states):
        states, log = jax.vmap(self._iterate, (SEEDS,), (SEEDS, 0))(states)
        return self._spread(states), log

    def _spread(self, states):
        """Stacked TrainStates, each seed on a device of its own, or, where the seeds don't divide among the devices,
        the worlds of each seed shared among all devices."""
        mesh = self._mesh
        if mesh is None:
            return states
        seeds, devices = len(states.walk.lcf), mesh.size

        def laid(tree, *axes):
            sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec(*axes))
            return jax.tree.map(lambda leaf: jax.lax.with_sharding_constraint(leaf, sharding), tree)

        if seeds % devices == 0:
            return laid(states._replace(iteration=None), "device")._replace(iteration=laid(states.iteration))
        if self.config.nworld % devices:
            raise ValueError(f"Neither {seeds} seeds nor {self.config.nworld} worlds divide among {devices} devices.")
        return laid(states._replace(walk=None))._replace(walk=laid(states.walk, None, "device"))

    def check(self) -> None:
        """Raises EngineOverflow where the engine had too little room (`Engine.check`)."""
        self.engine.check()

    def policy(self, state: TrainState, recipe: dict[str, Any]) -> Policy:
        """The Policy of a TrainState."""
        layers = tuple((np.asarray(w), np.asarray(b)) for w, b in state.parameters["policy"]["layers"])
        return Policy(layers, recipe)

    def _begin(self, key, meta):
        """A new episode in every world: crowd, goals, and each person's LCF."""
        key_crowd, key_yaw, key_lcf = jax.random.split(key, 3)
        shape = (self.config.nworld, self.number)
        crowd = jax.random.randint(key_crowd, shape[:1], 0, _STARTS)
        yaw = jax.random.uniform(key_yaw, shape, minval=-jnp.pi, maxval=jnp.pi)
        if self.method.meta:
            lcf = copo.draw(meta.distribution, key_lcf, shape)
        else:
            low, high = self.method.lcf
            lcf = jax.random.uniform(key_lcf, shape, minval=low, maxval=high)
        none = jnp.zeros(shape, jnp.int32)
        return Walk(self.engine.init(self._starts[crowd], yaw), self._goals[crowd], lcf, none, none)

    def _new_goals(self, key, position):
        """A goal for each of `position` (nworld, K, 2), in free space and at a fitting distance."""
        cells = self._fitting.shape[0]
        cell = jnp.clip((position / _CELL + cells / 2).astype(jnp.int32), 0, cells - 1)
        return self._fitting[cell[..., 0], cell[..., 1], jax.random.randint(key, position.shape[:-1], 0, _GOALS)]

    def _critic_input(self, x, seen, action, position):
        if not self.method.mean_field:
            return x
        others = jnp.concatenate([seen, action], axis=-1)
        return jnp.concatenate([x, neighborhood_mean(others, neighbors(position))], axis=-1)

    def _rollout(self, parameters, walk, key):
        """`rollout` decisions of every agent: the walk after them, the transitions (T, nworld, K, ...) and the last
        critic input, which bootstraps the values."""
        config, policy = self.config, parameters["policy"]
        substeps = physics_steps(config.period)

        def act(crowd, goals, key):
            seen = self._see(observe(crowd, self.engine.boxes, goals))
            x = inputs(seen, walk.lcf)
            noise = jax.random.normal(key, (*x.shape[:-1], 2))
            action = mlp(policy["layers"], x) + jnp.exp(policy["log_std"]) * noise
            log_probability = learning.gaussian_log_density(noise, policy["log_std"])
            return x, self._critic_input(x, seen, action, crowd.position), action, log_probability

        def one(carry, key):
            state, crowd, goals = carry
            key_action, key_goal = jax.random.split(key)
            x, critic, action, log_probability = act(crowd, goals, key_action)
            command = to_command(to_velocity(action), crowd.yaw)

            def substep(carried):
                state, _, steps_in_contact, pairs = carried
                state = self.engine.step(state, command)
                after = self.engine.read(state)
                steps_in_contact = steps_in_contact + after.contact
                return state, after, steps_in_contact, pairs | contacts.touching_people(after.position)

            steps_in_contact = jnp.zeros(crowd.contact.shape, jnp.int32)
            pairs = jnp.zeros((*crowd.contact.shape, self.number), bool)  # who touched whom
            carried = repeat(substep, (state, crowd, steps_in_contact, pairs), substeps)
            state, after, steps_in_contact, pairs = carried
            before_distance = geometry.norm(goals - crowd.position)
            distance = geometry.norm(goals - after.position)
            arrived = distance <= GOAL_RADIUS
            reward = individual_reward(before_distance - distance, arrived, steps_in_contact > 0, config.reward)
            shared = self.method.shared(reward, after.position, jnp.sum(pairs, axis=-1), config.reward)
            goals = jnp.where(arrived[..., None], self._new_goals(key_goal, after.position), goals)
            step = {
                "x": x,
                "critic": critic,
                "action": action,
                "log_probability": log_probability,
                "individual": reward,
                "neighborhood": shared,
                "global": jnp.broadcast_to(jnp.mean(reward, axis=-1, keepdims=True), reward.shape),
                "arrived": arrived,
                "contact": steps_in_contact,
            }
            return (state, after, goals), step

        keys = jax.random.split(key, config.rollout + 1)
        start = (walk.physics, self.engine.read(walk.physics), walk.goals)
        (state, crowd, goals), steps = jax.lax.scan(one, start, keys[:-1])
        last = act(crowd, goals, keys[-1])[1]
        reached, contact = (jnp.sum(steps[name], axis=0, dtype=jnp.int32) for name in ("arrived", "contact"))
        return Walk(state, goals, walk.lcf, walk.reached + reached, walk.contact + contact), steps, last

    def _estimates(self, parameters, steps, last):
        """{critic: (advantages, returns)} from a rollout's transitions, each (T, nworld, K)."""
        ppo, estimates = self.config.ppo, {}
        for name in self.method.critics:
            reward, gamma = ppo.reward_scale * steps[name], ppo.gamma
            values, last_value = (mlp(parameters[name], seen)[..., 0] for seen in (steps["critic"], last))
            if name == "global":  # CoPO's gamma is 1: without an episode's end, the value of the reward above its mean
                gamma, reward = 1.0, reward - jnp.mean(reward)
            redrawn = steps["arrived"] if name == "individual" else None
            if ppo.targets == "episode":  # no reward comes after the episode
                last_value = jnp.zeros_like(last_value)
            advantage, returns = learning.gae(reward, values, last_value, gamma, ppo.lam, redrawn, ppo.arrival)
            if ppo.targets == "episode":
                returns = learning.discounted_returns(reward, gamma, redrawn if ppo.arrival == "end" else None)
            estimates[name] = advantage, returns
        return estimates

    def _experience(self, state, walk, steps, last):
        """The samples for an update, from a rollout's transitions: {name: array (samples, ...)}."""
        config = self.config
        estimates = self._estimates(state.parameters, steps, last)
        lcf = jnp.broadcast_to(walk.lcf, steps["individual"].shape)
        shared = estimates["neighborhood"][0] if "neighborhood" in estimates else 0.0
        advantage = learning.coordinated_advantage(
            estimates["individual"][0], shared, lcf, self.method.coordination, config.ppo.standardize
        )
        data = {
            **{name: steps[name] for name in ("x", "critic", "action", "log_probability")},
            "advantage": advantage,
            **{f"return_{name}": returns for name, (_, returns) in estimates.items()},
        }
        if self.method.meta:
            data |= {f"advantage_{name}": estimate for name, (estimate, _) in estimates.items()}
            data["lcf"] = lcf
        return jax.tree.map(lambda a: a.reshape(self.samples, *a.shape[3:]), data)

    def _iterate(self, state: TrainState):
        """A rollout and an update: the next TrainState, and scalars to log."""
        config = self.config
        key, key_rollout, key_update, key_begin = jax.random.split(state.key, 4)
        walk, steps, last = self._rollout(state.parameters, state.walk, key_rollout)
        data = self._experience(state, walk, steps, last)
        parameters, optimizer = learning.update(
            state.parameters, self.optimizer, state.optimizer, data, key_update, config.ppo
        )
        meta = state.meta
        if self.method.meta:
            meta = copo.update(meta, state.parameters["policy"], parameters["policy"], data, config.ppo)
        iteration = state.iteration + 1
        over = iteration % config.episode == 0
        told = over | (iteration < config.episode)
        figures = jax.tree.map(lambda new, old: jnp.where(told, new, old), _figures(walk), state.figures)
        walk = jax.lax.cond(over, lambda: self._begin(key_begin, meta), lambda: walk)
        log = {
            **figures,
            "reward": jnp.mean(steps["individual"]),
            "speed": jnp.mean((jnp.clip(steps["action"][..., 0], -1, 1) + 1) * 0.75),
            "std": jnp.mean(jnp.exp(parameters["policy"]["log_std"])),
        }
        if self.method.meta:
            log["lcf_mean"], log["lcf_std"] = copo.moments(meta.distribution)
        return TrainState(parameters, optimizer, meta, walk, figures, key, iteration), log


def seeds_of(config: TrainConfig, seeds: int) -> list[TrainConfig]:
    """`config` with its own seed and the following ones, `seeds` in all."""
    return [dataclasses.replace(config, seed=seed) for seed in range(config.seed, config.seed + seeds)]


def train(
    config: TrainConfig,
    out: str | os.PathLike[str],
    seeds: int = 1,
    resume: bool = False,
    show: Callable[[str], object] = print,
    minutes_between_checkpoints: float = 2.0,
    tensorboard: bool = False,
) -> list[Policy]:
    """Trains `seeds` seeds at once to the budget, the config's seed and the following ones; returns their Policies.

    Writes policy.npz and .json, config.json and curve.csv in `out`/NAME-SEED (TrainConfig.name), and now and then a
    checkpoint of all seeds in the first seed's folder. Several devices share the work, with an engine that can (MJX).

    tensorboard: whether each seed's curve is logged for TensorBoard too (see curves.Board). resume: goes on from the
    checkpoint, if there is one, exactly where it stopped, and one seed after the other where the seeds were begun so
    (`train_apart`). Ctrl-C leaves a checkpoint, once there is something to keep. Raises ValueError if the checkpoint
    has another configuration or another process trains there, FloatingPointError if the training diverges.

    The same config gives the same policy, bit for bit, on as many CPU cores. On another number of cores XLA shares the
    sums over a batch among another number of threads, and so rounds them differently, in the first update already. The
    environment variable NPROC, set before JAX begins, is the number of XLA's threads: with NPROC=2, one core gives the
    policy of two.
    """
    configs = seeds_of(config, seeds)
    paths = [pathlib.Path(out) / folder_of(each) for each in configs]
    if tensorboard:
        check_tensorboard()
    if resume and seeds > 1 and _begun_apart(paths):
        each = [train(one, out, 1, True, show, minutes_between_checkpoints, tensorboard) for one in configs]
        return [policy for (policy,) in each]
    with contextlib.ExitStack() as held:
        for path in paths:
            held.enter_context(lock_folder(path, FILES, alone=("config.json",)))
        return _train(configs, paths, resume, show, minutes_between_checkpoints, held if tensorboard else None)


def _begun_apart(paths):
    """Whether the trainings in the folders `paths` were begun one by one, each with a checkpoint of its own."""
    if any((path / CHECKPOINT).exists() for path in paths[1:]):
        return True
    saved = read_checkpoint(paths[0], _Noted)
    return saved is not None and len(saved[1]["configs"]) == 1


def train_apart(
    executor: Executor,
    configs: Iterable[TrainConfig],
    out: str | os.PathLike[str],
    resume: bool = False,
    show: Callable[[str], object] = print,
) -> list[pathlib.Path]:
    """Trains `configs` side by side on an executor of several workers; returns their folders.

    Each config gives the policy of `train` with its seed alone, bit for bit; seeds that `train` had begun at once go on
    at once, as one job. Ctrl-C leaves the last checkpoints that arrived, at most some minutes old. Raises as `train`
    does.
    """
    groups, left = [], list(configs)
    while left:
        first = left[0]
        saved = read_checkpoint(pathlib.Path(out) / folder_of(first), _Noted) if resume else None
        together = saved[1]["configs"] if saved else [plain(first)]
        group = [each for each in left if plain(each) in together]
        if len(group) < len(together):
            raise UsageError(
                f"What is in '{pathlib.Path(out) / folder_of(first)}' is of {len(together)} seeds, not {len(group)}: "
                "go on with all of them, or use another --out."
            )
        group = group or [first]  # a training of another configuration, which it refuses itself
        groups.append(Group(_train_here, tuple(group)))
        left = [each for each in left if each not in group]

    def told(config, line):
        show(f"{folder_of(config)}: {line}")

    return train_groups(executor, groups, out, resume, told, is_done)


def _train_here(configs, out, show):
    """The function `train` of a Group (macid.learning.jobs)."""
    train(configs[0], out, len(configs), resume=True, show=show)


def is_done(config: TrainConfig, folder: pathlib.Path) -> bool:
    """Whether the training `config` has its policy, to the last step, in `folder`."""
    try:
        recipe = load_policy(str(folder / "policy.npz")).recipe
    except ValueError:
        return False
    wanted = plain(config)
    return recipe.get("agent_steps_done", 0) >= config.agent_steps and all(recipe.get(k) == wanted[k] for k in wanted)


def _train(configs, paths, resume, show, minutes_between_checkpoints, held):
    """`train`, of `configs` in the folders `paths`, locked. held: an ExitStack that closes Boards, or None."""
    config, seeds = configs[0], len(configs)
    kind, _ = engine_kind(config.engine)
    folders = [training_folder(path, each, resume) for path, each in zip(paths, configs, strict=True)]
    saved = read_checkpoint(folders[0], _Noted)
    several = kind.shards and jax.device_count() > 1
    make = Trainer if config.scenes is None else SceneTrainer
    trainer = make(config, jax.devices() if several else None)
    states, curves, spent = trainer.init_seeds([each.seed for each in configs]), [[] for _ in configs], 0.0
    if saved:
        states, curves, spent = _restored(*saved, folders[0] / CHECKPOINT, configs, states)
        show(f"resumed at iteration {len(curves[0])} of {trainer.iterations}")
    boards = []
    if held is not None:
        boards = [held.enter_context(Board(*each)) for each in zip(folders, curves, strict=True)]

    def save():
        noted = {"configs": [plain(each) for each in configs], "curves": curves, "seconds": spent}
        write_checkpoint(folders[0], _named(states), noted)
        for folder, curve in zip(folders, curves, strict=True):
            write_curve(folder / "curve.csv", curve)

    begin = last_save = last_show = time.monotonic()
    before, begun = spent, len(curves[0])
    done = begun
    with start.deferred(lambda: done > begun) as interrupted:
        while done < trainer.iterations:
            try:
                following, logs = trainer.iterate_seeds(states)
                logs = jax.device_get(logs)
                trainer.check()
            except KeyboardInterrupt:
                if done > begun:
                    save()
                raise
            states, done = following, done + 1
            now = time.monotonic()
            spent = before + now - begin
            steps = done * trainer.samples
            for index, curve in enumerate(curves):
                values = {name: float(value[index]) for name, value in logs.items()}
                curve.append({"agent_steps": steps, "seconds": round(spent, 2), **values})
                if wrong := [name for name, value in values.items() if not np.isfinite(value)]:
                    raise FloatingPointError(
                        f"Training of seed {configs[index].seed} diverged at iteration {done}: "
                        f"the {wrong[0]} is {values[wrong[0]]}."
                    )
            for place, board in enumerate(boards):
                board.write(curves[place][-1])
            if now - last_show > 5.0 or done == trainer.iterations:
                last_show = now
                figures = "  ".join(f"{name} {value.mean():.3g}" for name, value in logs.items())
                show(
                    f"{steps / 1e6:7.2f}M of {config.agent_steps / 1e6:.0f}M  "
                    f"{seeds * steps / spent:,.0f} agent-steps/s  {figures}"
                )
            if now - last_save > 60 * minutes_between_checkpoints:
                last_save = now
                save()
            if interrupted():
                save()
                raise KeyboardInterrupt
    save()
    policies = []
    for index, (each, folder, curve) in enumerate(zip(configs, folders, curves, strict=True)):
        state = trainer.seed_state(states, index)
        recipe = {
            "name": each.name,
            **plain(each),
            "agent_steps_done": done * trainer.samples,
            "seconds": round(spent / seeds, 1),
        }
        if state.meta is not None:
            recipe["lcf_mean"], recipe["lcf_std"] = map(float, copo.moments(state.meta.distribution))
        recipe["versions"] = versions("bson-macid", "mujoco", "mujoco-mjx", "jax", "optax", "numpy")
        recipe["curve"] = [{name: round(value, 4) for name, value in row.items()} for row in thin(curve, 60)]
        policies.append(trainer.policy(state, recipe))
        policies[-1].save(folder / "policy")
    return policies


class _Noted(msgspec.Struct):
    """A checkpoint's values beside a training's state."""

    configs: list[dict]
    curves: list[list[dict[str, float]]]
    seconds: float


def _restored(found, noted, path, configs, like):
    """(states, curves, seconds) from the arrays `found` and the values `noted` in the checkpoint `path` of a training
    of `configs`. like: states of that training, for their shapes. Raises UsageError."""
    wanted = _named(like)
    if noted["configs"] != [plain(each) for each in configs]:
        raise UsageError(f"'{path}' is of {len(noted['configs'])} seeds, not {len(configs)}. Use another --out.")
    try:
        check_arrays(found, wanted)
        states = jax.tree.unflatten(
            jax.tree.structure(like),
            [_restore(found[name], leaf) for name, leaf in zip(wanted, jax.tree.leaves(like), strict=True)],
        )
        done = {len(curve) for curve in noted["curves"]} | {int(states.iteration)}
        if len(noted["curves"]) != len(configs) or len(done) != 1:
            raise ValueError("the curves are not as long as the training")
    except ValueError as error:
        raise damaged(path, error) from None
    return states, noted["curves"], noted["seconds"]


def _named(states):
    """All leaves of `states`, in their order, as {name: NumPy array}."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(states)
    return {jax.tree_util.keystr(path): _keep(leaf) for path, leaf in leaves}


def _keep(x):
    return np.asarray(jax.random.key_data(x)) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else np.asarray(x)


def _restore(saved, like):
    if jnp.issubdtype(like.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(jnp.asarray(saved))
    return jnp.asarray(saved)
