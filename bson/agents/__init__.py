"""Agents: whatever turns an observation into an action.

An agent is a function `agent(observation) -> action`, or a class whose objects are such functions; a class is
instantiated once a world, and its `reset(seed)`, if it has one, is called when an episode begins, with the episode's
seed. observation: the dict of one world (see bson.env.BsonEnv). action: (2,) in [-1, 1], numbers, an array, or a torch
tensor, which is detached from its gradient and brought to the CPU.
"""

import contextlib
import importlib
import importlib.util
import inspect
import os
import pathlib
import sys
import sysconfig
import traceback

import numpy as np

from bson.agents import learned
from bson.tracks import KEYS
from macid.documents import shown

_MISSING = object()
_SHOWN = 40  # names in a message
_LIBRARY = sysconfig.get_paths()["stdlib"]  # Python's own files

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


class AgentFailed(AgentError, RuntimeError):
    """An agent's own code raised an error, the cause, or called exit()."""


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
    a trained one's file .npz; or the agent itself, a function or a class.

    Returns a factory: called without arguments, it gives a callable for one world; its `track` and `sensor` name what the
    agent wants to be given (attributes of the agent; "local" and "lidar2d" without). Raises AgentError.
    """
    if not isinstance(name, str):
        return _factory(name, agent_label(name))
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


def agent_label(agent):
    """What tables call an agent: its name, of a function or a class module:name, or what it is of."""
    if isinstance(agent, str):
        return agent
    kind = agent if hasattr(agent, "__qualname__") else type(agent)
    return f"{kind.__module__}:{kind.__qualname__}"


@contextlib.contextmanager
def _its_code(name, doing):
    """Runs code of the agent `name`. Raises AgentFailed, of one line: what it raised, and in which line of which file."""
    try:
        yield
    except (Exception, SystemExit) as error:
        raise AgentFailed(f"Agent '{name}': {doing} {_raised(error)}.") from error


def _raised(error):
    """What somebody's code raised, and where: the last line of it that is not of Python or of an installed package."""
    if isinstance(error, SystemExit):
        what = f"called exit({'' if error.code is None else shown(error.code)})"
    else:
        text = " ".join(str(error).split())
        what = f"raised {type(error).__name__}{text and ': '}{text[:500]}"
    if isinstance(error, SyntaxError) and error.filename:
        return f"{what} in {error.filename}, line {error.lineno}"
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith("<frozen")]
    theirs = [frame for frame in frames if frame.filename != __file__ and "site-packages" not in frame.filename]
    theirs = [frame for frame in theirs if not frame.filename.startswith(_LIBRARY)]
    frame = theirs[-1] if theirs else frames[-1] if frames[1:] else None
    return f"{what} in {frame.filename}, line {frame.lineno}" if frame else what


def _from_module(module, attribute, name):
    if not all(part.isidentifier() for part in module.split(".")):
        raise AgentError(f"Agent '{name}': '{module}' is no module's name. {_help()}")
    if os.getcwd() not in sys.path:  # a console script has no current folder there
        sys.path.insert(0, os.getcwd())
    try:
        loaded = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name and module.startswith(error.name):  # the module itself is not there
            raise AgentError(f"Agent '{name}': can't import '{module}' ({error}). {_help()}") from None
        raise AgentFailed(f"Agent '{name}': importing '{module}' {_raised(error)}.") from error
    except (Exception, SystemExit) as error:
        raise AgentFailed(f"Agent '{name}': importing '{module}' {_raised(error)}.") from error
    return _attribute(loaded, attribute, name)


def _from_file(path, attribute, name):
    if not pathlib.Path(path).is_file():
        raise AgentError(f"Agent '{name}': there is no file '{path}'. {_help()}")
    spec = importlib.util.spec_from_file_location(f"bson_agent_{pathlib.Path(path).stem}", path)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    folder = str(pathlib.Path(path).resolve().parent)
    if folder not in sys.path:  # for what lies beside the file
        sys.path.insert(0, folder)
    with _its_code(name, f"running '{path}'"):
        spec.loader.exec_module(module)
    return _attribute(module, attribute, name)


def _attribute(module, attribute, name):
    with _its_code(name, f"its '{attribute}'"):
        found = getattr(module, attribute, _MISSING)
    if found is _MISSING:
        there = [n for n, value in vars(module).items() if callable(value) and not n.startswith("_")]
        more = f" and {len(there) - _SHOWN} more" if len(there) > _SHOWN else ""
        told = ", ".join(there[:_SHOWN]) or "no callables"
        raise AgentError(f"Agent '{name}': no '{attribute}' there. There are: {told}{more}.")
    if not callable(found):
        raise AgentError(f"Agent '{name}': '{attribute}' is not callable.")
    return found


def _factory(found, name):
    if not inspect.isclass(found):

        def make():
            return found

    else:
        try:
            inspect.signature(found).bind()
        except TypeError as error:
            raise AgentError(f"Agent '{name}': its class must be constructible without arguments ({error}).") from None
        except ValueError:  # a class of compiled code has no signature
            pass
        with _its_code(name, f"making a {found.__name__}"):
            made = [found()]

        def make():
            if made:
                return made.pop()
            with _its_code(name, f"making a {found.__name__}"):
                return found()

    with _its_code(name, "its track or sensor"):
        make.track, make.sensor = getattr(found, "track", "local"), getattr(found, "sensor", "lidar2d")
    if not isinstance(make.track, str):
        raise AgentError(f"Agent '{name}': its track must be 'local' or 'global', not {shown(make.track)}.")
    return make


def reset_agent(agent, seed, name="agent"):
    """Calls the `reset` of `agent`, if it has one, as an episode of that seed begins. Raises AgentFailed."""
    with _its_code(name, "its reset"):
        if hasattr(agent, "reset"):
            agent.reset(seed)


def act(agent, observation, name="agent"):
    """The action (2,) float of `agent` for one world's observation, checked.

    Raises AgentError for what is no action, or where the agent asks for what isn't observed, and AgentFailed, from the
    cause, where it fails otherwise.
    """
    try:
        action = agent(observation)
    except KeyError as error:
        if not any(key in KEYS and key not in observation for key in error.args if isinstance(key, str)):
            raise AgentFailed(f"Agent '{name}' {_raised(error)}.") from error
        raise AgentError(
            f"Agent '{name}' asks for observation[{error}], which its track and sensor don't give. There are: "
            f"{', '.join(observation)}. Choose others by --track and --sensor, or the agent's attributes track and sensor."
        ) from error
    except (Exception, SystemExit) as error:
        raise AgentFailed(f"Agent '{name}' {_raised(error)}.") from error
    try:
        array = _as_numbers(action)
    except (Exception, SystemExit) as error:  # whatever an array of somebody's own raises
        raise AgentError(
            f"Agent '{name}' returned {_kind(action)}, which NumPy can't read as numbers: {_raised(error)}; {_ACTION}."
        ) from error
    if array.shape != (2,):
        raise AgentError(f"Agent '{name}' returned {_kind(action)} of shape {array.shape}; {_ACTION}.")
    if not np.isfinite(array).all():
        raise AgentError(f"Agent '{name}' returned {array.tolist()}; an action is two finite numbers in [-1, 1].")
    return array


_ACTION = "an action is two numbers in [-1, 1]: speed and yaw rate"


def _kind(value):
    kind = type(value)
    return kind.__name__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__name__}"


def _as_numbers(action):
    """`action` as an array of float. Raises whatever keeps it from being one."""
    if isinstance(action, list | tuple):
        action = [_detached(one) for one in action]
    array = np.asarray(_detached(action))
    if array.dtype.kind not in "biufO":
        raise TypeError(f"it holds {array.dtype}, no real numbers")
    return array.astype(float)


def _detached(value):
    """A torch tensor without its gradient, on the CPU; anything else as it is."""
    if callable(getattr(value, "detach", None)) and callable(getattr(value, "cpu", None)):
        return value.detach().cpu()
    return value
