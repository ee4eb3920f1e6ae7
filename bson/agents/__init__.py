"""Agents, which turn observations into actions.

An agent is a function `agent(observation) -> action`, or a class whose objects are such functions. A class is
instantiated once a world. If its constructor has an argument `setting`, or one argument without a default, it is given
the Setting in which the agent is to drive (bson.agents.contract), and may raise Unsuited where the agent can't drive
there. Its `reset(seed)`, if it has one, is called when an episode begins, with the episode's seed.

observation: the dict of one world (see bson.interfaces.gym.BsonEnv). action: (2,) in [-1, 1], numbers, an array, or a
torch tensor, which is detached from its gradient and brought to the CPU.
"""

import functools
import inspect
from typing import Any, cast

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
    reset_agent,
    takes_setting,
)
from macid.documents import shown
from macid.registry import Kind

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
    "mppi": "bson.agents.mppi:Mppi",
    "mppi-policy": "bson.agents.mppi_policy:MppiPolicy",
    "mppi-local": "bson.agents.mppi_local:MppiLocal",
    "sfm-planner": "bson.agents.sfm_planner:SfmPlanner",
    "gru-shield": "bson.agents.shield:GruShield",
    "gru-map-shield": "bson.agents.shield:GruMapShield",
    "orca-oracle": "bson.agents.orca_oracle:OrcaOracle",
}


def agent_names() -> list[str]:
    """Names of the agents that come with the benchmark: scripted, planning and trained ones."""
    return [*BUILT_IN, *learned.names()]


def load_agent(name: Any, untrained: bool = False) -> AgentFactory:
    """The agent `name`, as a factory. name: one of `agent_names()`, `module:attribute`, `file.py[:attribute]` (without
    an attribute: `agent`), a trained agent's .npz file, or the agent itself, a function or a class.

    Called with a Setting (without one: the default Setting), the factory gives a callable for one world. Its `track`
    and `sensor` name what the agent wants to be given: the agent's own attributes of these names, or else "local" and
    "lidar2d". It raises Unsuited where the agent can't drive in that setting. untrained: whether a trained agent may
    drive in a setting other than the one in which it was trained. Raises AgentError.
    """
    if not isinstance(name, str):
        return _Factory(name, agent_label(name))
    if name in BUILT_IN:
        return _Factory(AGENTS.load(name), name, untrained)
    found = AGENTS.load(name)
    if isinstance(found, learned.Factory):
        found.untrained = untrained
    return found


def agent_label(agent: Any) -> str:
    """The agent's name in tables: a text as it is; for a function or a class `module:name`; for any other object the
    `module:name` of its class."""
    if isinstance(agent, str):
        return agent
    kind = agent if hasattr(agent, "__qualname__") else type(agent)
    return f"{kind.__module__}:{kind.__qualname__}"


def _own(found, name):
    if not callable(found):
        attribute = name.rpartition(":")[2] if ":" in name else "agent"
        raise AgentError(f"Agent '{name}': '{attribute}' is not callable.")
    return _Factory(found, name)


class _Factory:
    """The AgentFactory of `found`: a function, which is then the agent of every world, or a class. untrained: whether
    a class with an argument of this name is given True for it."""

    def __init__(self, found, name, untrained=False):
        self._found, self._name, self._made = found, name, []
        self._told = {"untrained": True} if untrained and "untrained" in inspect.signature(found).parameters else {}
        self.takes_setting = False
        if inspect.isclass(found):
            try:
                self.takes_setting = takes_setting(found)
            except TypeError as error:
                raise AgentError(
                    f"Agent '{name}': its class must be constructible without arguments, or with the Setting alone "
                    f"({error})."
                ) from None
            if not self.takes_setting:  # a constructor that fails is to fail now, not before the first episode
                self._made.append(self())
        with its_code(name, "its track or sensor"):
            self.track, self.sensor = getattr(found, "track", "local"), getattr(found, "sensor", "lidar2d")
        if not isinstance(self.track, str):
            raise AgentError(f"Agent '{name}': its track must be 'local' or 'global', not {shown(self.track)}.")

    def __call__(self, setting: Setting | None = None) -> Agent:
        if not inspect.isclass(self._found):
            return self._found
        if self._made:
            return self._made.pop()
        with its_code(self._name, f"making a {self._found.__name__}"):
            if not self.takes_setting:
                return cast(Agent, self._found())
            return made_for(
                functools.partial(self._found, **self._told), setting or Setting.default(self.track, self.sensor)
            )


AGENTS: Kind[AgentFactory] = Kind(
    "agent",
    BUILT_IN,
    shipped=learned.names,
    read=learned.load,
    files=(".npz",),
    own="function",
    attribute="agent",
    check=_own,
    error=AgentError,
    failed=AgentFailed,
)
