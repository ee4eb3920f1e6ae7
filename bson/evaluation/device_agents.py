"""Agents as JAX functions, for whole episodes on a device (bson.evaluation.on_device).

Such an agent has two pure functions of N worlds' observations, which have a leading axis (N,): `begin(observation) ->
memory`, called as the episodes begin, and `act(memory, observation) -> (actions (N, 2), memory)`, called in each
control step, the first included. A user's own agent is an object with these two, or a function of one world's
observation that JAX can trace: agent(observation) -> action (2,).
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bson import recurrent
from bson.agents import BUILT_IN, learned, scripted
from bson.agents.contract import AgentError, Setting, made_for
from bson.agents.learned import CameraPupil, Learned, ScanPupil
from bson.episodes.tracks import LocalTrack
from bson.features import SCANS, SECTORS, motion, remember, vector
from bson.task import TaskConfig
from macid.documents import shown
from macid.files import UsageError
from macid.networks import relu_mlp
from macid.registry import raised

_OUTPUTS = {"clip": lambda x: jnp.clip(x, -1.0, 1.0), "tanh": jnp.tanh}
_RECURRENT = (ScanPupil, CameraPupil)  # kinds of recurrent policies whose sight is a formula
_WORLDS = 2  # in which an agent is tried


class _Scans:
    """Sees bson.features of robots with the top speed and yaw rate `top`."""

    def __init__(self, top):
        self._top = top

    def begin(self, observation):
        number = observation["lidar"].shape[0]
        scans = jnp.zeros((number, SCANS[-1] + 1, SECTORS), jnp.float32)
        return remember(scans, observation["lidar"], jnp.ones(number, bool)), jnp.bool_(True)

    def see(self, memory, observation):
        scans, first = memory
        longer = remember(scans, observation["lidar"], jnp.zeros(scans.shape[0], bool))
        scans = jnp.where(first, scans, longer)
        return (vector(scans, observation, self._top), None), (scans, jnp.bool_(False))


class _Pictures:
    """Sees the motion and the depth pictures of robots with the top speed and yaw rate `top`."""

    def __init__(self, top):
        self._top = top

    def begin(self, observation):
        return ()

    def see(self, memory, observation):
        return (motion(observation, self._top), recurrent.picture(observation["depth"])), memory


class PolicyOnDevice:
    """The agent `made` by a learned.Factory, of the kind Learned, as JAX functions."""

    def __init__(self, made: Any, output: str):
        self._sight, self._output = _Scans(made.top), _OUTPUTS[output]
        self._layers = jax.tree.map(jnp.asarray, list(made.layers))

    def begin(self, observation: Any) -> Any:
        """See the module."""
        return self._sight.begin(observation)

    def act(self, memory: Any, observation: Any) -> Any:
        """See the module."""
        (x, _), memory = self._sight.see(memory, observation)
        with jax.default_matmul_precision("float32"):
            return self._output(relu_mlp(self._layers, x)), memory


class RecurrentOnDevice:
    """The same for recurrent policies, of the kinds `gru-scans` and `camera`, of robots with the top speed and yaw rate
    `top`."""

    def __init__(self, made: Any, output: str, top: Any):
        self._sight, self._output = (_Pictures if made.pictures else _Scans)(top), _OUTPUTS[output]
        self._network = jax.tree.map(jnp.asarray, made.network)

    def begin(self, observation: Any) -> Any:
        """See the module."""
        number = observation["goal"].shape[0]
        return self._sight.begin(observation), jnp.zeros((number, recurrent.UNITS), jnp.float32)

    def act(self, memory: Any, observation: Any) -> Any:
        """See the module."""
        sight, state = memory
        seen, sight = self._sight.see(sight, observation)
        with jax.default_matmul_precision("float32"):
            action, state = recurrent.step(self._network, *seen, state)
        return self._output(action), (sight, state)


class FunctionOnDevice:
    """A function of one world's observation that JAX can trace."""

    def __init__(self, function: Callable[..., Any]):
        self._function = function

    def begin(self, observation: Any) -> Any:
        """See the module."""
        return ()

    def act(self, memory: Any, observation: Any) -> Any:
        """See the module."""
        return jax.vmap(self._function)(observation), memory


def _goal(setting):
    """bson.agents.scripted.Goal."""
    agent = scripted.Goal(setting)

    def drive(observation):
        x, y = observation["goal"]
        bearing = jnp.arctan2(y, x)
        speed = jnp.minimum(agent.speed, jnp.hypot(x, y) / agent.reach)
        return jnp.stack([speed * jnp.maximum(jnp.cos(bearing), 0.0) ** 2, jnp.clip(agent.turn * bearing, -1.0, 1.0)])

    return drive


_SCRIPTED = {"goal": _goal, "stop": lambda setting: lambda observation: jnp.zeros(2, jnp.float32)}


def device_agent(agent: Any, factory: Any, config: TaskConfig, track: LocalTrack, name: str = "agent") -> Any:
    """`agent` as JAX functions, see the module, for episodes of `config` on `track`. factory: what
    bson.agents.load_agent makes of it; name: for messages.

    Raises UsageError where it has no such functions, AgentError where they break the contract of agents.
    """
    setting = Setting.of(config, track)
    if isinstance(factory, learned.Factory):
        return _of_policy(name, factory, setting)
    if isinstance(agent, str) and agent in _SCRIPTED:
        return FunctionOnDevice(_SCRIPTED[agent](setting))
    made = made_for(factory, setting)
    if not (hasattr(made, "begin") and hasattr(made, "act")):
        made = FunctionOnDevice(made)
    _try(made, config, track, name)
    return made


def _of_policy(name, factory, setting):
    kind = factory.kind
    if kind is Learned:
        return PolicyOnDevice(factory(setting), factory.output)
    if kind in _RECURRENT:
        return RecurrentOnDevice(factory(setting), factory.output, setting.top)
    inputs = {each: name for name, each in learned.KINDS.items()}
    seen = ", ".join(inputs[each] for each in (Learned, *_RECURRENT))
    raise UsageError(f"The engine 'warp' plays policies that see {seen}; '{name}' sees {inputs[kind]}.")


def _try(agent, config, track, name):
    """Traces the functions of `agent`; raises UsageError where JAX can't, AgentError where they give no actions."""
    space = track.space(config)
    seen = {key: jax.ShapeDtypeStruct((_WORLDS, *box.shape), box.dtype) for key, box in space.spaces.items()}

    def drive(observation: Mapping[str, Any]):
        memory = agent.begin(observation)
        actions, after = agent.act(memory, observation)
        return jnp.asarray(actions), memory, after

    try:
        actions, memory, after = jax.eval_shape(drive, seen)
    except Exception as error:  # whatever the user's code does with what JAX gives it
        why = "" if name in BUILT_IN else f": it {raised(error, (__file__,))}"
        raise UsageError(
            f"The engine 'warp' plays {', '.join(_SCRIPTED)}, learned policies, and functions that JAX can trace, not "
            f"'{name}'{why}."
        ) from None
    if actions.shape != (_WORLDS, 2) or not np.issubdtype(actions.dtype, np.number):
        got = f"{actions.dtype} of shape {actions.shape[1:]}"
        raise AgentError(f"Agent '{name}' returned {got}; an action is two numbers in [-1, 1]: speed and yaw rate.")
    kept, now = (jax.tree.map(lambda x: (x.shape, str(x.dtype)), tree) for tree in (memory, after))
    if kept != now:
        raise AgentError(f"Agent '{name}': its memory is {shown(now)} after a step, and was {shown(kept)}.")
