"""Robots that learn: `bson train`."""

import sys
from typing import Any

from bson.commands.flags import add_engine, add_task, overrides
from macid import start
from macid.command import MOST_SEEDS, MOST_STEPS, MOST_TRAINING_SEED, MOST_WORLDS, add_executor, name
from macid.executors import make_executor
from macid.files import UsageError


def _train(args):
    from bson.simulation.engines import engine_limits, engine_name

    limits = engine_limits(args.engine)
    if engine_name(args.engine) == "warp":
        return _train_warp(args, limits)
    from bson import benchmark
    from bson.learning.hyperparameters import read_changes

    folders = benchmark.train(
        args.algo,
        args.out,
        seed=args.seed,
        seeds=args.seeds,
        steps=int(args.steps),
        worlds=args.worlds or 16,
        preset=args.preset,
        hyperparameters=read_changes(args.hyperparameter),
        **_validation(args),
        overrides=overrides(args),
        demonstrations=args.demonstrations,
        inputs=args.inputs,
        draw=args.draw,
        teacher=args.teacher,
        shield=args.shield,
        start=args.start,
        resume=args.resume,
        tensorboard=args.tensorboard,
        executor=args.executor,
        ray_address=args.ray_address,
        workers=args.workers,
    )
    for folder in folders:
        policy = folder / "policy.npz"
        print(f"Written: {policy}, {folder / 'policy.json'}. Score it: bson evaluate --agent {policy}")
    return 0


def _validation(args):
    """What the flags say of validation, where they say it."""
    chosen = {"validate_every": args.validate_every, "validate_episodes": args.validate_episodes}
    return {name: int(value) for name, value in chosen.items() if value is not None}


def _train_warp(args, limits):
    if args.demonstrations is not None:
        raise UsageError("--demonstrations are what bc learns from, and --engine warp has no bc: leave them out.")
    if args.teacher is not None:
        raise UsageError("--teacher is whom bc imitates, and --engine warp has no bc: leave it out.")
    if args.shield:
        raise UsageError("--shield is of bc, and --engine warp has no bc: leave it out.")
    if args.preset != "fast":
        raise UsageError("--engine warp has hyperparameters of its own, for thousands of worlds: leave --preset out.")
    if args.seeds != 1 or args.executor != "local":
        raise UsageError("--engine warp trains one seed in this process: leave --seeds and --executor out.")
    make_executor(args.executor, args.ray_address, args.workers)  # refuses flags that are for others
    from tqdm import tqdm

    from bson.learning.device_ppo import STARTED, DevicePpoConfig, DeviceTrainConfig, train
    from bson.learning.hyperparameters import changed, read_changes

    more: dict[str, Any] = _validation(args) | ({} if args.worlds is None else {"num_envs": args.worlds})
    usual = DevicePpoConfig() if args.start is None else STARTED
    more["hyperparameters"] = changed(usual, read_changes(args.hyperparameter))
    more |= {"algo": args.algo, "inputs": args.inputs, "draw": args.draw, "start": args.start}
    config = DeviceTrainConfig(args.seed, int(args.steps), overrides(args), **more)
    start.cleaning_up()
    with tqdm(total=config.steps, unit="step", unit_scale=True, desc=config.name, file=sys.stderr, delay=0.5) as bar:

        def show(steps, figures, validation=False):
            bar.n = min(steps, config.steps)
            text = "  ".join(f"{name} {value:.3g}" for name, value in figures.items())
            if validation:
                bar.write(f"{steps:,} steps, validation: {text}", file=sys.stderr)
            bar.set_postfix_str(text)

        folder = train(config, args.out, args.resume, show, tensorboard=args.tensorboard, limits=limits)
    policy = folder / "policy.npz"
    print(f"Written: {policy}, {folder / 'policy.json'}. Score it: bson evaluate --agent {policy}")
    return 0


def add_commands(commands: Any, defaults: dict[str, Any]) -> None:
    """Adds the commands to `commands`, argparse's subparsers; `defaults`: what each is made with."""
    train = commands.add_parser("train", help="train a robot: PPO, SAC, TAC or BC (extra `agents`)", **defaults)
    train.add_argument(
        "--algo",
        type=name,
        default="ppo",
        help="ppo, sac, tac, or bc, which learns from the shipped ppo; with a memory, sac and tac keep the last "
        "100,000 steps for replay, at most 0.3 GB, in checkpoints too",
    )
    train.number(
        "--steps", float, 1.0, MOST_STEPS, default=1e6, help="control steps of all worlds; of demonstrations with bc"
    )
    train.number("--worlds", int, 1, MOST_WORLDS, default=None, help="at once (default: 16; with --engine warp 1024)")
    add_engine(train, "ppo")
    train.number("--seed", int, 0, MOST_TRAINING_SEED, default=0, help="the first seed")
    train.number(
        "--seeds", int, 1, MOST_SEEDS, default=1, help="how many, one after the other, or at once with --executor ray"
    )
    train.add_argument(
        "--preset", default="fast", choices=["fast", "paper"], help="hyperparameters; paper: as far as it gives them"
    )
    train.add_argument(
        "--hyperparameter",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change one of the algorithm, e.g. learning_rate=3e-4; an unknown one lists them; may be repeated",
    )
    train.number(
        "--validate-every",
        float,
        1.0,
        MOST_STEPS,
        default=None,
        help="steps between two validations; imitation has one each round (default: 100e3; with --engine warp 2e6)",
    )
    train.number(
        "--validate-episodes",
        int,
        1,
        100_000,
        default=None,
        help="by which the policy that is kept is chosen (default: 64)",
    )
    add_task(train)
    train.add_argument("--out", type=name, default="runs", help="folder; each training gets one in it")
    train.add_argument(
        "--demonstrations",
        type=name,
        default=None,
        metavar="DATASET",
        help="of bc: a Minari dataset's id or folder, in place of the expert (extra `data`)",
    )
    train.add_argument(
        "--inputs",
        type=name,
        default="scans",
        help="what the robot sees: scans; guided: a planner's way and people, on the map; with a memory: gru "
        "(a map of its own, people by the LIDAR), gru-map, camera, gru-scans; with --engine warp: scans, gru-scans",
    )
    train.add_argument(
        "--draw",
        type=name,
        default=None,
        help="draw episodes' settings: standard, or a .toml file; not with scans; with --engine warp: crowds",
    )
    train.add_argument(
        "--teacher",
        type=name,
        default=None,
        metavar="AGENT",
        help="of bc with a memory: whom it imitates (default: tac)",
    )
    train.add_argument(
        "--shield",
        action="store_true",
        help="of bc with a memory and a LIDAR: it drives behind the shield of gru-shield as it learns",
    )
    train.add_argument(
        "--start",
        type=name,
        default=None,
        metavar="POLICY",
        help="of a robot with a memory: begin from it, as gru",
    )
    train.add_argument("--resume", action="store_true", help="go on from the last checkpoint")
    add_executor(train)
    train.add_argument("--tensorboard", action="store_true", help="also log the curve for TensorBoard")
    train.set_defaults(run=_train)
