"""The `macid` command."""

import argparse
import pathlib
import sys

from macid.files import HelpFormatter, UsageError, output_folder, run_command, write_json


def _level(text):
    return int(text) if text.isdecimal() else text


def _evaluate(args):
    from macid.crowd import CrowdConfig
    from macid.evaluate import evaluate_level, format_table, lcf_bins, level_name, table_lcf, usual_period
    from macid.layout import load_level

    period = usual_period(args.pedestrian) if args.period is None else args.period
    for level in args.levels:
        load_level(level)
    if args.episodes < 1:
        raise UsageError(f"--episodes must be at least 1, not {args.episodes}.")
    if args.seed < 0:
        raise UsageError(f"--seed must be at least 0, not {args.seed}.")
    if args.bins and args.lcf:
        raise UsageError("--bins has LCFs of its own: leave --lcf out.")
    if args.bins:
        ranges = lcf_bins(args.pedestrian)
    else:
        ranges = [tuple(args.lcf or table_lcf(args.pedestrian))]
    configs = [CrowdConfig(period=period, lcf=lcf) for lcf in ranges]
    out = pathlib.Path(args.out)
    if out.is_dir():
        raise UsageError(f"--out '{out}' is a folder. Name a JSON file.")
    output_folder(out.parent)
    rows = []
    for level in args.levels:
        print(f"{args.pedestrian} on {level_name(level)} ...", file=sys.stderr, flush=True)
        rows += [
            evaluate_level(args.pedestrian, level, args.episodes, args.seed, config, args.engine) for config in configs
        ]
    print(format_table(rows))
    write_json(out, rows)
    print(f"Written to {out}")
    return 0


def _watch(args):
    from tqdm import tqdm

    from macid import drawing, watch
    from macid.crowd import CrowdConfig
    from macid.evaluate import level_name, table_lcf, usual_period
    from macid.layout import load_level

    period = usual_period(args.pedestrian) if args.period is None else args.period
    people = load_level(args.level).pedestrians
    path = pathlib.Path(args.out)
    if path.suffix not in (".webm", ".png"):
        raise UsageError(f"--out must end in .webm (a film) or .png (a picture), not '{path.name}'.")
    if path.is_dir():
        raise UsageError(f"--out '{path}' is a folder. Name a file.")
    if args.seed < 0:
        raise UsageError(f"--seed must be at least 0, not {args.seed}.")
    if not 0 < args.seconds <= 600:
        raise UsageError(f"--seconds must be above 0 and at most 600, not {args.seconds:g}.")
    if args.follow is not None and not 0 <= args.follow < people:
        raise UsageError(f"--follow must be 0 to {people - 1}, one of the {people} people, not {args.follow}.")
    if not 0.25 <= args.scale <= 2:
        raise UsageError(f"--scale must be 0.25 to 2, not {args.scale:g}.")
    if args.at is not None and path.suffix != ".png":
        raise UsageError("--at is for a picture: let --out end in .png.")
    if args.at is not None and not 0 <= args.at <= args.seconds:
        raise UsageError(f"--at must be 0 to {args.seconds:g}, the episode's length in seconds, not {args.at:g}.")
    lcf = tuple(args.lcf or table_lcf(args.pedestrian))
    config = CrowdConfig(period=period, duration=args.seconds, lcf=lcf)
    if problem := drawing.gl_problem():
        raise UsageError(f"No pictures here: {problem}")
    output_folder(path.parent)
    print(f"{args.pedestrian} on {level_name(args.level)} ...", file=sys.stderr, flush=True)
    recording = watch.record(args.pedestrian, args.level, config, args.seed)
    if path.suffix == ".png":
        watch.still(recording, path, args.at, args.follow, args.scale)
    else:
        with tqdm(unit="frame", desc="filming", file=sys.stderr) as bar:

            def progress(done, total):
                bar.total = total
                bar.update()

            watch.film(recording, path, args.speed, args.follow, args.scale, progress)
    print(f"Written: {path}")
    return 0


def _train(args):
    from macid.learning.train import PRESETS, TrainConfig, train

    if args.seeds < 1:
        raise UsageError(f"--seeds must be at least 1, not {args.seeds}.")
    if args.seed < 0:
        raise UsageError(f"--seed must be at least 0, not {args.seed}.")
    if not 1 <= args.agent_steps < 1e12:
        raise UsageError(f"--agent-steps must be from 1 to 1e12, not {args.agent_steps}.")
    config = TrainConfig(
        method=args.method,
        level=args.level,
        seed=args.seed,
        engine=args.engine,
        nworld=args.worlds,
        period=args.period,
        agent_steps=int(args.agent_steps),
        ppo=PRESETS[args.preset],
    )
    out = output_folder(args.out)
    train(config, out, args.seeds, resume=args.resume, show=lambda line: print(line, flush=True))
    for seed in range(args.seed, args.seed + args.seeds):
        folder = out / f"{config.name}-{seed}"
        print(f"Written: {folder / 'policy.npz'}, {folder / 'policy.json'}, {folder / 'curve.csv'}")
    return 0


def _bench(args):
    from macid import bench
    from macid.layout import load_level

    for level in args.levels:
        load_level(level)
    if min(args.worlds) < 1 or not 0 < args.seconds < 1e6:
        raise UsageError("--worlds must be at least 1 and --seconds above 0.")
    if args.out:
        output_folder(pathlib.Path(args.out).parent)
        if pathlib.Path(args.out).is_dir():
            raise UsageError(f"--out '{args.out}' is a folder. Name a JSON file.")
    rows = bench.run(
        args.engine, args.levels, args.worlds, args.seconds, args.preset, lambda line: print(line, flush=True)
    )
    if args.out:
        write_json(args.out, rows)
    return 0


def parser():
    """The command's parser."""
    root = argparse.ArgumentParser(prog="macid", description="Pedestrian crowds on MuJoCo.")
    commands = root.add_subparsers(dest="command", required=True, metavar="command")
    evaluate = commands.add_parser(
        "evaluate",
        help="a pedestrian model on the paper's levels (Table II)",
        formatter_class=HelpFormatter,
    )
    evaluate.add_argument("--pedestrian", required=True, help="a rule, a shipped policy, or a policy file (.npz)")
    evaluate.add_argument(
        "--levels",
        type=_level,
        nargs="+",
        default=[1, 2, 3, 4],
        help="1: 25, 2: 50, 3: 100, 4: 200 people; v1 to v4: as many on the maps for validation; or a map of another kind: "
        "big-boxes, small-boxes, foyer, crossroads, furnished, crowded",
    )
    evaluate.add_argument("--episodes", type=int, default=5, help="episodes a level")
    evaluate.add_argument("--seed", type=int, default=0)
    evaluate.add_argument("--period", type=float, help="time between decisions [s] (default: the policy's own)")
    evaluate.add_argument(
        "--lcf", type=float, nargs=2, default=None, metavar=("LO", "HI"), help="range of LCFs (default: Table II's)"
    )
    evaluate.add_argument("--bins", action="store_true", help="Table I: the six sections of the range of LCFs")
    evaluate.add_argument("--engine", default="native", choices=["native", "mjx"])
    evaluate.add_argument("--out", default="macid-evaluate.json", help="JSON file")
    evaluate.set_defaults(run=_evaluate)

    watch = commands.add_parser("watch", help="film a crowd", formatter_class=HelpFormatter)
    watch.add_argument("--pedestrian", default="macid", help="a rule, a shipped policy, or a policy file (.npz)")
    watch.add_argument("--level", type=_level, default=2, help="as of evaluate: 1 to 4, v1 to v4, foyer, ...")
    watch.add_argument(
        "--lcf", type=float, nargs=2, default=None, metavar=("LO", "HI"), help="range of LCFs (default: Table II's)"
    )
    watch.add_argument("--seed", type=int, default=0, help="the episode of 'evaluate --episodes 1' with this seed")
    watch.add_argument("--seconds", type=float, default=20.0, help="of the crowd's time")
    watch.add_argument("--period", type=float, help="time between decisions [s] (default: the policy's own)")
    watch.add_argument("--speed", type=int, default=1, choices=[1, 2, 4], help="how many times as fast a film plays")
    watch.add_argument(
        "--follow", type=int, default=None, help="whose eyes to look through (default: one with far to go)"
    )
    watch.add_argument("--at", type=float, default=None, help="of a .png: the time in seconds (default: halfway)")
    watch.add_argument("--scale", type=float, default=0.75, help="of the picture: 1 is 1500 x 760")
    watch.add_argument("--out", default="crowd.webm", help="a .webm film, or a .png picture")
    watch.set_defaults(run=_watch)

    train = commands.add_parser("train", help="train pedestrians by multi-agent PPO", formatter_class=HelpFormatter)
    train.add_argument("--method", default="macid", help="ipo, mfpo, copo, macid, macid-tri or macid-touch")
    train.add_argument("--engine", default="native", choices=["native", "mjx"], help="native: CPU; mjx: an accelerator")
    train.add_argument("--level", type=_level, default=2, help="as of evaluate: 1 to 4, v1 to v4, foyer, ...")
    train.add_argument("--seed", type=int, default=0, help="the first seed")
    train.add_argument("--seeds", type=int, default=1, help="how many, at once")
    train.add_argument("--worlds", type=int, default=16, help="crowds at once")
    train.add_argument("--period", type=float, default=0.02, help="time between decisions [s]")
    train.add_argument("--agent-steps", type=float, default=20e6, help="budget, e.g. 20e6")
    train.add_argument("--preset", default="fast", choices=["fast", "paper", "paper-ppo"], help="hyperparameters")
    train.add_argument("--out", default="runs", help="folder; each seed gets one in it")
    train.add_argument("--resume", action="store_true", help="go on from the last checkpoint")
    train.set_defaults(run=_train)

    bench = commands.add_parser("bench", help="measure agent-steps/s", formatter_class=HelpFormatter)
    bench.add_argument("--engine", default="native", choices=["native", "mjx"])
    bench.add_argument("--levels", type=_level, nargs="+", default=[1, 2, 3, 4])
    bench.add_argument("--worlds", type=int, nargs="+", default=[1, 4, 16, 64])
    bench.add_argument("--seconds", type=float, default=3.0, help="a case")
    bench.add_argument("--preset", default="fast", choices=["fast", "paper", "paper-ppo"])
    bench.add_argument("--out", default=None, help="JSON file")
    bench.set_defaults(run=_bench)
    return root


def main(argv=None):
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    return run_command("macid", lambda: args.run(args))


if __name__ == "__main__":
    sys.exit(main())
