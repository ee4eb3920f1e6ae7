"""Training in the scenes of `macid.learning.scenes`, for people who walk like people."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from macid import contacts, encounters, geometry, networks, scene
from macid.engines import make_engine
from macid.engines.base import repeat
from macid.geometry import Array
from macid.learning import ppo as learning
from macid.learning import scenes
from macid.encounter_policy import next_velocity
from macid.pedestrians.learned import goal_command
from macid.state import CrowdState, Traits, physics_steps

_CROWDS = 48  # beginnings of each scene from which episodes are drawn


@dataclasses.dataclass(frozen=True)
class HumanWeights:
    """The weights of a person's costs, per second; a second of walking at the preferred speed earns 1."""

    pace: float = 0.3  # of the squared share by which the speed misses the preferred one
    encounter: float = 0.25  # of the encounters' energy, exp(-tau / 3 s) / tau^2 of each stranger
    most_energy: float = 4.0  # of an encounter's energy
    touch: float = 1.0  # of touching somebody or something
    change: float = 0.05  # of the squared acceleration [(m/s2)^2]
    apart: float = 0.2  # of a companion's distance beyond 1 m [m]
    arrival: float = 0.5  # earned, once


class SceneWalk(NamedTuple):
    """The state of one scene's worlds; leading axes (nworld, K)."""

    physics: Any
    gates: Any  #: (nworld, K, G, 5)
    at: Any  #: int: the gate ahead
    lcf: Any
    preferred: Any  #: [m/s]
    group: Any


def energy(tau: Array, most: float) -> Array:
    """The energy of an encounter whose bodies collide in `tau` [s] (Karamouzas, Skinner, Guy 2014), at most `most`."""
    tau = jnp.maximum(tau, 1e-2)
    return jnp.minimum(jnp.exp(-tau / 3.0) / tau**2, most)


class SceneWorlds:
    noise = 1.0
    rho = 0.85

    def __init__(self, which, nworld, radius, engine, period, companions, rng):
        self.scene, self.nworld, self.period, self.radius = which, nworld, period, radius
        person = dataclasses.replace(scene.PERSON, radius=radius) if hasattr(scene.PERSON, "radius") else scene.PERSON
        model = scene.crowd_spec(which.layout, which.number, person).compile()
        self.engine = make_engine(engine, model, which.number, which.layout.boxes, nworld)
        drawn = scenes.draw(which, rng, _CROWDS, radius, companions)
        self.drawn = jax.tree.map(jnp.asarray, drawn)
        self.substeps = physics_steps(period)

    def begin(self, key, lcf_range, speeds):
        keys = jax.random.split(key, 4)
        shape = (self.nworld, self.scene.number)
        crowd = jax.random.randint(keys[0], shape[:1], 0, _CROWDS)
        position = jnp.asarray(self.drawn.position[crowd], jnp.float32)
        gates, at, group = self.drawn.gates[crowd], self.drawn.first[crowd], self.drawn.group[crowd]
        gates = jnp.asarray(gates, jnp.float32)
        mean, sd, low, high = speeds
        preferred = jnp.clip(mean + sd * jax.random.normal(keys[1], shape), low, high)
        preferred = jnp.take_along_axis(preferred, group, axis=-1)  # companions walk at one speed
        lcf = jax.random.uniform(keys[2], shape, minval=lcf_range[0], maxval=lcf_range[1])
        yaw = jax.random.uniform(keys[3], shape, minval=-jnp.pi, maxval=jnp.pi)
        return SceneWalk(self.engine.init(position, yaw), gates, at, lcf, preferred, group)

    def read(self, walk):
        crowd = self.engine.read(walk.physics)
        return self._with(crowd, walk)

    def _with(self, crowd, walk):
        return crowd._replace(traits=Traits(self._radii(walk), walk.preferred, jnp.full(walk.lcf.shape, 2.0), walk.group))

    def _radii(self, walk):
        return jnp.full(walk.lcf.shape, self.radius, jnp.float32)

    def goals(self, walk, position):
        gate = jnp.take_along_axis(walk.gates, walk.at[..., None, None], axis=-2)[..., 0, :]
        return gate, scenes.goal(gate, position)

    def rollout(self, parameters, walk_, key, length, weights):
        policy, dt = parameters["policy"], self.period
        boxes = self.engine.boxes

        def see(crowd, walk_):
            gate, goals = self.goals(walk_, crowd.position)
            observed = encounters.observe(crowd, boxes, goals)
            return gate, goals, networks.encounter_inputs(observed, walk_.lcf)

        def one(carry, key):
            walk_, crowd, drift = carry
            gate, goals, x = see(crowd, walk_)
            noise = self.noise * jax.random.normal(key, (*x.shape[:-1], 2))
            fresh = networks.encounter_network(policy["layers"], x) + jnp.exp(policy["log_std"]) * noise
            action = fresh + drift
            drift = self.rho * (drift + jnp.exp(policy["log_std"]) * noise)
            logp = learning.gaussian_log_density(noise, policy["log_std"])
            own = geometry.to_frame(crowd.velocity, encounters.towards(crowd, goals))
            command = goal_command(next_velocity(action, own, walk_.preferred, dt), crowd, goals, dt)

            def substep(carried):
                state, _, touched, pairs = carried
                state = self.engine.step(state, command)
                after = self.engine.read(state)
                return state, after, touched + after.contact, pairs

            touched = jnp.zeros(crowd.contact.shape, jnp.int32)
            state, after, touched, _ = repeat(substep, (walk_.physics, crowd._replace(traits=Traits(radius=crowd.traits.radius)), touched, 0), self.substeps)
            after = self._with(after, walk_)
            before = geometry.norm(goals - crowd.position)
            progress = before - geometry.norm(scenes.goal(gate, after.position) - after.position)
            through = scenes.passed(gate, after.position)
            p = walk_.preferred
            speed = geometry.norm(after.velocity)
            meet = self.encounter_energy(after, weights)
            touch = touched / self.substeps
            change = geometry.norm(after.velocity - crowd.velocity) / dt
            apart = self.apart(after)
            costs = {
                "pace": weights.pace * dt * ((speed - p) / p) ** 2,
                "encounter": weights.encounter * dt * meet,
                "touch": weights.touch * dt * touch,
                "change": weights.change * dt * change**2,
                "apart": weights.apart * dt * apart,
            }
            reward = jnp.minimum(progress, p * dt) / p + weights.arrival * through - sum(costs.values())
            shared = -(costs["encounter"] + costs["touch"])
            at = jnp.where(through, (walk_.at + 1) % walk_.gates.shape[-2], walk_.at)
            step = {"x": x, "critic": x, "action": fresh, "log_probability": logp, "individual": reward,
                    "neighborhood": shared, "arrived": through, "lcf": walk_.lcf,
                    "speed": speed, "p": p, "touch": touch, **{f"c_{k}": v for k, v in costs.items()},
                    "position": after.position, "velocity": after.velocity}
            return (walk_._replace(physics=state, at=at), after, drift), step

        keys = jax.random.split(key, length)
        (walk_, crowd, _), steps = jax.lax.scan(one, (walk_, self.read(walk_), jnp.zeros((*walk_.lcf.shape, 2))), keys)
        return walk_, steps, see(crowd, walk_)[2]

    def encounter_energy(self, crowd, weights):
        position = crowd.position[..., None, :, :] - crowd.position[..., :, None, :]
        velocity = crowd.velocity[..., None, :, :] - crowd.velocity[..., :, None, :]
        tau = encounters.time_to_collision(position, velocity, jnp.asarray(2 * self.radius, jnp.float32))
        group = crowd.traits.group
        strangers = group[..., None, :] != group[..., :, None]
        e = jnp.where(strangers, energy(tau, weights.most_energy), 0.0)
        return jnp.minimum(jnp.sum(e, axis=-1), 2 * weights.most_energy)

    def apart(self, crowd):
        position = crowd.position[..., None, :, :] - crowd.position[..., :, None, :]
        group = crowd.traits.group
        together = (group[..., None, :] == group[..., :, None]) & ~jnp.eye(group.shape[-1], dtype=bool)
        beyond = jnp.clip(geometry.norm(position) - 1.0, 0.0, 3.0)
        return jnp.sum(together * beyond, axis=-1) / jnp.maximum(jnp.sum(together, axis=-1), 1)


@dataclasses.dataclass(frozen=True)
class HumanConfig:
    seed: int = 0
    agent_steps: int = 10_000_000
    nworld: int = 4
    rollout: int = 50
    episode: int = 8
    period: float = 0.1
    radius: float = 0.2
    companions: float = 0.5
    lcf: tuple = (-2.0, 2.0)
    care: float = 0.5
    speeds: tuple = (1.34, 0.3, 0.5, 2.0)
    engine: str = "native"
    weights: HumanWeights = HumanWeights()
    ppo: Any = learning.PpoConfig(batch=4096, epochs=2, gamma=0.97, lam=0.9, reward_scale=1.0, log_std=-1.5, learning_rate=1e-3)


class HumanTrainer:
    critics = ("individual", "neighborhood")

    def __init__(self, config: HumanConfig):
        self.config = config
        rng = np.random.default_rng(0x5CE7E)
        self.worlds = [SceneWorlds(s, config.nworld, config.radius, config.engine, config.period, config.companions, rng)
                       for s in scenes.SCENES.values()]
        self.samples = config.rollout * config.nworld * sum(w.scene.number for w in self.worlds)
        self.iterations = -(-config.agent_steps // self.samples)
        batches = max(1, self.samples // config.ppo.batch)
        self.optimizer = learning.make_optimizer(config.ppo, self.iterations * config.ppo.epochs * batches, ("policy", *self.critics))
        self.iterate = jax.jit(self._iterate)
        self._begin_j = jax.jit(self._begin)

    def init(self, seed):
        key, kp, kw = jax.random.split(jax.random.key(seed), 3)
        parameters = self.parameters(kp)
        return (parameters, self.optimizer.init(parameters), self._begin_j(kw), key, jnp.zeros((), jnp.int32))

    def parameters(self, key):
        ks = jax.random.split(key, 6)

        def net(k1, k2, out, scale):
            n = networks.ENCODED
            person = learning.init_mlp(k1, (networks.PERSON, n, n + 1), 1.0)
            head = learning.init_mlp(k2, (networks.OWN + 2 * n, 64, 64, out), scale)
            return {"person": person, "head": head}

        return {
            "policy": {"layers": net(ks[0], ks[1], 2, 0.01), "log_std": jnp.full(2, self.config.ppo.log_std, jnp.float32)},
            "individual": net(ks[2], ks[3], 1, 1.0),
            "neighborhood": net(ks[4], ks[5], 1, 1.0),
        }

    def _begin(self, key):
        keys = jax.random.split(key, len(self.worlds))
        return tuple(w.begin(k, self.config.lcf, self.config.speeds) for w, k in zip(self.worlds, keys, strict=True))

    def _iterate(self, state):
        parameters, optimizer, walks, key, iteration = state
        c = self.config
        key, kr, ku, kb = jax.random.split(key, 4)
        keys = jax.random.split(kr, len(self.worlds))
        data, after, logs = [], [], {}
        for w, walk_, k in zip(self.worlds, walks, keys, strict=True):
            walk_, steps, last = w.rollout(parameters, walk_, k, c.rollout, c.weights)
            after.append(walk_)
            est = {}
            for name in self.critics:
                values, last_value = (networks.encounter_network(parameters[name], s)[..., 0] for s in (steps["critic"], last))
                est[name] = learning.gae(c.ppo.reward_scale * steps[name], values, last_value, c.ppo.gamma, c.ppo.lam,
                                         steps["arrived"] if name == "individual" else None)
            advantage = est["individual"][0] + c.care * steps["lcf"] * est["neighborhood"][0]
            d = {n: steps[n] for n in ("x", "critic", "action", "log_probability")}
            d |= {"advantage": advantage, **{f"return_{n}": e[1] for n, e in est.items()}}
            data.append(jax.tree.map(lambda a: a.reshape(-1, *a.shape[3:]), d))
            logs[w.scene.name] = jnp.stack([jnp.mean(steps["speed"] / steps["p"]), jnp.mean(steps["touch"]), jnp.mean(steps["individual"])]
                                           + [jnp.mean(steps[n]) / c.period for n in ("c_pace", "c_encounter", "c_touch", "c_change", "c_apart")])
        data = jax.tree.map(lambda *a: jnp.concatenate(a), *data)
        a = data["advantage"]
        data["advantage"] = (a - jnp.mean(a)) / (jnp.std(a) + 1e-8)
        parameters, optimizer = learning.update(parameters, self.optimizer, optimizer, data, ku, c.ppo, networks.encounter_network)
        iteration = iteration + 1
        walks = jax.lax.cond(iteration % c.episode == 0, lambda: self._begin(kb), lambda: tuple(after))
        logs["std"] = jnp.exp(parameters["policy"]["log_std"])
        return (parameters, optimizer, walks, key, iteration), logs
