"""The benchmark as Gymnasium's FuncEnv on JAX: pure functions of one world's state, for jax.jit and jax.vmap.

    env = BsonFuncEnv("local", "lidar2d", num_envs=4096)
    state = jax.vmap(env.initial, in_axes=(0, None))(jnp.arange(4096), env.default_params)
    state = jax.jit(jax.vmap(env.transition))(state, actions)

A whole control step happens on the device: pedestrians' decisions, physics (MJX-Warp), collisions, sensors. The rules
are those of `bson.interfaces.gym.BsonEnv`, whose docstring has actions, observations and rewards as tables. Physics
agrees with the native engine's to a tolerance. Sensors' noise and pedestrians' later goals are other draws than there:
the noise has the same distribution; for the goals see `bson.simulation.pool`.
"""

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.experimental.functional import FuncEnv

from bson.episodes.tracks import GlobalTrack, make_track, velocity_limit
from bson.simulation.batched import COLLISIONS, BatchedWorld
from bson.simulation.data import MAP_RESOLUTION
from bson.simulation.engines.warp import WarpConfig
from bson.simulation.pool import Drawn, draw_all
from bson.task import TaskConfig
from macid import geometry
from macid.reward import individual_reward

ACTION_SPACE = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)


class BsonFuncEnv(FuncEnv):
    """See the module. `params` is a pool of episodes (bson.simulation.pool.Drawn, with a leading axis).

    num_envs: how many worlds are to be stepped together under jax.vmap: physics has room for the contacts of this many
    worlds. pool: how many episodes `default_params` has, with the seeds `seed`, `seed + 1`, ...; drawn when first asked
    for. engine: WarpConfig, the engine's limits. task: a TaskConfig (default: the paper's); config: fields of the task
    that differ.
    """

    def __init__(
        self,
        track: str = "local",
        sensor: Any = "lidar2d",
        num_envs: int = 1,
        pool: int | None = None,
        seed: int = 0,
        engine: Any = None,
        task: TaskConfig | None = None,
        **config: Any,
    ):
        self.config = (task or TaskConfig()).replace(**config)
        self.track = make_track(track, sensor)
        self.num_envs, self._pool_size, self._seed = num_envs, num_envs if pool is None else pool, seed
        self.world = BatchedWorld(self.config, self.track.sensors, num_envs, engine or WarpConfig())
        self.observation_space, self.action_space = self.track.space(self.config), ACTION_SPACE
        self._params = None

    def get_default_params(self, **kwargs: Any) -> Any:
        """The pool of episodes of this environment, drawn by the first call."""
        if self._params is None:
            seeds = range(self._seed, self._seed + self._pool_size)
            self._params = jax.tree.map(jnp.asarray, Drawn(*draw_all(self.config, seeds, self.has_map)))
        return self._params

    @property
    def has_map(self) -> bool:
        """Whether observations have the map, so that the pool's episodes need it."""
        return isinstance(self.track, GlobalTrack)

    default_params = property(get_default_params)

    def fresh(self, rng: Any, params: Any = None) -> Any:
        """`initial`, but not yet sensed."""
        params = self.default_params if params is None else params
        size = params.goal.shape[0]
        rng = jnp.asarray(rng)
        if jnp.issubdtype(rng.dtype, jax.dtypes.prng_key) or rng.ndim:
            rng = jax.random.randint(rng, (), 0, size)
        return self.world.begin(jax.tree.map(lambda x: x[rng % size], params))

    def initial(self, rng: Any, params: Any = None) -> Any:
        """The state with which an episode of the pool begins: the episode at index `rng`, or, if `rng` is a key, an
        episode drawn with it."""
        return self.world.sense(self.fresh(rng, params))

    def transition(self, state: Any, action: Any, rng: Any = None, params: Any = None) -> Any:
        """The state after a control step under `action` (2,)."""
        return self.world.sense(self.world.advance(state, action))

    def follow(self, state: Any, action: Any, over: Any, slot: Any, params: Any) -> Any:
        """As `transition`, but where `over` () holds, the episode `slot` of the pool begins instead."""
        moved, fresh = self.world.advance(state, action), self.fresh(slot, params)
        return self.world.sense(jax.tree.map(lambda x, y: jnp.where(over, x, y), fresh, moved))

    def observation(self, state: Any, rng: Any = None, params: Any = None) -> Any:
        """The observation in `state`: a dict with the keys of the observation space."""
        config, pose = self.config, state.pose
        limit = velocity_limit(config.robot)
        seen = {
            "goal": geometry.to_body(state.drawn.goal - pose[:2], pose[2]),
            "velocity": jnp.clip(state.velocity, -limit, limit),
            **state.readings,
        }
        if self.has_map:
            half = config.map_size / 2
            yaw = jnp.clip(geometry.wrap_angle(pose[2]), -np.float32(np.pi), np.float32(np.pi))
            people = self.world._people(state.motion.qpos)
            seen |= {
                "map": state.drawn.map,
                "map_origin": jnp.full(2, -half, jnp.float32),
                "map_resolution": jnp.full(1, MAP_RESOLUTION, jnp.float32),
                "pose": jnp.append(jnp.clip(pose[:2], -2 * half, 2 * half), yaw),
                "people": jnp.clip(people, -2 * half, 2 * half),
            }
        return seen

    def reward(self, state: Any, action: Any, next_state: Any, rng: Any = None, params: Any = None) -> Any:
        """Eq. 5, of the control step from `state` to `next_state`: ()."""
        collided = next_state.counts[0] > state.counts[0]
        arrived = next_state.arrived & ~next_state.fault
        closer = state.distance - next_state.distance
        return individual_reward(closer, arrived, collided, self.config.reward).astype(jnp.float32)

    def terminal(self, state: Any, rng: Any = None, params: Any = None) -> Any:
        """Whether the robot is at its goal: ()."""
        return state.arrived & ~state.fault

    def truncation(self, state: Any, rng: Any = None, params: Any = None) -> Any:
        """Whether the episode is cut off, at the horizon or where physics failed: ()."""
        return (state.fault | (state.steps >= self.config.horizon)) & ~self.terminal(state)

    def state_info(self, state: Any, params: Any = None) -> dict[str, Any]:
        """The quantities that the metrics need: the `info` of `bson.interfaces.gym.BsonEnv`, but with `seed` (2,) as
        halves of 32 bits, the lower first, and `fault` as a bool."""
        return {
            "seed": state.drawn.seed,
            "time": state.steps * jnp.float32(self.config.control_period),
            "pose": state.pose,
            "goal": state.drawn.goal,
            "start_distance": state.drawn.start_distance,
            "distance": state.distance,
            "travelled": state.travelled,
            **{name: state.counts[place] for place, name in enumerate(COLLISIONS)},
            "nearest_person": state.nearest_person,
            "arrived": state.arrived,
            "fault": state.fault,
        }

    def transition_info(self, state: Any, action: Any, next_state: Any, params: Any = None) -> dict[str, Any]:
        """`state_info` after a control step."""
        return self.state_info(next_state, params)
