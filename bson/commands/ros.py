"""ROS 2, its worlds, robots and bags: `bson record`, `ros`, `deploy`, `replay`."""

import shlex
from typing import Any

from bson.commands.flags import add_pace, add_setting, add_task, add_untrained, add_wire, overrides
from macid.command import MOST_SEED, name


def _record(args):
    from bson import benchmark

    written = benchmark.record(
        args.agent,
        args.out,
        suite=args.suite,
        seed=args.seed,
        episodes=args.episodes,
        track=args.track,
        sensor=args.sensor,
        overrides=overrides(args),
        untrained=args.untrained_setting,
        stamped=not args.twist,
        real_time=args.real_time,
        timeout=args.timeout,
        command="bson " + shlex.join(args.argv),
    )
    print(f"Written: {', '.join(map(str, written))}")
    return 0


def _ros(args):
    from bson import benchmark

    benchmark.ros(
        suite=args.suite,
        seed=args.seed,
        episodes=args.episodes,
        track=args.track,
        sensor=args.sensor,
        overrides=overrides(args),
        lockstep=args.lockstep,
        stamped=not args.twist,
        timeout=args.timeout,
        told=lambda text: print(text, flush=True),
    )
    return 0


def _deploy(args):
    from bson import benchmark

    benchmark.deploy(
        args.agent,
        robot=args.robot,
        period=args.period,
        untrained=args.untrained_setting,
        stamped=not args.twist,
        timeout=args.timeout,
        goal_frames=args.goal_frame,
    )
    return 0


def _replay(args):
    from bson import benchmark
    from bson.evaluation.play import format_summary

    found = benchmark.replay(args.bags, args.out)
    for row in found.content["episodes"]:
        print(f"{row['cell']}, seed {row['seed']}: SNS {row['SNS']!r}")
    print(format_summary(found.content))
    if args.out:
        print(f"Written: {found.written[0]}")
    return 0


def add_commands(commands: Any, defaults: dict[str, Any]) -> None:
    """Adds the commands to `commands`, argparse's subparsers; `defaults`: what each is made with."""
    record = commands.add_parser(
        "record", help="write episodes to rosbag2 folders with MCAP storage (extra `record`)", **defaults
    )
    add_setting(record)
    record.add_argument("--suite", type=name, default=None, help="record a suite's episodes (bson list)")
    record.number("--episodes", int, -MOST_SEED, MOST_SEED, default=None, help="only the suite's first N episodes")
    record.number(
        "--seed", int, 0, 9 * 10**12, default=0, help="the episode; with --suite as for bson evaluate, 0: its own seeds"
    )
    add_wire(record)
    add_pace(record)
    record.add_argument("--out", type=name, required=True, help="folder; each episode gets one in it, seed-N")
    record.set_defaults(run=_record)

    ros = commands.add_parser("ros", help="a world as a ROS 2 node: sensors out, /cmd_vel in (extra `ros`)", **defaults)
    ros.add_argument("--suite", type=name, default=None, help="play a suite's episodes, one after another (bson list)")
    ros.number("--episodes", int, -MOST_SEED, MOST_SEED, default=None, help="only the suite's first N episodes")
    ros.number(
        "--seed", int, 0, 9 * 10**12, default=0, help="the episode; with --suite as for bson evaluate, 0: its own seeds"
    )
    ros.add_argument("--track", type=name, default="local", help="local or global")
    ros.add_argument("--sensor", type=name, default="lidar2d", help="lidar2d, lidar3d, camera, or your own")
    pace = ros.add_mutually_exclusive_group()
    pace.add_argument("--lockstep", action="store_true", help="the world waits for one command in each control step")
    pace.add_argument("--real-time", action="store_true", help="one control step each period (the default)")
    add_wire(ros)
    add_task(ros)
    ros.set_defaults(run=_ros)

    deploy = commands.add_parser(
        "deploy",
        help="drive a robot with an agent, as a ROS 2 node: /scan, /odom and a goal in (extra `ros`)",
        **defaults,
    )
    deploy.add_argument(
        "--agent",
        type=name,
        default="vfh",
        help="a name (bson list), a policy.npz, module:function, or file.py[:function]",
    )
    deploy.add_argument("--robot", type=name, default="jackal", help="whose limits hold (bson list), or a .toml")
    deploy.number("--period", float, 0.0, 10.0, above=True, default=0.1, help="between two decisions [s]")
    deploy.add_argument(
        "--goal-frame",
        type=name,
        action="append",
        default=[],
        help="a frame of goals that is the odometry's, by another name; may be repeated. In BSON's worlds: map",
    )
    add_untrained(deploy)
    add_wire(deploy)
    deploy.set_defaults(run=_deploy)

    replay = commands.add_parser("replay", help="score recorded episodes again (extra `record`)", **defaults)
    replay.add_argument("bags", type=name, nargs="+", metavar="BAG", help="folders of bson record, or folders of these")
    replay.add_argument("--out", type=name, default=None, help="folder for results.json")
    replay.set_defaults(run=_replay)


DRAW_NOTHING = (_replay,)  # commands that need no OpenGL
