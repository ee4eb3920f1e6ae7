"""The `macid` command."""

import argparse
import pathlib
import sys

from macid.files import UsageError, output_folder, run_command, write_json


def _evaluate(args):
    from macid.crowd import CrowdConfig
    from macid.evaluate import evaluate_level, format_table
    from macid.layout import LEVELS
    from macid.pedestrians import make_controller

    make_controller(args.pedestrian, args.period)  # a wrong name is told before anything runs
    if unknown := sorted(set(args.levels) - set(LEVELS)):
        raise UsageError(f"Unknown level {unknown[0]}. Choose among {', '.join(map(str, LEVELS))}.")
    if args.episodes < 1:
        raise UsageError(f"--episodes must be at least 1, not {args.episodes}.")
    config = CrowdConfig(period=args.period, lcf=tuple(args.lcf))
    out = pathlib.Path(args.out)
    if out.is_dir():
        raise UsageError(f"--out '{out}' is a folder. Name a JSON file.")
    output_folder(out.parent)
    rows = []
    for level in args.levels:
        print(f"{args.pedestrian} on Lv.{level} ...", file=sys.stderr, flush=True)
        rows.append(evaluate_level(args.pedestrian, level, args.episodes, args.seed, config, args.engine))
    print(format_table(rows))
    write_json(out, rows)
    print(f"Written to {out}")
    return 0


def parser():
    """The command's parser."""
    root = argparse.ArgumentParser(prog="macid", description="Pedestrian crowds on MuJoCo.")
    commands = root.add_subparsers(dest="command", required=True, metavar="command")
    evaluate = commands.add_parser(
        "evaluate",
        help="a pedestrian model on the paper's levels (Table II)",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    evaluate.add_argument("--pedestrian", required=True, help="social-force, social-force-bodies or orca")
    evaluate.add_argument("--levels", type=int, nargs="+", default=[1, 2, 3, 4], help="1: 25, 2: 50, 3: 100, 4: 200 people")
    evaluate.add_argument("--episodes", type=int, default=5, help="episodes a level")
    evaluate.add_argument("--seed", type=int, default=0)
    evaluate.add_argument("--period", type=float, default=0.02, help="time between decisions [s]")
    evaluate.add_argument("--lcf", type=float, nargs=2, default=[0.67, 1.33], metavar=("LO", "HI"), help="range of LCFs")
    evaluate.add_argument("--engine", default="native", choices=["native", "mjx"])
    evaluate.add_argument("--out", default="macid-evaluate.json", help="JSON file")
    evaluate.set_defaults(run=_evaluate)
    return root


def main(argv=None):
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    return run_command("macid", lambda: args.run(args))


if __name__ == "__main__":
    sys.exit(main())
