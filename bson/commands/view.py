"""An agent that drives, to see: `bson render`, `bson live`."""

from typing import Any

from bson.commands.flags import add_setting, command_line, overrides
from macid.command import MOST_SEED, add_address, name


def _render(args):
    from bson import benchmark

    path = benchmark.film(
        args.agent,
        args.out,
        seed=args.seed,
        step=args.step,
        track=args.track,
        sensor=args.sensor,
        overrides=overrides(args),
        untrained=args.untrained_setting,
    )
    print(f"Written: {path}")
    return 0


def _live(args):
    from bson import benchmark

    benchmark.live(
        args.agent,
        args.out,
        suite=args.suite,
        cell=args.cell,
        seed=args.seed,
        track=args.track,
        sensor=args.sensor,
        overrides=overrides(args),
        untrained=args.untrained_setting,
        host=args.host,
        port=args.port,
        token=args.token,
        stays=args.stay,
        command=command_line(args.argv),
    )
    return 0


def add_commands(commands: Any, defaults: dict[str, Any]) -> None:
    """Adds the commands to `commands`, argparse's subparsers; `defaults`: what each is made with."""
    render = commands.add_parser("render", help="film one seed", **defaults)
    add_setting(render)
    render.number("--seed", int, 0, MOST_SEED, default=0)
    render.number(
        "--step", int, -MOST_SEED, MOST_SEED, default=None, help="of a .png: the control step (default: halfway)"
    )
    render.add_argument("--out", type=name, default="episode.webm", help="a .webm film, or a .png picture")
    render.set_defaults(run=_render)

    live = commands.add_parser(
        "live", help="a page to drive in, in 3D; what a person drives is scored (extra `live`)", **defaults
    )
    add_setting(live, None, "; it drives at first, and you take over with the keys (default: you drive)")
    live.add_argument("--suite", type=name, default=None, help="drive its settings and seeds (bson list)")
    live.add_argument("--cell", type=name, default=None, help="the first setting, of a suite with several")
    live.number(
        "--seed", int, 0, 9 * 10**12, default=0, help="the first one; with --suite, as of evaluate: 0 for its own seeds"
    )
    live.add_argument(
        "--out", type=name, default="human", help="folder for results.json of what you drove, and for the episodes"
    )
    add_address(live)
    live.set_defaults(run=_live)
