"""An episode of a crowd: everybody walks from a start to a goal and leaves the map there. Functional and jittable."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from macid import geometry, scene, traits
from macid.engines import make_engine
from macid.engines.base import repeat
from macid.geometry import Array
from macid.layout import GOAL_DISTANCE, Layout, sample_goals, sample_people
from macid.reward import WEIGHTS, RewardWeights, individual_reward, neighborhood_mean, neighbors
from macid.state import (
    GOAL_RADIUS,
    MAX_LCF,
    MAX_SPEED,
    PAPER_TRAITS,
    PHYSICS_STEP,
    RADIUS,
    STALLED,
    CrowdState,
    Traits,
    parking_place,
    physics_steps,
)


@dataclasses.dataclass(frozen=True)
class CrowdConfig:
    """A crowd on a map. Lengths in metres, times in seconds.

    preferred_speed: at which people want to walk [m/s]: a number; a range (least, most) or "human" (the normal
    distribution of 1.34 and 0.26 m/s, Weidmann 1993, from 0.5 to 2 m/s), from which each draws; None: each model's own.
    Rules take it for their desired speed. What a learned policy commands is multiplied by it over the policy's own free
    speed (`macid.pedestrians.learned`). max_speed caps it. companions: the share of people who walk in twos and threes
    (`macid.traits.gather`).
    """

    number: int = 50
    period: float = PHYSICS_STEP  # between decisions; a multiple of the physics step
    duration: float = 20.0  # of an episode: the paper's T = 1000 steps
    lcf: tuple[float, float] = (-2.0, 2.0)  # the range from which each person's LCF is drawn
    goal_distance: tuple[float, float] = GOAL_DISTANCE
    person: scene.PersonConfig = scene.PERSON
    preferred_speed: traits.PreferredSpeed = None  # [m/s]
    max_speed: float = MAX_SPEED  # of everybody [m/s]
    companions: float | None = None  # None: everybody walks alone

    def __post_init__(self):
        if self.number < 1:
            raise ValueError(f"A crowd needs at least one person, not {self.number}.")
        physics_steps(self.period)
        if not self.period <= self.duration < np.inf:
            raise ValueError(f"duration must be at least the period, {self.period:g} s, not {self.duration} s.")
        if not -MAX_LCF <= self.lcf[0] <= self.lcf[1] <= MAX_LCF:
            raise ValueError(f"lcf must be a range (least, most) in [-{MAX_LCF:g}, {MAX_LCF:g}], not {self.lcf}.")
        object.__setattr__(self, "preferred_speed", traits.check_preferred_speed(self.preferred_speed))
        traits.check_max_speed(self.max_speed)
        traits.check_companions(self.companions)

    @property
    def substeps(self) -> int:
        """Physics steps a decision lasts."""
        return physics_steps(self.period)

    @property
    def steps(self) -> int:
        """Decisions in an episode."""
        return round(self.duration / self.period)


CONFIG = CrowdConfig()  #: what a crowd is where nothing else is said


class Episode(NamedTuple):
    """Where an episode stands; leading axes (nworld, K)."""

    physics: Any
    goals: Any  #: (nworld, K, 2) [m]
    lcf: Any  #: (nworld, K)
    walking: Any  #: bool: still on the map
    collisions: Any  #: int32: steps of 0.02 s in contact, while walking
    distance: Any  #: start to goal [m]
    travelled: Any  #: way walked so far [m]
    time: Any  #: walked so far [s]
    sped: Any  #: sum of the changes of speed between decisions, without their sign [m/s]
    turned: Any  #: sum of the changes of the yaw rate between decisions, without their sign [rad/s]
    stalled: Any  #: time below STALLED [s]
    traits: Traits = PAPER_TRAITS


class Outcome(NamedTuple):
    """What one decision brought; leading axes (nworld, K)."""

    state: Any  #: CrowdState after it; people who arrived are still in place
    arrived: Any  #: bool: in this decision, and so left the map
    individual: Any  #: reward of eq. 5; 0 for a person who had left before
    neighborhood: Any  #: eq. 1 over people on the map when it began; 0 for a person who had left before


def _position(state, episode):
    return state.position


def snapshot(state: CrowdState, episode: Episode) -> tuple[Array, Array, Array, Array]:
    """For `Crowd.rollout`: what a macid.watch.Recording keeps of an instant: position, yaw, walking and collisions."""
    return state.position, state.yaw, episode.walking, episode.collisions


class Crowd:
    """`nworld` episodes at once of the crowd `config` on `layout`."""

    def __init__(self, layout: Layout, config: CrowdConfig = CONFIG, nworld: int = 1, engine: str = "native"):
        self.layout, self.config, self.nworld = layout, config, nworld
        self.model = scene.crowd_spec(layout, config.number, config.person).compile()
        self.engine = make_engine(engine, self.model, config.number, layout.boxes, nworld)
        self._init = jax.jit(self.engine.init)

    @property
    def boxes(self) -> Array:
        """(B, 5), for controllers and observations."""
        return self.engine.boxes

    def reset(self, rng: np.random.Generator) -> Episode:
        """A new episode in every world, drawn from the numpy Generator `rng`. Raises NoFreeSpace."""
        return self.begin(*self.draw(rng, self.nworld, self.config.lcf))

    def draw(
        self, rng: np.random.Generator, nworld: int, lcf: tuple[float, float]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, Traits]:
        """Starts and goals (nworld, K, 2) [m], LCFs (nworld, K), these from the range `lcf`, and Traits (nworld, K),
        drawn from the numpy Generator `rng`. Raises NoFreeSpace."""
        config, number, radius = self.config, self.config.number, self.config.person.radius
        starts = np.stack([sample_people(rng, self.layout, number, radius=radius) for _ in range(nworld)])
        goals = [sample_goals(rng, self.layout, s, config.goal_distance, radius=radius) for s in starts]
        goals, each = np.stack(goals), rng.uniform(*lcf, (nworld, number))
        drawn = []  # after all else, which stays the same without
        for world in range(nworld):
            group, wanted = None, traits.draw_preferred_speed(rng, config.preferred_speed, number)
            if config.companions is not None:
                found = traits.gather(rng, self.layout, starts[world], goals[world], config.companions, radius)
                starts[world], goals[world], group = found
            drawn.append(traits.make_traits(radius, wanted, config.max_speed, group, number))
        return starts, goals, each, jax.tree.map(lambda *leaves: np.stack(leaves), *drawn)

    def begin(self, starts: np.ndarray, goals: np.ndarray, lcf: np.ndarray, traits: Traits = PAPER_TRAITS) -> Episode:
        """The episodes of people who stand at `starts` and go to `goals`, (nworld, K, 2) [m], with the LCFs `lcf` and
        `traits`, of which the radius is the config's. Raises ValueError for another radius."""
        shape, towards = (self.nworld, self.config.number), goals - starts
        radius = self.config.person.radius
        if traits.radius is not None and not np.allclose(traits.radius, radius, rtol=0.0, atol=1e-6):
            raise ValueError(f"The people of this crowd have the radius {radius:g} m: set it in its PersonConfig.")
        traits = traits._replace(radius=None if radius == RADIUS else np.full(shape, radius, np.float32))
        state = self._init(starts, np.arctan2(towards[..., 1], towards[..., 0]))
        return Episode(
            state,
            jnp.asarray(goals, jnp.float32),
            jnp.asarray(lcf, jnp.float32),
            jnp.ones(shape, bool),
            jnp.zeros(shape, jnp.int32),
            jnp.asarray(np.linalg.norm(towards, axis=-1), jnp.float32),
            *(jnp.zeros(shape, jnp.float32) for _ in range(5)),
            traits=jax.tree.map(jnp.asarray, traits),
        )

    def read(self, episode: Episode) -> CrowdState:
        """The crowds of an Episode with its traits, leading axes (nworld, K)."""
        return self.engine.read(episode.physics)._replace(traits=episode.traits)

    def step(self, episode: Episode, command: Array) -> Episode:
        """One decision: `command` (nworld, K, 3), world velocity [m/s] and yaw rate [rad/s], held for the period."""
        return self.transition(episode, command)[0]

    def transition(self, episode: Episode, command: Array, weights: RewardWeights = WEIGHTS) -> tuple[Episode, Outcome]:
        """`step` and its Outcome, whose rewards follow from `weights` (a collision: any contact during the
        decision)."""
        command = jnp.where(episode.walking[..., None], command, 0.0)
        state, collisions, travelled = episode.physics, episode.collisions, episode.travelled
        first = after = self.engine.read(state)

        def substep(carried):
            state, before, collisions, travelled = carried
            state = self.engine.step(state, command)
            after = self.engine.read(state)
            collisions = collisions + (after.contact & episode.walking)
            travelled = travelled + jnp.where(episode.walking, geometry.norm(after.position - before.position), 0.0)
            return state, after, collisions, travelled

        carried = repeat(substep, (state, after, collisions, travelled), self.config.substeps)
        state, after, collisions, travelled = carried
        speed, walking = geometry.norm(after.velocity), jnp.asarray(episode.walking, jnp.float32)
        arrived = episode.walking & (geometry.norm(episode.goals - after.position) <= GOAL_RADIUS)
        away = jnp.asarray(parking_place(np.arange(self.config.number)), jnp.float32)
        closer = geometry.norm(episode.goals - first.position) - geometry.norm(episode.goals - after.position)
        individual = individual_reward(closer, arrived, collisions > episode.collisions, weights) * walking
        near = neighbors(after.position) & episode.walking[..., None, :] & episode.walking[..., :, None]
        shared = neighborhood_mean(individual[..., None], near)[..., 0]
        following = episode._replace(
            physics=self.engine.place(state, arrived, away),
            walking=episode.walking & ~arrived,
            collisions=collisions,
            travelled=travelled,
            time=episode.time + walking * self.config.period,
            sped=episode.sped + walking * jnp.abs(speed - geometry.norm(first.velocity)),
            turned=episode.turned + walking * jnp.abs(after.yaw_rate - first.yaw_rate),
            stalled=episode.stalled + walking * (speed < STALLED) * self.config.period,
        )
        return following, Outcome(after._replace(traits=episode.traits), arrived, individual, shared)

    def rollout(
        self,
        episode: Episode,
        controller: Callable[..., Array],
        steps: int | None = None,
        record: Callable[[CrowdState, Episode], Any] = _position,
    ) -> tuple[Episode, Any]:
        """Jitted: `steps` decisions (default: the episode's) of `controller`. Returns the Episode and what
        `record(crowd state, episode)` gives before each decision, stacked; by default the positions
        (steps, nworld, K, 2) [m]."""
        return self._rollout(episode, controller, self.config.steps if steps is None else steps, record)

    def _rollout(self, episode, controller, steps, record):
        key = (controller, steps, record)
        compiled = self.__dict__.setdefault("_compiled", {})
        if key not in compiled:

            def one(episode, _):
                state = self.read(episode)
                command = controller(state, self.boxes, episode.goals, episode.lcf)
                return self.step(episode, command), record(state, episode)

            compiled[key] = jax.jit(lambda episode: jax.lax.scan(one, episode, None, length=steps))
        return compiled[key](episode)
