"""An agent's score: `bson evaluate`, and `bson demo`."""

from typing import Any

from bson.commands.flags import (
    add_engine,
    add_pace,
    add_passphrase,
    add_setting,
    add_wire,
    command_line,
    overrides,
    read_passphrase,
)
from macid.command import MOST_SEED, Parser, add_executor, name

_MOST_FILMS = 10_000


def _evaluate(args):
    from bson import benchmark
    from bson.evaluation.play import format_summary

    found = benchmark.evaluate(
        args.agent,
        args.suite,
        passphrase=read_passphrase(args),
        out=args.out,
        episodes=args.episodes,
        seed=args.seed,
        track=args.track,
        sensor=args.sensor,
        overrides=overrides(args),
        untrained=args.untrained_setting,
        paired=args.paired,
        metrics=args.metric,
        videos=args.videos,
        record=args.record,
        resume=args.resume,
        executor=args.executor,
        ray_address=args.ray_address,
        workers=args.workers,
        engine=args.engine,
        stamped=not args.twist,
        real_time=args.real_time,
        timeout=args.timeout,
        command=command_line(args.argv),
        told=lambda results: print(format_summary(results.content), flush=True),
    )
    print(f"Written: {', '.join(map(str, found.written))}")
    return 0


def add_commands(commands: Any, defaults: dict[str, Any]) -> None:
    """Adds the commands to `commands`, argparse's subparsers; `defaults`: what each is made with."""
    demo = commands.add_parser(
        "demo", help="evaluate the reactive agent on ten episodes, with a report and films", **defaults
    )
    add_setting(demo)
    _add_evaluation(demo, "bson-demo", "smoke")

    evaluate = commands.add_parser("evaluate", help="score an agent on a suite", **defaults)
    add_setting(evaluate)
    _add_evaluation(evaluate, "results", "paper")


def _add_evaluation(command: Parser, out: str, suite: str):
    add_engine(command, "all episodes of a cell at once, of agents that are JAX functions")
    command.add_argument("--suite", type=name, default=suite, help="a name (bson list)")
    add_passphrase(command)
    command.number("--episodes", int, -MOST_SEED, MOST_SEED, default=None, help="only the suite's first N episodes")
    command.number(
        "--seed", int, 0, 9 * 10**12, default=0, help="0: the suite's own seeds; else another set of its kind"
    )
    command.number(
        "--videos",
        int,
        0,
        _MOST_FILMS,
        default=2,
        help="films, from the worst episode to the best; of several cells the worst episodes of this many worst cells, "
        "and the best of the best",
    )
    command.add_argument(
        "--record", action="store_true", help="also write the worst and the best episode to bags/ (extra `record`)"
    )
    command.add_argument(
        "--metric",
        type=name,
        action="append",
        default=[],
        help="a metric of your own, module:function or file.py:function of an Episode; may be repeated",
    )
    command.add_argument(
        "--paired",
        action="store_true",
        help="also play each episode without the robot, for what it does to others: delay, detour, added_contact",
    )
    command.add_argument(
        "--resume", action="store_true", help="go on with an evaluation that was cut short in the folder --out"
    )
    command.add_argument("--out", type=name, default=out, help="folder for results.json, report.html and videos/")
    add_wire(command)
    add_pace(command)
    add_executor(command)
    command.set_defaults(run=_evaluate)
