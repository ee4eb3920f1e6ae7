"""How a pedestrian model fares: `macid evaluate`."""

import pathlib
from typing import Any

from macid.command import (
    MOST_SEED,
    MOST_WORLDS,
    PERIOD,
    HelpFormatter,
    name,
)
from macid.commands.flags import MODELS, add_engine, add_people, after, chosen_engine, read_level, say


def _evaluate(args):
    from macid import benchmark
    from macid.evaluate import format_table

    engine, note = chosen_engine(args)
    rows = benchmark.evaluate(
        args.pedestrian,
        args.levels,
        episodes=args.episodes,
        seed=args.seed,
        period=args.period,
        lcf=args.lcf,
        bins=args.bins,
        engine=engine,
        out=args.out,
        show=after(note, say),
        radius=args.radius,
        preferred_speed=args.preferred_speed,
        max_speed=args.max_speed,
        companions=args.companions,
    )
    print(format_table(rows))
    print(f"Written to {pathlib.Path(args.out)}")
    return 0


def add_commands(commands: Any) -> None:
    """Adds the commands to `commands`, argparse's subparsers."""
    evaluate = commands.add_parser(
        "evaluate",
        help="a pedestrian model on the paper's levels (Table II)",
        formatter_class=HelpFormatter,
    )
    evaluate.add_argument("--pedestrian", type=name, required=True, help=MODELS)
    evaluate.add_argument(
        "--levels",
        type=read_level,
        nargs="+",
        default=[1, 2, 3, 4],
        help="1: 25, 2: 50, 3: 100, 4: 200 people; v1 to v4: as many on the maps for validation; or a map of another "
        "kind: big-boxes, small-boxes, foyer, crossroads, furnished, crowded",
    )
    evaluate.number("--episodes", int, 1, MOST_WORLDS, default=5, help="episodes a level")
    evaluate.number("--seed", int, 0, MOST_SEED, default=0)
    evaluate.number("--period", float, **PERIOD, help="time between decisions [s] (default: the policy's own)")
    evaluate.add_argument(
        "--lcf", type=float, nargs=2, default=None, metavar=("LO", "HI"), help="range of LCFs (default: Table II's)"
    )
    evaluate.add_argument("--bins", action="store_true", help="Table I: the six sections of the range of LCFs")
    add_people(evaluate)
    add_engine(evaluate)
    evaluate.add_argument("--out", type=name, default="macid-evaluate.json", help="JSON file")
    evaluate.set_defaults(run=_evaluate)
