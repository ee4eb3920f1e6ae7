"""Agents: whatever turns an observation into an action.

An agent is a function `agent(observation) -> action`, or a class whose objects are such functions. A class is
instantiated once a world. If its constructor has an argument `setting`, or one argument without a default, it is given
the Setting in which the agent is to drive (bson.agents.contract), and may raise Unsuited where the agent can't. Its
`reset(seed)`, if it has one, is called when an episode begins, with the episode's seed.

observation: the dict of one world (see bson.env.BsonEnv). action: (2,) in [-1, 1], numbers, an array, or a torch
tensor, which is detached from its gradient and brought to the CPU.
"""

import importlib
import importlib.util
import inspect
import os
import pathlib
import sys
from typing import Any

from bson.agents import learned
from bson.agents.contract import (
    Agent,
    AgentError,
    AgentFactory,
    AgentFailed,
    MapFrame,
    Setting,
    Unsuited,
    act,
    check_settings,
    its_code,
    made_for,
    raised,
    reset_agent,
    takes_setting,
)
from macid.documents import shown

__all__ = [
    "BUILT_IN",
    "Agent",
    "AgentError",
    "AgentFactory",
    "AgentFailed",
    "MapFrame",
    "Setting",
    "Unsuited",
    "act",
    "agent_label",
    "agent_names",
    "check_settings",
    "load_agent",
    "made_for",
    "reset_agent",
]

_MISSING = object()
_SHOWN = 40  # names in a message

BUILT_IN = {
    "stop": "bson.agents.scripted:stop",
    "random": "bson.agents.scripted:Random",
    "goal": "bson.agents.scripted:Goal",
    "stop-and-go": "bson.agents.scripted:StopAndGo",
    "vfh": "bson.agents.vfh:Vfh",
    "dwa": "bson.agents.dwa:Dwa",
    "astar": "bson.agents.planning:AStar",
    "rrt": "bson.agents.planning:Rrt",
    "rrt-star": "bson.agents.planning:RrtStar",
    "carrt-star": "bson.agents.planning:CarrtStar",
    "orca-oracle": "bson.agents.orca_oracle:OrcaOracle",
}


def agent_names():
    """Names of the agents that come with the benchmark: scripted, planning and trained ones."""
    return [*BUILT_IN, *learned.names()]


def _help():
    return (
        f"Choose one of {', '.join(agent_names())}, a 'module:function', a file 'agent.py[:function]', "
        "or a trained 'policy.npz'."
    )


def load_agent(name: Any, untrained: bool = False) -> AgentFactory:
    """The agent `name`: of `agent_names()`, `module:attribute`, `file.py[:attribute]` (attribute `agent` if not given),
    or a trained one's file .npz; or the agent itself, a function or a class.

    Returns a factory: called with a Setting (without: the default one), it gives a callable for one world; its `track`
    and `sensor` name what the agent wants to be given (attributes of the agent; "local" and "lidar2d" without). The
    factory raises Unsuited where the agent can't drive in that setting. untrained: whether a trained one may drive in
    another setting than it was trained in. Raises AgentError.
    """
    if not isinstance(name, str):
        return _Factory(name, agent_label(name))
    if name in BUILT_IN:
        return _Factory(_from_module(*BUILT_IN[name].split(":"), name), name)
    if name in learned.names() or name.endswith(".npz"):
        return learned.load(name, untrained)
    module, _, attribute = name.rpartition(":") if ":" in name else (name, "", "")
    if (module or name).endswith(".py"):
        return _Factory(_from_file(module or name, attribute or "agent", name), name)
    if not attribute:
        raise AgentError(f"Unknown agent '{name}'. {_help()}")
    return _Factory(_from_module(module, attribute, name), name)


def agent_label(agent: Any) -> str:
    """What tables call an agent: its name, of a function or a class module:name, or what it is of."""
    if isinstance(agent, str):
        return agent
    kind = agent if hasattr(agent, "__qualname__") else type(agent)
    return f"{kind.__module__}:{kind.__qualname__}"


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
        raise AgentFailed(f"Agent '{name}': importing '{module}' {raised(error)}.") from error
    except (Exception, SystemExit) as error:
        raise AgentFailed(f"Agent '{name}': importing '{module}' {raised(error)}.") from error
    return _attribute(loaded, attribute, name)


def _from_file(path, attribute, name):
    if not pathlib.Path(path).is_file():
        raise AgentError(f"Agent '{name}': there is no file '{path}'. {_help()}")
    spec = importlib.util.spec_from_file_location(f"bson_agent_{pathlib.Path(path).stem}", path)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    folder = str(pathlib.Path(path).resolve().parent)
    if folder not in sys.path:  # for what lies beside the file
        sys.path.insert(0, folder)
    with its_code(name, f"running '{path}'"):
        spec.loader.exec_module(module)
    return _attribute(module, attribute, name)


def _attribute(module, attribute, name):
    with its_code(name, f"its '{attribute}'"):
        found = getattr(module, attribute, _MISSING)
    if found is _MISSING:
        there = [n for n, value in vars(module).items() if callable(value) and not n.startswith("_")]
        more = f" and {len(there) - _SHOWN} more" if len(there) > _SHOWN else ""
        told = ", ".join(there[:_SHOWN]) or "no callables"
        raise AgentError(f"Agent '{name}': no '{attribute}' there. There are: {told}{more}.")
    if not callable(found):
        raise AgentError(f"Agent '{name}': '{attribute}' is not callable.")
    return found


class _Factory:
    """The AgentFactory of `found`, a function, which is the agent of all worlds, or a class."""

    def __init__(self, found, name):
        self._found, self._name, self._made = found, name, []
        self.takes_setting = False
        if inspect.isclass(found):
            try:
                self.takes_setting = takes_setting(found)
            except TypeError as error:
                raise AgentError(
                    f"Agent '{name}': its class must be constructible without arguments, or with the Setting alone "
                    f"({error})."
                ) from None
            if not self.takes_setting:  # it fails now, if it does
                self._made.append(self())
        with its_code(name, "its track or sensor"):
            self.track, self.sensor = getattr(found, "track", "local"), getattr(found, "sensor", "lidar2d")
        if not isinstance(self.track, str):
            raise AgentError(f"Agent '{name}': its track must be 'local' or 'global', not {shown(self.track)}.")

    def __call__(self, setting=None):
        if not inspect.isclass(self._found):
            return self._found
        if self._made:
            return self._made.pop()
        with its_code(self._name, f"making a {self._found.__name__}"):
            if not self.takes_setting:
                return self._found()
            return made_for(self._found, setting or Setting.default(self.track, self.sensor))
