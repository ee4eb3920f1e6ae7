"""The `macid` command."""

import argparse
import pathlib
import sys

from macid.files import UsageError, output_folder, run_command, write_json


def _evaluate(args):
    from macid.crowd import CrowdConfig
    from macid.evaluate import evaluate_level, format_table, lcf_bins, table_lcf
    from macid.layout import LEVELS
    from macid.pedestrians import make_controller

    make_controller(args.pedestrian, args.period)  # a wrong name is told before anything runs
    if unknown := sorted(set(args.levels) - set(LEVELS)):
        raise UsageError(f"Unknown level {unknown[0]}. Choose among {', '.join(map(str, LEVELS))}.")
    if args.episodes < 1:
        raise UsageError(f"--episodes must be at least 1, not {args.episodes}.")
    if args.seed < 0:
        raise UsageError(f"--seed must be at least 0, not {args.seed}.")
    if args.bins:
        ranges = lcf_bins(args.pedestrian)
    else:
        ranges = [tuple(args.lcf or table_lcf(args.pedestrian))]
    configs = [CrowdConfig(period=args.period, lcf=lcf) for lcf in ranges]
    out = pathlib.Path(args.out)
    if out.is_dir():
        raise UsageError(f"--out '{out}' is a folder. Name a JSON file.")
    output_folder(out.parent)
    rows = []
    for level in args.levels:
        print(f"{args.pedestrian} on Lv.{level} ...", file=sys.stderr, flush=True)
        rows += [
            evaluate_level(args.pedestrian, level, args.episodes, args.seed, config, args.engine) for config in configs
        ]
    print(format_table(rows))
    write_json(out, rows)
    print(f"Written to {out}")
    return 0


def _train(args):
    from macid.learning.train import PRESETS, TrainConfig, train

    if args.seeds < 1:
        raise UsageError(f"--seeds must be at least 1, not {args.seeds}.")
    if not args.agent_steps > 0:
        raise UsageError(f"--agent-steps must be above 0, not {args.agent_steps}.")
    configs = [
        TrainConfig(
            method=args.method,
            level=args.level,
            seed=seed,
            engine=args.engine,
            nworld=args.worlds,
            period=args.period,
            agent_steps=int(args.agent_steps),
            ppo=PRESETS[args.preset],
        )
        for seed in range(args.seed, args.seed + args.seeds)
    ]
    for config in configs:
        out = output_folder(pathlib.Path(args.out) / f"{config.method}-{config.seed}")
        print(f"{config.method}, seed {config.seed}: {out}", flush=True)
        train(config, out, resume=args.resume, show=lambda line: print(line, flush=True))
        print(f"Written: {out / 'policy.npz'}, {out / 'policy.json'}, {out / 'curve.csv'}")
    return 0


def _bench(args):
    from macid import bench
    from macid.layout import load_level

    for level in args.levels:
        load_level(level)
    if min(args.worlds) < 1 or not args.seconds > 0:
        raise UsageError("--worlds must be at least 1 and --seconds above 0.")
    rows = bench.run(
        args.engine, args.levels, args.worlds, args.seconds, args.preset, lambda line: print(line, flush=True)
    )
    if args.out:
        output_folder(pathlib.Path(args.out).parent)
        write_json(args.out, rows)
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
    evaluate.add_argument("--pedestrian", required=True, help="a rule, a shipped policy, or a policy file (.npz)")
    evaluate.add_argument(
        "--levels", type=int, nargs="+", default=[1, 2, 3, 4], help="1: 25, 2: 50, 3: 100, 4: 200 people"
    )
    evaluate.add_argument("--episodes", type=int, default=5, help="episodes a level")
    evaluate.add_argument("--seed", type=int, default=0)
    evaluate.add_argument("--period", type=float, default=0.02, help="time between decisions [s]")
    evaluate.add_argument(
        "--lcf", type=float, nargs=2, default=None, metavar=("LO", "HI"), help="range of LCFs (default: Table II's)"
    )
    evaluate.add_argument("--bins", action="store_true", help="Table I: the six sections of the range of LCFs")
    evaluate.add_argument("--engine", default="native", choices=["native", "mjx"])
    evaluate.add_argument("--out", default="macid-evaluate.json", help="JSON file")
    evaluate.set_defaults(run=_evaluate)

    train = commands.add_parser(
        "train", help="train pedestrians by multi-agent PPO", formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    train.add_argument("--method", default="macid", help="ipo, mfpo, copo, macid or macid-tri")
    train.add_argument("--engine", default="native", choices=["native", "mjx"], help="native: CPU; mjx: an accelerator")
    train.add_argument("--level", type=int, default=2)
    train.add_argument("--seed", type=int, default=0, help="the first seed")
    train.add_argument("--seeds", type=int, default=1, help="how many, one after the other")
    train.add_argument("--worlds", type=int, default=16, help="crowds at once")
    train.add_argument("--period", type=float, default=0.02, help="time between decisions [s]")
    train.add_argument("--agent-steps", type=float, default=20e6, help="budget, e.g. 20e6")
    train.add_argument("--preset", default="fast", choices=["fast", "paper", "paper-ppo"], help="hyperparameters")
    train.add_argument("--out", default="runs", help="folder; each seed gets one in it")
    train.add_argument("--resume", action="store_true", help="go on from the last checkpoint")
    train.set_defaults(run=_train)

    bench = commands.add_parser(
        "bench", help="measure agent-steps/s", formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    bench.add_argument("--engine", default="native", choices=["native", "mjx"])
    bench.add_argument("--levels", type=int, nargs="+", default=[1, 2, 3, 4])
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
