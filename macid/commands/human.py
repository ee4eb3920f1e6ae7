"""Real people, and models beside them: `macid human`."""

import pathlib
from typing import Any

from macid.command import (
    MOST_SEEDS,
    PERIOD,
    HelpFormatter,
    name,
)
from macid.commands.flags import MODELS, add_engine, after, chosen_engine, read_preferred_speed, say
from macid.files import UsageError
from macid.state import RADII, TOP_SPEED


def _human_data(args):
    from macid.human.command import data_files

    words = ["macid", "human", "data", "DIR", *(["--figures", "OUT"] if args.figures else [])]
    data_files(args.data, args.figures, print, " ".join(words))
    return 0


def _human_measure(args):
    from macid.human.measure import Options, measure, table

    engine, note = chosen_engine(args)
    if args.lcf is not None and len(args.lcf) > 2:
        raise UsageError(f"--lcf takes one LCF, or the least and the greatest, not {len(args.lcf)} numbers.")
    options = Options(
        radius=args.radius,
        preferred_speed=args.preferred_speed,
        max_speed=args.max_speed,
        lcf=None if args.lcf is None else (args.lcf[0], args.lcf[-1]),
        period=args.period,
        matched=args.matched,
        seeds=args.seeds,
        engine=engine,
        only=args.only,
    )
    document = measure(args.pedestrian, args.data, options, args.out, show=after(note, say))
    print(table(document))
    print(f"Written to {pathlib.Path(args.out)}")
    return 0


def add_commands(commands: Any) -> None:
    """Adds the commands to `commands`, argparse's subparsers."""
    human = commands.add_parser("human", help="real people's walks, and models measured against them")
    human = human.add_subparsers(dest="what", required=True, metavar="what")
    data = human.add_parser(
        "data",
        help="read files of people's walks: what they are, and whether they are sound",
        formatter_class=HelpFormatter,
    )
    data.add_argument("data", type=name, metavar="DIR", help="a folder with files (.txt, .csv, .dat), or one file")
    data.add_argument("--figures", type=name, default=None, metavar="OUT", help="folder for people's figures of them")
    data.set_defaults(run=_human_data)
    measure = human.add_parser(
        "measure", help="a pedestrian model beside real people, by many measures", formatter_class=HelpFormatter
    )
    measure.add_argument("--pedestrian", type=name, required=True, help=f"{MODELS}; or a file of people's walks")
    measure.add_argument("--data", type=name, default=None, metavar="DIR", help="people's files, to be replayed")
    measure.number("--radius", float, *RADII, help="of people [m] (default: the policy's own, or 0.35)")
    measure.number("--seeds", int, 1, MOST_SEEDS, default=3, help="a method's policies, or runs")
    measure.number(
        "--lcf", float, -10.0, 10.0, nargs="+", default=None, help="everybody's LCF, or a range (default: Table II's)"
    )
    measure.add_argument("--matched", action="store_true", help="in open scenes, at the real people's mean speeds")
    measure.add_argument(
        "--preferred-speed",
        type=read_preferred_speed,
        help="a number [m/s], LO:HI, or human (default: the policy's own)",
    )
    measure.number("--max-speed", float, 0.1, TOP_SPEED, help="of people [m/s] (default: the policy's own, or 1.5)")
    measure.number("--period", float, **PERIOD, help="time between decisions [s] (default: the policy's own)")
    measure.add_argument("--only", default=None, choices=["open", "flows", "knob"], help="one part of it alone")
    add_engine(measure)
    measure.add_argument("--out", type=name, default="macid-human", help="folder: measured.json, index.html, film.webm")
    measure.set_defaults(run=_human_measure)
