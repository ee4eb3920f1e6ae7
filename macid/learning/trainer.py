"""Many worlds with a crowd that never stops; a rollout and the learning from it are one jitted step."""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from macid import contacts, geometry, scene
from macid.engines import make_engine
from macid.engines.base import repeat
from macid.layout import GOAL_DISTANCE, load_level, sample_goals, sample_people
from macid.learning import copo
from macid.learning import ppo as learning
from macid.learning.config import TrainConfig
from macid.learning.methods import get_method
from macid.learning.state import SEEDS, TrainState
from macid.observation import observe
from macid.pedestrians.learned import to_command
from macid.policy import INPUTS, Policy, inputs, mlp, to_velocity
from macid.reward import individual_reward, neighborhood_mean, neighbors
from macid.state import GOAL_RADIUS, physics_steps

_CELL = 1.0  # side of the squares of the map that share a list of goals [m]
_GOALS = 64  # goals in such a list
_STARTS = 32  # number of crowds from which episodes begin


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
