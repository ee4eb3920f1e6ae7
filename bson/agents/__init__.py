"""Agents: whatever turns an observation into an action.

An agent is a function `agent(observation) -> action`, or a class whose objects are such functions; a class is
instantiated once a world, and its `reset(seed)`, if it has one, is called when an episode begins, with the episode's
seed. observation: the dict of one world (see bson.env.BsonEnv). action: (2,) in [-1, 1].
"""

import importlib
import importlib.util
import inspect
import os
import pathlib
import sys

import numpy as np

from bson.agents import learned
from bson.tracks import KEYS

BUILT_IN = {
    "stop": "bson.agents.scripted:stop",
    "random": "bson.agents.scripted:Random",
    "goal": "bson.agents.scripted:goal",
    "stop-and-go": "bson.agents.scripted:stop_and_go",
    "vfh": "bson.agents.vfh:Vfh",
    "dwa": "bson.agents.dwa:Dwa",
    "astar": "bson.agents.planning:AStar",
    "rrt": "bson.agents.planning:Rrt",
    "rrt-star": "bson.agents.planning:RrtStar",
    "carrt-star": "bson.agents.planning:CarrtStar",
    "orca-oracle": "bson.agents.orca_oracle:OrcaOracle",
}


class AgentError(ValueError):
    """An agent can't be found, or did what no agent may do."""


def agent_names():
    """Names of the agents that come with the benchmark: scripted, planning and trained ones."""
    return [*BUILT_IN, *learned.names()]


def _help():
    return (
        f"Choose one of {', '.join(agent_names())}, a 'module:function', a file 'agent.py[:function]', "
        "or a trained 'policy.npz'."
    )


def load_agent(name):
    """The agent `name`: of `agent_names()`, `module:attribute`, `file.py[:attribute]` (attribute `agent` if not given), or
    a trained one's file .npz.

    Returns a factory: called without arguments, it gives a callable for one world; its `track` and `sensor` name what the
    agent wants to be given (attributes of the agent; "local" and "lidar2d" without). Raises AgentError.
    """
    if name in BUILT_IN:
        return _factory(_from_module(*BUILT_IN[name].split(":"), name), name)
    if name in learned.names() or name.endswith(".npz"):
        return learned.load(name)
    module, _, attribute = name.rpartition(":") if ":" in name else (name, "", "")
    if (module or name).endswith(".py"):
        return _factory(_from_file(module or name, attribute or "agent", name), name)
    if not attribute:
        raise AgentError(f"Unknown agent '{name}'. {_help()}")
    return _factory(_from_module(module, attribute, name), name)


def _from_module(module, attribute, name):
    if os.getcwd() not in sys.path:  # a console script has no current folder there
        sys.path.insert(0, os.getcwd())
    try:
        loaded = importlib.import_module(module)
    except ImportError as error:
        raise AgentError(f"Agent '{name}': can't import '{module}' ({error}). {_help()}") from None
    return _attribute(loaded, attribute, name)


def _from_file(path, attribute, name):
    if not pathlib.Path(path).is_file():
        raise AgentError(f"Agent '{name}': there is no file '{path}'. {_help()}")
    spec = importlib.util.spec_from_file_location(f"bson_agent_{pathlib.Path(path).stem}", path)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    folder = str(pathlib.Path(path).resolve().parent)
    if folder not in sys.path:  # for what lies beside the file
        sys.path.insert(0, folder)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise AgentError(f"Agent '{name}': running '{path}' failed: {type(error).__name__}: {error}") from error
    return _attribute(module, attribute, name)


def _attribute(module, attribute, name):
    if not hasattr(module, attribute):
        there = [n for n, value in vars(module).items() if callable(value) and not n.startswith("_")]
        raise AgentError(f"Agent '{name}': no '{attribute}' there. There are: {', '.join(there) or 'no callables'}.")
    found = getattr(module, attribute)
    if not callable(found):
        raise AgentError(f"Agent '{name}': '{attribute}' is not callable.")
    return found


def _factory(found, name):
    if not inspect.isclass(found):

        def factory():
            return found

    else:
        try:
            made = [found()]
        except TypeError as error:
            raise AgentError(f"Agent '{name}': its class must be constructible without arguments ({error}).") from None

        def factory():
            return made.pop() if made else found()

    factory.track, factory.sensor = getattr(found, "track", "local"), getattr(found, "sensor", "lidar2d")
    return factory


def act(agent, observation, name="agent"):
    """The action (2,) float of `agent` for one world's observation, checked.

    Raises AgentError for what is no action, or where the agent asks for what isn't observed, and RuntimeError, from the
    cause, where it fails otherwise.
    """
    try:
        action = agent(observation)
    except KeyError as error:
        if not any(key in KEYS and key not in observation for key in error.args if isinstance(key, str)):
            raise RuntimeError(f"Agent '{name}' raised KeyError: {error}") from error
        raise AgentError(
            f"Agent '{name}' asks for observation[{error}], which its track and sensor don't give. There are: "
            f"{', '.join(observation)}. Choose others by --track and --sensor, or the agent's attributes track and sensor."
        ) from error
    except Exception as error:
        raise RuntimeError(f"Agent '{name}' raised {type(error).__name__}: {error}") from error
    try:
        array = np.asarray(action, dtype=float)
    except (TypeError, ValueError):
        array = None
    if array is None or array.shape != (2,):
        shape = getattr(array, "shape", type(action).__name__)
        raise AgentError(f"Agent '{name}' returned {shape}; an action is two numbers in [-1, 1]: speed and yaw rate.")
    if not np.isfinite(array).all():
        raise AgentError(f"Agent '{name}' returned {array.tolist()}; an action is two finite numbers in [-1, 1].")
    return array
