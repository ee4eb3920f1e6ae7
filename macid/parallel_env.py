"""A crowd as a PettingZoo parallel environment, to train pedestrians with one's own algorithm (extra `pettingzoo`)."""

import copy
import dataclasses
import numbers
import types
import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from macid import forks
from macid.crowd import CONFIG, Crowd, CrowdConfig, snapshot
from macid.documents import is_number, shown
from macid.evaluate import level_seed
from macid.layout import Layout, load_level
from macid.observation import RAY_RANGE, RAYS, SIZE, observe
from macid.pedestrians.learned import to_command
from macid.policy import ACTIONS, to_velocity
from macid.reward import WEIGHTS, RewardWeights
from macid.state import MAX_SPEED

if TYPE_CHECKING:
    from macid.watch import Recording

try:
    from pettingzoo import ParallelEnv
except ImportError as error:
    raise ImportError("macid.parallel_env needs PettingZoo: pip install 'bson-macid[pettingzoo]'.") from error

MAX_PEOPLE = 10_000
REWARDS = ("individual", "coordinated")


class CrowdParallelEnv(ParallelEnv):
    """Everybody of a crowd, `person_0` to `person_{K-1}`, is an agent that walks to a goal of its own.

    | action | what | at -1 | at 1 |
    |---|---|---|---|
    | 0 | speed ahead | 0 m/s | `config.max_speed` (1.5 m/s) |
    | 1 | yaw rate, counter-clockwise | -1 rad/s | 1 rad/s |

    What lies outside [-1, 1] is clipped. An action lasts `config.period` (0.02 s); people begin at rest, facing their
    goal. The observation is the 41 columns of `macid.observation`, float32, in the agent's own frame; the LCF is not
    among them.

    | info | what |
    |---|---|
    | lcf | the agent's local coordination factor |
    | individual | reward of eq. 5, by `weights`: metres closer, arrival, contact during the step |
    | neighborhood | eq. 1: the mean individual reward of the other agents within 5 m, 0 where there are none |
    | collisions | steps of 0.02 s in contact so far |
    | preferred_speed, group | the agent's own, where `config` has preferred speeds or companions |

    The reward is individual + lcf * neighborhood (`reward="coordinated"`; eq. 2 has the same sum of advantages) or the
    individual reward alone (`reward="individual"`).

    An agent terminates within 0.5 m of its goal: it leaves the map, and its last observation is from where it left. An
    agent that still walks after `config.duration` (20 s) is truncated. (Arriving also ends an agent's neighbourhood
    rewards, so that cooperative agents may learn to dawdle; `macid train` gives a new goal instead and never ends.)

    level: one of macid.layout's levels (1 to 4, "v1" to "v4"), or a Layout (in a maze nobody is given a way). number:
    of people; default: the level's, else the config's. reset(seed=s) begins the episode that
    `macid evaluate --episodes 1 --seed s` plays there; a reset without a seed goes on to the next.
    reset(options={"lcf": ...}) sets the LCFs of the episode as the attribute `lcf` does; they are drawn from
    `config.lcf` otherwise. engine: "native", "mjx" or "warp", see macid.engines.

    Raises ValueError for unknown names and values outside their domain.
    """

    # PettingZoo has it as an attribute of instances.
    metadata: dict[str, Any] = {"name": "macid_crowd_v0", "render_modes": []}  # noqa: RUF012
    render_mode = None
    # None once the environment is closed, and most of them before the first reset; _check_usable and _check_begun tell.
    crowd: Any  #: a macid.crowd.Crowd
    _advance_jitted: Any
    _look_jitted: Any
    _rng: Any  # a numpy Generator
    _seed: Any  # int, or None where none was given
    _episode: Any  # a macid.crowd.Episode
    _lcf: Any  # (K,) float32
    _steps: Any  # int: since the reset

    def __init__(
        self,
        level: int | str | Layout = 2,
        config: CrowdConfig = CONFIG,
        number: int | None = None,
        reward: str = "coordinated",
        weights: RewardWeights = WEIGHTS,
        engine: str = "native",
    ):
        if reward not in REWARDS:
            raise ValueError(f"Unknown reward '{reward}'. Choose one of {', '.join(REWARDS)}.")
        self._arguments = (level, config, number, reward, weights, engine)
        forks.refuse()
        layout = level if isinstance(level, Layout) else load_level(level)
        if number is not None and not _is_whole(number, -MAX_PEOPLE, MAX_PEOPLE):  # CrowdConfig refuses what is below 1
            raise ValueError(f"number must be a whole number from 1 to {MAX_PEOPLE}, not {shown(number)}.")
        if number is None:
            number = config.number if layout.pedestrians is None else layout.pedestrians
        self.crowd = Crowd(layout, dataclasses.replace(config, number=number), engine=engine)
        self.reward, self.weights = reward, weights
        self._level = layout.name if isinstance(level, Layout) else level
        self._seeding = () if isinstance(level, Layout) else level_seed(level)
        self.possible_agents = [f"person_{index}" for index in range(number)]
        self._index = {agent: index for index, agent in enumerate(self.possible_agents)}
        self.agents = []
        low, high = observation_bounds(layout.size)
        self.observation_spaces = {
            agent: gymnasium.spaces.Box(low, high, dtype=np.float32) for agent in self.possible_agents
        }
        self.action_spaces = {
            agent: gymnasium.spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32) for agent in self.possible_agents
        }
        self._advance_jitted, self._look_jitted = jax.jit(self._advance), jax.jit(self._look)
        self._rng = self._seed = self._episode = self._lcf = self._steps = None
        self._moments: list[Any] = []

    def __reduce__(self):
        return type(self), self._arguments

    def __deepcopy__(self, memo):
        """Another one that plays on equally from here."""
        made = memo[id(self)] = type(self)(*self._arguments)
        kept = ("crowd", "_advance_jitted", "_look_jitted", "_arguments", "_episode", "_moments")
        for name, value in vars(self).items():
            if name not in kept:
                setattr(made, name, copy.deepcopy(value, memo))
        made._episode, made._moments = self._episode, list(self._moments)  # each is never changed
        if self.crowd is None:
            made.close()
        return made

    def close(self) -> None:
        """Frees all that it holds; closing twice does no harm. Nothing can be stepped or reset then."""
        self.crowd = self._episode = self._advance_jitted = self._look_jitted = None
        self._moments = []

    def _check_usable(self):
        if self.crowd is None:
            raise gymnasium.error.ClosedEnvironmentError("This environment is closed: make another one.")
        forks.refuse()

    def observation_space(self, agent: str) -> gymnasium.spaces.Space:
        """The Box (41,) of `agent`; unbounded where contacts can push people faster than they walk."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> gymnasium.spaces.Space:
        """The Box (2,) of `agent`."""
        return self.action_spaces[agent]

    @property
    def lcf(self) -> Any:
        """Everybody's LCF, {agent: number}, to read. Set it at any time: to a number for all, to a range (least, most)
        from which each draws, or to {agent: number} for some agents."""
        self._check_begun()
        return types.MappingProxyType(dict(zip(self.possible_agents, self._lcf.tolist(), strict=True)))

    @lcf.setter
    def lcf(self, value: Any) -> None:
        self._check_begun()
        lcf = self._lcf.copy()
        if isinstance(value, dict):
            if unknown := sorted(map(str, set(value) - set(self.possible_agents))):
                raise ValueError(f"Unknown agent '{unknown[0]}': they are person_0 to {self.possible_agents[-1]}.")
            for agent, one in value.items():
                lcf[self._index[agent]] = _number(one)
        elif isinstance(value, numbers.Real):
            lcf[:] = _number(value)
        else:
            try:
                least, most = map(_number, value)
            except (TypeError, ValueError):
                least, most = 1.0, 0.0
            if least > most:
                raise ValueError(f"lcf must be a number, a range (least, most) or {{agent: number}}, not {value!r}.")
            lcf = self._rng.uniform(least, most, len(lcf)).astype(np.float32)
        self._lcf = lcf
        self._episode = self._episode._replace(lcf=jnp.asarray(lcf[None]))

    def reset(
        self, seed: int | None = None, options: dict | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict]]:
        """Begins an episode: observations and infos, {agent: ...}. Unknown options are told by a warning."""
        self._check_usable()
        if seed is not None and not _is_whole(seed, 0, 2**62 - 1):
            raise ValueError(f"A seed must be a whole number from 0 to 2**62 - 1, not {shown(seed)}.")
        if options is not None and not isinstance(options, dict):
            raise ValueError(f"options must be a dict, not {shown(options)}.")
        options = options or {}
        if unknown := sorted(map(str, set(options) - {"lcf"})):
            warnings.warn(f"Unknown option '{unknown[0]}' is ignored. There is one: lcf.", stacklevel=2)
        names = ("_rng", "_seed", "_episode", "_lcf", "_steps")
        before = {name: copy.deepcopy(getattr(self, name)) if name == "_rng" else getattr(self, name) for name in names}
        try:
            if seed is not None or self._rng is None:
                seed = None if seed is None else int(seed)
                self._rng = np.random.default_rng(None if seed is None else (seed, *self._seeding))
                self._seed = seed
            self._episode = self.crowd.reset(self._rng)
            self._lcf, self._steps = np.array(self._episode.lcf[0]), 0
            if "lcf" in options:
                self.lcf = options["lcf"]
        except BaseException:  # the episode before goes on
            vars(self).update(before)
            raise
        self.agents = self.possible_agents[:]
        observed, moment = jax.device_get(self._look_jitted(self._episode))
        self._moments = [moment]
        return self._by_agent(np.array(observed[0])), self._infos(moment)

    def step(self, actions: Mapping[str, Any]) -> tuple[dict, dict, dict, dict, dict]:
        """One decision of all `agents`: {agent: (2,)}; actions of agents that have left are ignored.

        Returns observations, rewards, terminations, truncations and infos, {agent: ...}, of the agents that acted.
        Raises ValueError where an action is missing or not finite, gymnasium.error.ResetNeeded where nobody is left.
        """
        self._check_usable()
        if not self.agents:
            raise gymnasium.error.ResetNeeded("Nobody is on the map. Call reset before step.")
        self._episode, told, moment = self._advance_jitted(self._episode, self._stack(actions))
        (observed, arrived, individual, neighborhood), moment = jax.device_get((told, moment))
        self.crowd.engine.check()
        self._moments.append(moment)
        self._steps += 1
        rewards = individual if self.reward == "individual" else individual + self._lcf * neighborhood
        late = ~arrived if self._steps >= self.crowd.config.steps else np.zeros_like(arrived)
        result = (
            self._by_agent(np.array(observed)),
            self._by_agent(rewards.tolist()),
            self._by_agent(arrived.tolist()),
            self._by_agent(late.tolist()),
            self._infos(moment, individual=individual, neighborhood=neighborhood),
        )
        self.agents = [agent for agent in self.agents if not (arrived | late)[self._index[agent]]]
        return result

    def recording(self, name: str = "agents") -> "Recording":
        """The episode so far, for `macid.watch.film(recording, path)`. name: the pedestrians' name, for the header."""
        from macid.watch import Recording

        self._check_begun()
        crowd, lcf = self.crowd, self._lcf
        fields = [np.stack([moment[index][0] for moment in self._moments]) for index in range(len(self._moments[0]))]
        bounds = float(lcf.min()), float(lcf.max())
        goals = np.asarray(self._episode.goals)[0]
        return Recording(
            name,
            self._level,
            self._seed,
            crowd.layout,
            crowd.config.period,
            bounds,
            lcf.copy(),
            goals,
            *fields,
            radius=crowd.config.person.radius,
        )

    def _look(self, episode):
        """Observations (1, K, 41) at an Episode, and its moment: position, yaw, walking, collisions."""
        state = self.crowd.engine.read(episode.physics)
        return observe(state, self.crowd.boxes, episode.goals), snapshot(state, episode)

    def _advance(self, episode, action):
        """The next Episode under `action` (K, 2); observations, arrivals and rewards (K, ...); and its moment."""
        yaw = self.crowd.engine.read(episode.physics).yaw
        velocity = to_velocity(action[None])
        if episode.traits.max_speed is not None:
            velocity = velocity.at[..., 0].multiply(episode.traits.max_speed / MAX_SPEED)
        episode, outcome = self.crowd.transition(episode, to_command(velocity, yaw), self.weights)
        observed, moment = self._look(episode)
        # An agent that has left stands far away by now: its last observation is from the goal.
        observed = jax.lax.cond(
            jnp.any(outcome.arrived),
            lambda: jnp.where(
                outcome.arrived[..., None], observe(outcome.state, self.crowd.boxes, episode.goals), observed
            ),
            lambda: observed,
        )
        told = observed, outcome.arrived, outcome.individual, outcome.neighborhood
        return episode, jax.tree.map(lambda leaf: leaf[0], told), moment

    def _stack(self, actions):
        """`actions` as (K, 2) float32, zeros for agents that have left."""
        if missing := [agent for agent in self.agents if agent not in actions]:
            raise ValueError(
                f"All {len(self.agents)} agents on the map need an action: that of {missing[0]} is missing."
            )
        stacked = np.zeros((len(self.possible_agents), ACTIONS), np.float32)
        for agent in self.agents:
            try:
                action = np.asarray(actions[agent], np.float32)
            except (TypeError, ValueError, OverflowError, RuntimeError):
                action = np.empty(0)
            if action.shape != (ACTIONS,) or not np.isfinite(action).all():
                raise ValueError(f"An action is {ACTIONS} finite numbers, not {agent}'s {shown(actions[agent])}.")
            stacked[self._index[agent]] = action
        return stacked

    def _by_agent(self, rows):
        return {agent: rows[self._index[agent]] for agent in self.agents}

    def _infos(self, moment, **rewards):
        traits = self._episode.traits
        own = {"preferred_speed": traits.preferred_speed, "group": traits.group}
        own = {name: np.asarray(value)[0] for name, value in own.items() if value is not None}
        columns = {"lcf": self._lcf, **rewards, "collisions": moment[-1][0], **own}
        names, values = list(columns), list(zip(*(column.tolist() for column in columns.values()), strict=True))
        return self._by_agent([dict(zip(names, row, strict=True)) for row in values])

    def _check_begun(self):
        if self._episode is None:
            self._check_usable()
            raise gymnasium.error.ResetNeeded("Call reset first.")


def observation_bounds(size: float) -> tuple[np.ndarray, np.ndarray]:
    """Least and most (41,) that an observation on a map of side `size` [m] can hold, float32.

    Goals lie on the map and rays end at 7 m. Speeds, yaw rates and relative velocities have no bound: people walk at up
    to 1.5 m/s, but a push in a throng is not limited.
    """
    diagonal = 2**0.5 * size
    ray_low, ray_high = [0.0, -np.inf, -np.inf], [RAY_RANGE, np.inf, np.inf]
    low = [-diagonal, -diagonal, 0.0, -np.inf, 0.0, *RAYS * ray_low]
    high = [diagonal, diagonal, np.inf, np.inf, 1.0, *RAYS * ray_high]
    assert len(low) == SIZE
    return np.array(low, np.float32), np.array(high, np.float32)


def _number(value):
    if not is_number(value):
        raise ValueError(f"An LCF is a finite number, not {shown(value)}.")
    return float(value)


def _is_whole(value, least, most):
    return isinstance(value, numbers.Integral) and is_number(value, least, most)
