"""Pedestrians that learn, and how fast: `macid train`, `macid bench`."""

import pathlib
from typing import Any

from macid.command import (
    MOST_SEEDS,
    MOST_STEPS,
    MOST_TRAINING_SEED,
    MOST_WORLDS,
    PERIOD,
    HelpFormatter,
    add_executor,
    name,
)
from macid.commands.flags import PRESETS, ROLLOUT, add_engine, after, chosen_engine, read_level
from macid.files import check_file, new_folder, write_json


def _train(args):
    from macid import benchmark

    engine, note = chosen_engine(args)
    given = {
        "nworld": args.worlds,
        "rollout": args.rollout,
        "episode": args.episode,
        "agent_steps": None if args.agent_steps is None else int(args.agent_steps),
        "batch": args.batch,
        "epochs": args.epochs,
        "learning_rate": args.learning_rate,
        "period": args.period,
    }
    folders = benchmark.train(
        args.method,
        args.out,
        preset=args.preset,
        seed=args.seed,
        seeds=args.seeds,
        resume=args.resume,
        tensorboard=args.tensorboard,
        executor=args.executor,
        ray_address=args.ray_address,
        workers=args.workers,
        show=after(note, lambda line: print(line, flush=True)),
        level=args.level,
        engine=engine,
        **{name: value for name, value in given.items() if value is not None},
    )
    for folder in folders:
        print(f"Written: {folder / 'policy.npz'}, {folder / 'policy.json'}, {folder / 'curve.csv'}")
    return 0


def _bench(args):
    from macid import bench
    from macid.layout import load_level

    for level in args.levels:
        load_level(level)
    if args.out:
        check_file(args.out, "JSON file")
    engine, note = chosen_engine(args)
    rows = bench.run(
        engine,
        args.levels,
        args.worlds,
        args.seconds,
        args.preset,
        after(note, lambda line: print(line, flush=True)),
        rollout=args.rollout,
        only=args.only,
        profile=args.profile,
    )
    if args.out:
        with new_folder(pathlib.Path(args.out).parent):
            write_json(args.out, rows)
    return 0


def add_commands(commands: Any) -> None:
    """Adds the commands to `commands`, argparse's subparsers."""
    train = commands.add_parser("train", help="train pedestrians by multi-agent PPO", formatter_class=HelpFormatter)
    train.add_argument(
        "--method", type=name, default="macid", help="ipo, mfpo, copo, macid, macid-tri, -touch or -human"
    )
    add_engine(train)
    train.add_argument("--level", type=read_level, default=2, help="as of evaluate: 1 to 4, v1 to v4, foyer, ...")
    train.number("--seed", int, 0, MOST_TRAINING_SEED, default=0, help="the first seed")
    train.number("--seeds", int, 1, MOST_SEEDS, default=1, help="how many, at once")
    train.number("--worlds", int, 1, MOST_WORLDS, help="crowds at once (default: 16; preset gpu: 1024; paper: 1)")
    train.number("--rollout", **ROLLOUT, help="decisions between updates (default: 125; gpu: 25; paper: 1000)")
    train.number("--episode", int, 1, 1_000_000, help="rollouts that an episode lasts (default: 8; gpu: 40; paper: 1)")
    train.number("--batch", int, 1, 1_000_000_000, help="agent-steps of a gradient step (default: the preset's)")
    train.number("--epochs", int, 1, 1000, help="passes of an update over its agent-steps (default: the preset's)")
    train.number("--learning-rate", float, 0.0, 1.0, above=True, help="at the beginning (default: 0.001)")
    train.number("--period", float, **PERIOD, help="time between decisions [s] (default: 0.02; human: 0.1)")
    train.number(
        "--agent-steps",
        float,
        1.0,
        MOST_STEPS,
        help="budget (default: 20e6; preset gpu: 300e6; paper: the paper's 50e6)",
    )
    train.add_argument("--preset", default="fast", choices=PRESETS, help="hyperparameters")
    train.add_argument("--out", type=name, default="runs", help="folder; each seed gets one in it")
    train.add_argument("--resume", action="store_true", help="go on from the last checkpoint")
    add_executor(train)
    train.add_argument("--tensorboard", action="store_true", help="also log the curves for TensorBoard")
    train.set_defaults(run=_train)

    bench = commands.add_parser("bench", help="measure agent-steps/s", formatter_class=HelpFormatter)
    add_engine(bench)
    bench.add_argument("--levels", type=read_level, nargs="+", default=[1, 2, 3, 4])
    bench.number("--worlds", int, 1, MOST_WORLDS, nargs="+", default=[1, 4, 16, 64])
    bench.number("--seconds", float, 0.0, 1e6, above=True, default=3.0, help="a case")
    bench.number("--rollout", **ROLLOUT, default=50, help="decisions between updates")
    bench.add_argument("--only", default=None, choices=["rollout", "training"], help="one of the two alone")
    bench.add_argument("--profile", action="store_true", help="also what the parts of an iteration take")
    bench.add_argument("--preset", default="fast", choices=PRESETS)
    bench.add_argument("--out", type=name, default=None, help="JSON file")
    bench.set_defaults(run=_bench)
