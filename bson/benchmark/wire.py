"""Worlds and robots as ROS 2 nodes (extra `ros`), and the agent that drives on the other side."""

import contextlib
from collections.abc import Callable, Sequence
from typing import Any

from bson.benchmark.episodes import check_spawn
from macid.files import UsageError

ROS = "ros"  # the agent that drives on the other side of ROS 2


class OtherSide:
    """What the agent on the other side of ROS 2 wants to be given: a track and a sensor, or the usual ones."""

    takes_setting = False

    def __init__(self, track: str | None, sensor: Any):
        from bson.interfaces import ros

        ros.check()
        self.track, self.sensor = track or "local", sensor or "lidar2d"

    def __call__(self, setting: Any = None) -> Any:
        """Raises TypeError: `on_the_wire` gives the agent."""
        raise TypeError("It drives once it is on the wire.")


def on_the_wire(stamped: bool, real_time: bool, timeout: float) -> contextlib.AbstractContextManager[Any]:
    """A context manager of the agent on the other side of ROS 2, as run_episodes takes it (see evaluate)."""
    from bson.interfaces import ros_world

    return ros_world.agent(stamped, not real_time, timeout)


def ros(
    *,
    suite: str | None = None,
    seed: int = 0,
    episodes: int | None = None,
    track: str = "local",
    sensor: Any = "lidar2d",
    overrides: dict[str, Any] | None = None,
    lockstep: bool = False,
    stamped: bool = True,
    timeout: float = 10.0,
    told: Callable[[str], object] = print,
) -> None:
    """A world as a ROS 2 node, as `bson ros` does (extra `ros`; see bson.interfaces.ros_world).

    suite: the suite whose episodes are played one after another, `episodes` of each cell; None: the episode `seed` of
    the paper's setting, and then those that the node's service begins. lockstep: whether the world waits for one
    command in each control step, at most `timeout` [s]. stamped: whether commands are TwistStamped, not Twist. told:
    called with a line on each episode that ended. Raises UsageError.
    """
    from bson.episodes.tracks import make_track
    from bson.evaluation.metrics import sns
    from bson.evaluation.suites import load_suite
    from bson.interfaces import ros as connection
    from bson.interfaces import ros_world
    from bson.task import TaskConfig

    connection.check()
    changes, seen = overrides or {}, make_track(track, sensor)
    if suite is None:
        if episodes is not None:
            raise UsageError("--episodes is a number of a suite's episodes: give --suite, too.")
        plan, config = None, TaskConfig().replace(**changes)
        check_spawn(config, [seed])
    else:
        chosen = load_suite(suite)
        plan = [(cell.config.replace(**changes), one) for cell in chosen.cells for one in chosen.drawn(episodes, seed)]
        for each, one in plan:
            check_spawn(each, [one])
        config = plan[0][0]

    def ended(episode):
        how = episode.fault or ("arrived" if episode.arrived else "timed out")
        told(
            f"seed {episode.seed}: SNS {sns(episode):.1f}, {how} after {episode.duration:.1f} s, "
            f"{episode.collisions} collisions"
        )

    ros_world.serve(plan, config, seen, seed, stamped, lockstep, timeout, ended)


def deploy(
    agent: Any,
    *,
    robot: str = "jackal",
    period: float = 0.1,
    untrained: bool = False,
    stamped: bool = True,
    timeout: float = 10.0,
    goal_frames: Sequence[str] = (),
) -> None:
    """Drives a robot with an agent until it is interrupted, as `bson deploy` does (extra `ros`; see
    bson.interfaces.ros_agent, also for the arguments). agent: as for `evaluate`. Raises UsageError."""
    from bson.agents import agent_label, load_agent
    from bson.interfaces import ros as connection
    from bson.interfaces import ros_agent
    from bson.robot import robot_config

    connection.check()
    factory = load_agent(agent, untrained)
    ros_agent.drive(factory, agent_label(agent), robot_config(robot), period, stamped, timeout, goal_frames)
