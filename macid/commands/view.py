"""A crowd, to see and to take elsewhere: `macid watch`, `live`, `export`."""

import pathlib
import shlex
from typing import Any

from macid import start
from macid.command import (
    MOST_PEOPLE,
    MOST_SEED,
    PERIOD,
    HelpFormatter,
    add_address,
    name,
)
from macid.commands.flags import MODELS, add_people, read_level, say
from macid.files import UsageError


def _watch(args):
    from macid import benchmark

    path = benchmark.watch(
        args.pedestrian,
        args.out,
        level=args.level,
        lcf=args.lcf,
        seed=args.seed,
        seconds=args.seconds,
        period=args.period,
        speed=args.speed,
        follow=args.follow,
        at=args.at,
        scale=args.scale,
        show=say,
        radius=args.radius,
        preferred_speed=args.preferred_speed,
        max_speed=args.max_speed,
        companions=args.companions,
    )
    print(f"Written: {path}")
    return 0


def _live(args):
    from macid import benchmark

    benchmark.live(
        args.pedestrian,
        level=args.level,
        people=args.people,
        lcf=args.lcf,
        seed=args.seed,
        period=args.period,
        leave=args.leave,
        host=args.host,
        port=args.port,
        token=args.token,
        stays=args.stay,
    )
    return 0


def _export(args):
    from macid.crowd import CrowdConfig
    from macid.evaluate import level_seed
    from macid.export import export
    from macid.layout import load_level
    from macid.maps import load_map
    from macid.scene import PersonConfig

    if args.map and args.level is not None:
        raise UsageError("--map and --level both say where: give one of them.")
    level = 2 if args.level is None else args.level
    layout = load_map(args.map) if args.map else load_level(level)
    seed = args.seed if args.map else (args.seed, *level_seed(level))
    number = args.people or layout.pedestrians or CrowdConfig.number
    config = CrowdConfig(
        number=number,
        period=args.period,
        lcf=tuple(args.lcf),
        person=PersonConfig(radius=args.radius),
        preferred_speed=args.preferred_speed,
        max_speed=args.max_speed,
        companions=args.companions,
    )
    start.cleaning_up()
    export(layout, config, seed, args.out, f"macid {shlex.join(args.argv)}")
    print(f"Written: {args.out}. How to read it: {pathlib.Path(args.out) / 'README.md'}")
    return 0


def add_commands(commands: Any) -> None:
    """Adds the commands to `commands`, argparse's subparsers."""
    watch = commands.add_parser("watch", help="film a crowd", formatter_class=HelpFormatter)
    watch.add_argument("--pedestrian", type=name, default="macid", help=MODELS)
    watch.add_argument("--level", type=read_level, default=2, help="as of evaluate: 1 to 4, v1 to v4, foyer, ...")
    watch.add_argument(
        "--lcf", type=float, nargs=2, default=None, metavar=("LO", "HI"), help="range of LCFs (default: Table II's)"
    )
    watch.number("--seed", int, 0, MOST_SEED, default=0, help="the episode of 'evaluate --episodes 1' with this seed")
    watch.add_argument("--seconds", type=float, default=20.0, help="of the crowd's time")
    watch.number("--period", float, **PERIOD, help="time between decisions [s] (default: the policy's own)")
    watch.add_argument("--speed", type=int, default=1, choices=[1, 2, 4], help="how many times as fast a film plays")
    watch.add_argument(
        "--follow", type=int, default=None, help="whose eyes to look through (default: one with far to go)"
    )
    watch.add_argument("--at", type=float, default=None, help="of a .png: the time in seconds (default: halfway)")
    add_people(watch)
    watch.add_argument("--scale", type=float, default=0.75, help="of the picture: 1 is 1500 x 760")
    watch.add_argument("--out", type=name, default="crowd.webm", help="a .webm film, or a .png picture")
    watch.set_defaults(run=_watch)

    live = commands.add_parser(
        "live",
        help="a page with a crowd in 3D, whose LCFs are turned while it walks (extra `live`)",
        formatter_class=HelpFormatter,
    )
    live.add_argument("--pedestrian", type=name, default="macid", help=MODELS)
    live.add_argument("--level", type=read_level, default=2, help="as of evaluate: 1 to 4, v1 to v4, foyer, ...")
    live.number("--people", int, 1, 500, default=None, help="(default: the level's)")
    live.add_argument(
        "--lcf", type=float, nargs=2, default=None, metavar=("LO", "HI"), help="range of LCFs (default: Table II's)"
    )
    live.number("--seed", int, 0, MOST_SEED, default=0, help="the episode of 'evaluate --episodes 1' with this seed")
    live.number("--period", float, **PERIOD, help="time between decisions [s] (default: the policy's own)")
    live.add_argument(
        "--leave", action="store_true", help="a person who arrives leaves, as in evaluate, instead of walking on"
    )
    add_address(live)
    live.set_defaults(run=_live)

    export = commands.add_parser(
        "export",
        help="write one seed's crowd as MJCF, for MuJoCo, its viewer and MJX without this project",
        formatter_class=HelpFormatter,
    )
    export.add_argument("--level", type=read_level, help="as of evaluate: 1 to 4, v1 to v4, foyer, ... (default: 2)")
    export.add_argument("--map", type=name, help="instead of a level, a map's name (bson list) or file")
    export.number("--people", int, 1, MOST_PEOPLE, default=None, help="(default: the level's or the map's, else 50)")
    export.number(
        "--seed", int, 0, MOST_SEED, default=0, help="of a level, the episode of 'evaluate --episodes 1' with it"
    )
    export.number("--period", float, **PERIOD, default=0.02, help="time between decisions [s]")
    export.add_argument("--lcf", type=float, nargs=2, default=(-2.0, 2.0), metavar=("LO", "HI"), help="range of LCFs")
    add_people(export)
    export.add_argument("--out", type=name, required=True, help="folder, new or empty")
    export.set_defaults(run=_export)


DRAW_NOTHING = (_live, _export)  # commands that need no OpenGL
