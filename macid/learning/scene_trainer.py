"""Training in the scenes of `macid.learning.scenes` by analytic policy gradients, for people who walk like people.

Each person's cost follows from its own state, given everybody else's course: the gradient of that cost goes back
through the person's own decisions alone, and so each learns its best answer to the others, as in independent PPO (eq.
3), with a gradient in place of an estimate from samples (Freeman et al. 2021, Brax; Xu et al. 2022, SHAC). The states
are those of the physics engine; on the way back, a body is taken to follow its command (a straight-through gradient),
which holds but for contacts.

A rollout is short, half a second: what a course leads to is in its costs, since a collision course costs before the
collision. So there are many updates, which is what teaches anticipation: with rollouts of 2 s people learned to brake
before each other, and little else, from as many agent-steps.

What a person wants, per second (`costs`): to walk at its preferred speed to its goal; not to change its velocity; and,
with the weight 1 + care LCF, not to come close to a collision and not to touch. A collision course costs both people
the same, so that the LCF says how much the others' costs count beside one's own, which is eq. 2's role.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from macid import encounters, geometry, networks, scene
from macid.encounter_policy import EncounterPolicy, next_velocity
from macid.engines import make_engine
from macid.engines.base import repeat
from macid.geometry import Array
from macid.learning import scenes
from macid.learning.methods import get_method
from macid.learning.ppo import init_mlp
from macid.learning.state import SEEDS, TrainState
from macid.pedestrians.learned import goal_command
from macid.policy import HIDDEN
from macid.state import TOP_SPEED, CrowdState, Traits, physics_steps
from macid.traits import HUMAN, HUMAN_RANGE, HUMAN_SPEED

_CROWDS = 48  # beginnings of each scene from which episodes are drawn
_HOLD = jax.lax.stop_gradient


@dataclasses.dataclass(frozen=True)
class SceneConfig:
    """How people learn in scenes, beside macid.learning.config.TrainConfig. Costs are per second."""

    radius: float = 0.2  # of a body [m]
    companions: float = 0.5  # share of people who walk in pairs and threes
    speeds: tuple[float, float, float, float] = (*HUMAN_SPEED, *HUMAN_RANGE)  # preferred: mean, SD, least, most [m/s]
    care: float = 0.5  # how much an LCF of 1 adds to the weight of others' costs
    noise: float = 0.1  # in the actions, so that people see more than one course
    learning_rate: float = 3e-3
    final_learning_rate: float = 1e-4
    most_gradient: float = 1.0  # of a person's cost, after its state at a decision
    pace: float = 2.0  # of the squared difference of the speed ahead from the preferred one, in its share
    aside: float = 2.0  # of the squared speed aside, in the preferred one's share
    change: float = 0.03  # of the squared acceleration [(m/s2)^2]
    meet: float = 1.1  # of the energy of collision courses
    crowding: float = 2.0  # number of people near by that halves the weight of collision courses
    reach: float = 0.25  # by how much two bodies that miss each other still count [m]
    fade: float = 3.0  # with which a later collision costs less [s]
    touch: float = 2.0  # of bodies and walls that are touched
    headway: float = 1.1  # of the room that is missing behind a person who walks ahead [m]
    headway_time: float = 0.6  # by which that room grows with speed [s]; 1.06 in single file (Seyfried et al. 2005)
    apart: float = 0.3  # of a companion's distance beyond 1 m [m]


class SceneWalk(NamedTuple):
    """The state of one scene's worlds; leading axes (nworld, K)."""

    physics: Any
    gates: Any  #: (nworld, K, G, 5), each person's loop
    ahead: Any  #: int: the number of the gate ahead
    lcf: Any
    traits: Traits


@jax.custom_vjp
def _tamed(x: Array, most: float) -> Array:
    """`x` (..., 2), whose gradient is no longer than `most`; one that is not finite is none."""
    return x


def _tamed_forward(x, most):
    return x, most


def _tamed_backward(most, gradient):
    gradient = jnp.nan_to_num(gradient, nan=0.0, posinf=0.0, neginf=0.0)
    length = geometry.norm(gradient)[..., None]
    return gradient * jnp.minimum(1.0, most / jnp.maximum(length, 1e-9)), None


_tamed.defvjp(_tamed_forward, _tamed_backward)


def collision_energy(position: Array, velocity: Array, reach: Array, config: SceneConfig) -> Array:
    """What a collision course costs (...), smooth in position and velocity (..., 2), the other's less one's own [m,
    m/s]; reach (...): the radii's sum [m].

    exp(-tau / fade) / tau^2 of the time to collision tau, as Karamouzas, Skinner and Guy (Phys. Rev. Lett. 113, 2014)
    found it among people, for bodies that are blurred.
    """
    squared = jnp.sum(velocity**2, axis=-1) + 1e-3
    along = jnp.sum(position * velocity, axis=-1)
    closest_time = jnp.clip(-along / squared, 0.0, 8.0)
    closest = jnp.sqrt(jnp.sum((position + velocity * closest_time[..., None]) ** 2, axis=-1) + 1e-6)
    half_chord = jnp.sqrt(jnp.maximum(reach**2 - closest**2, 0.0) + 1e-4) / jnp.sqrt(squared)
    tau = jnp.maximum(closest_time - half_chord, 0.0)
    energy = jnp.exp(-tau / config.fade) / (tau + 0.35) ** 2
    aimed = jnp.clip(1.0 - closest / (reach + config.reach), 0.0, 1.0)
    return jnp.where(along < 0, 2.0 * aimed * energy, 0.0)


def costs(
    before: CrowdState, after: CrowdState, ahead: Array, boxes: Array, period: float, config: SceneConfig
) -> dict:
    """{name: what a decision cost each person (..., K), per second}; with gradients of each person's own state alone.

    before, after: CrowdStates at the decision and at the end of its `period` [s]; ahead (..., K, 2): directions to the
    goals; boxes (..., B, 5).
    """
    traits = after.traits
    others = _HOLD(after.position), _HOLD(after.velocity)
    position = others[0][..., None, :, :] - after.position[..., :, None, :]
    velocity = others[1][..., None, :, :] - after.velocity[..., :, None, :]
    together = traits.group[..., None, :] == traits.group[..., :, None]
    itself = jnp.eye(position.shape[-2], dtype=bool)
    companions = together & ~itself
    reach = traits.radius[..., None, :] + traits.radius[..., :, None]
    distance = jnp.sqrt(jnp.sum(position**2, axis=-1) + 1e-6)
    energy = collision_energy(position, velocity, reach, config)
    energy = jnp.where(together | (distance > encounters.PEOPLE_RANGE), 0.0, energy)
    near = jnp.sum(jnp.where(together, 0.0, jax.nn.sigmoid((_NEAR - distance) / 0.2)), axis=-1)
    patience = _HOLD(1.0 / (1.0 + near / config.crowding))
    overlap = jnp.where(itself, 0.0, _near(distance - reach))
    wall = jnp.min(geometry.point_box_distance(after.position, boxes[..., None, :, :]), axis=-1) - traits.radius
    beyond = jnp.clip(distance - 1.0, 0.0, 3.0)
    speed = geometry.norm(after.velocity)
    heading = _HOLD(jnp.where(speed[..., None] > 0.1, after.velocity / jnp.maximum(speed, 0.1)[..., None], ahead))
    in_front = geometry.to_frame(position, heading[..., :, None, :])
    aside = jax.nn.sigmoid((0.8 * reach - jnp.abs(in_front[..., 1])) / 0.08)
    same_way = jnp.sum(others[1][..., None, :, :] * heading[..., :, None, :], axis=-1) > -0.2
    missing = config.headway_time * speed[..., None] - (in_front[..., 0] - reach)
    missing = jnp.where(~itself & same_way & (in_front[..., 0] > 0), jnp.clip(missing, 0.0, 0.6), 0.0)
    shares = geometry.to_frame(after.velocity, _HOLD(ahead)) / traits.preferred_speed[..., None]
    return {
        "pace": (shares[..., 0] - 1.0) ** 2,
        "aside": shares[..., 1] ** 2,
        "change": jnp.sum((after.velocity - before.velocity) ** 2, axis=-1) / period**2,
        "meet": patience * jnp.sum(jnp.minimum(energy, _MOST_ENERGY), axis=-1),
        "headway": jnp.sum(aside * missing, axis=-1),
        "touch": jnp.sum(overlap, axis=-1) + _near(wall),
        "apart": jnp.sum(companions * beyond, axis=-1) / jnp.maximum(jnp.sum(companions, axis=-1), 1),
    }


_NEAR = 1.8  # within which people are near by [m]
_TOUCHING = 0.06  # gap at which touching begins to cost [m]
_MOST_ENERGY = 6.0  # of a collision course


def _near(gap):
    """1 at a gap of 0 [m], 0 at _TOUCHING, up to 2 where bodies overlap."""
    return jnp.clip((_TOUCHING - gap) / _TOUCHING, 0.0, 2.0)


class SceneWorlds:
    """The worlds of one scene, as many as `config`, a macid.learning.config.TrainConfig, has."""

    def __init__(self, which: scenes.Scene, config: Any, rng: np.random.Generator):
        learned = config.scenes
        self.scene, self.nworld, self.period, self.config = which, config.nworld, config.period, learned
        person = dataclasses.replace(scene.PERSON, radius=learned.radius)
        model = scene.crowd_spec(which.layout, which.number, person).compile()
        self.engine = make_engine(config.engine, model, which.number, which.layout.boxes, config.nworld)
        self.substeps = physics_steps(config.period)
        drawn = scenes.draw(which, rng, _CROWDS, learned.radius, learned.companions)
        self._drawn = jax.tree.map(jnp.asarray, drawn)
        places = np.empty((0, 2)) if which.places is None else which.places
        self._ways = jnp.asarray(which.ways, jnp.float32), jnp.asarray(places, jnp.float32)

    def begin(self, key: Array, lcf: tuple[float, float]) -> SceneWalk:
        """A new episode in every world; LCFs from the range `lcf`."""
        key_crowd, key_speed, key_lcf, key_yaw = jax.random.split(key, 4)
        shape = (self.nworld, self.scene.number)
        crowd = jax.random.randint(key_crowd, shape[:1], 0, _CROWDS)
        group = self._drawn.group[crowd]
        mean, deviation, least, most = self.config.speeds
        speed = jnp.clip(mean + deviation * jax.random.normal(key_speed, shape), least, most)
        traits = Traits(
            jnp.full(shape, self.config.radius, jnp.float32),
            jnp.take_along_axis(speed, group, axis=-1),  # companions want to walk at one speed
            jnp.full(shape, TOP_SPEED, jnp.float32),
            group,
        )
        yaw = jax.random.uniform(key_yaw, shape, minval=-jnp.pi, maxval=jnp.pi)
        position = jnp.asarray(self._drawn.position[crowd], jnp.float32)
        return SceneWalk(
            self.engine.init(position, yaw),
            jnp.asarray(self._drawn.gates[crowd], jnp.float32),
            self._drawn.first[crowd],
            jax.random.uniform(key_lcf, shape, minval=lcf[0], maxval=lcf[1]),
            traits,
        )

    def read(self, walk: SceneWalk) -> CrowdState:
        """The crowds, with their traits."""
        return self.engine.read(walk.physics)._replace(traits=walk.traits)

    def goals(self, walk: SceneWalk, position: Array) -> tuple[Array, Array]:
        """(the gates ahead (nworld, K, 5), and the points of these for which people at `position` head)."""
        gate = jnp.take_along_axis(walk.gates, walk.ahead[..., None, None], axis=-2)[..., 0, :]
        return gate, scenes.goal(gate, position)

    def rollout(self, network: Any, walk: SceneWalk, key: Array, length: int) -> tuple[Array, SceneWalk, dict]:
        """`length` decisions of everybody by `network`: (what they cost, summed; the walk after them; {name: mean})."""
        boxes, config = self.engine.boxes, self.config

        def one(carry, key):
            walk, position, velocity = carry
            crowd = self.read(walk)
            own = crowd._replace(  # as it is, with the gradient of a person's own course
                position=_tamed(crowd.position + position - _HOLD(position), config.most_gradient),
                velocity=_tamed(crowd.velocity + velocity - _HOLD(velocity), config.most_gradient),
            )
            gate, goals = self.goals(walk, own.position)
            observed = encounters.observe(own, boxes, goals, others=_HOLD(own))
            action = networks.encounter_network(network, networks.encounter_inputs(observed, walk.lcf))
            action = action + config.noise * jax.random.normal(key, action.shape)
            ahead = encounters.towards(own, goals)
            now = geometry.to_frame(own.velocity, ahead)
            following = next_velocity(action, now, walk.traits.preferred_speed, self.period)
            command = goal_command(following, own, goals, self.period)
            held = _HOLD(command)
            physics = repeat(lambda state: self.engine.step(state, held), _HOLD(walk.physics), self.substeps)
            walked = self.engine.read(physics)
            change = (command - held)[..., :2]
            after = walked._replace(
                position=walked.position + own.position - _HOLD(own.position) + self.period * change,
                velocity=walked.velocity + change,
                traits=walk.traits,
            )
            along = scenes.ahead(*self._ways, gate, _HOLD(own.position), goals)
            cost = costs(own, after, along, boxes, self.period, config)
            social = config.meet * cost["meet"] + config.touch * cost["touch"]
            total = (
                config.pace * cost["pace"]
                + config.aside * cost["aside"]
                + config.change * cost["change"]
                + config.apart * cost["apart"]
                + config.headway * cost["headway"]
                + (1.0 + config.care * walk.lcf) * social
            )
            through = scenes.passed(gate, walked.position)
            number = jnp.where(through, (walk.ahead + 1) % walk.gates.shape[-2], walk.ahead)
            pace = geometry.norm(walked.velocity) / walk.traits.preferred_speed
            told = {
                "cost": jnp.mean(total),
                "pace": jnp.mean(pace),
                "touch": jnp.mean(walked.contact * 1.0),
                "meet": jnp.mean(cost["meet"]),
                "change": jnp.mean(cost["change"]),
                "headway": jnp.mean(cost["headway"]),
            }
            return (walk._replace(physics=physics, ahead=number), after.position, after.velocity), (total, told)

        crowd = self.read(walk)
        begin = (walk, crowd.position, crowd.velocity)
        (walk, _, _), (total, told) = jax.lax.scan(one, begin, jax.random.split(key, length))
        return jnp.sum(total), walk, jax.tree.map(jnp.mean, told)


class SceneTrainer:
    """Trains policies in scenes, as macid.learning.trainer.Trainer does on a level: `iterate_seeds` is a pure jitted
    function of stacked TrainStates. config: a macid.learning.config.TrainConfig. Raises ValueError for several devices.
    """

    def __init__(self, config: Any, devices: Sequence[Any] | None = None):
        if devices:
            raise ValueError(f"Training in scenes runs on one device, not on {len(devices)}.")
        self.config, self.method = config, get_method(config.method)
        rng = np.random.default_rng(0x5CE7E)
        self.worlds = [SceneWorlds(each, config, rng) for each in scenes.SCENES.values()]
        self.people = config.nworld * sum(each.scene.number for each in self.worlds)
        self.samples = config.rollout * self.people  # agent-steps in an iteration
        self.iterations = -(-config.agent_steps // self.samples)
        learned = config.scenes
        share = learned.final_learning_rate / learned.learning_rate
        rate = optax.cosine_decay_schedule(learned.learning_rate, self.iterations, share)
        self.optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))
        self._begin_jitted = jax.jit(self._begin)
        self.iterate = jax.jit(self._iterate)
        self.iterate_seeds = jax.jit(self._iterate_seeds)

    def init(self, seed: int | None = None) -> TrainState:
        """The TrainState of `seed` (default: the config's) before the first iteration."""
        begin: int = self.config.seed if seed is None else seed
        key, key_person, key_head, key_walk = jax.random.split(jax.random.key(begin), 4)
        encoded = networks.ENCODED
        network = {
            "person": init_mlp(key_person, (networks.PERSON, encoded, encoded + 1), 1.0),
            "head": init_mlp(key_head, (networks.OWN + 2 * encoded, *HIDDEN[:2], 2), 0.01),
        }
        walk = self._begin_jitted(key_walk)
        figures = dict.fromkeys(("cost", "pace", "touch", "meet", "change", "headway"), jnp.zeros(()))
        return TrainState(network, self.optimizer.init(network), None, walk, figures, key, jnp.zeros((), jnp.int32))

    def init_seeds(self, seeds: Iterable[int]) -> TrainState:
        """The TrainStates of `seeds`, stacked."""
        states = [self.init(seed) for seed in seeds]
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)
        return stacked._replace(iteration=states[0].iteration)

    def seed_state(self, states: TrainState, index: int) -> TrainState:
        """The TrainState at `index` of stacked TrainStates."""
        one = jax.tree.map(lambda leaf: leaf[index], states._replace(iteration=None))
        return one._replace(iteration=states.iteration)

    def check(self) -> None:
        """Raises EngineOverflow where an engine had too little room (`Engine.check`)."""
        for each in self.worlds:
            each.engine.check()

    def policy(self, state: TrainState, recipe: dict[str, Any]) -> EncounterPolicy:
        """The EncounterPolicy of a TrainState, for bodies and speeds as in the training."""
        body = {"radius": self.config.scenes.radius, "preferred_speed": HUMAN, "max_speed": TOP_SPEED}
        recipe = {**recipe, **body}
        plain = jax.tree.map(np.asarray, state.parameters)
        head, person = (tuple((w, b) for w, b in plain[name]) for name in ("head", "person"))
        return EncounterPolicy(head, recipe, person)

    def _begin(self, key):
        keys = jax.random.split(key, len(self.worlds))
        return tuple(each.begin(k, self.method.lcf) for each, k in zip(self.worlds, keys, strict=True))

    def _iterate_seeds(self, states):
        return jax.vmap(self._iterate, (SEEDS,), (SEEDS, 0))(states)

    def _iterate(self, state):
        """A rollout and an update: the next TrainState, and scalars to log."""
        key, key_rollout, key_begin = jax.random.split(state.key, 3)
        keys = jax.random.split(key_rollout, len(self.worlds))

        def cost(network):
            parts = [
                each.rollout(network, walk, k, self.config.rollout)
                for each, walk, k in zip(self.worlds, state.walk, keys, strict=True)
            ]
            totals, walks, told = zip(*parts, strict=True)
            return sum(totals), (walks, told)

        gradient, (walks, told) = jax.grad(cost, has_aux=True)(state.parameters)
        gradient = jax.tree.map(lambda leaf: leaf / self.samples, gradient)
        change, optimizer = self.optimizer.update(gradient, state.optimizer, state.parameters)
        parameters = optax.apply_updates(state.parameters, change)
        iteration = state.iteration + 1
        over = iteration % self.config.episode == 0
        walks = jax.lax.cond(over, lambda: self._begin(key_begin), lambda: walks)
        log = {name: jnp.mean(jnp.stack([each[name] for each in told])) for name in told[0]}
        return state._replace(
            parameters=parameters, optimizer=optimizer, walk=walks, figures=log, key=key, iteration=iteration
        ), log
