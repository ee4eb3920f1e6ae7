"""The `macid` command."""

import argparse
import pathlib
import shlex
import sys
from collections.abc import Sequence

from macid import engines, start
from macid.command import (
    MOST_PEOPLE,
    MOST_SEED,
    MOST_SEEDS,
    MOST_STEPS,
    MOST_TRAINING_SEED,
    MOST_WORLDS,
    PERIOD,
    HelpFormatter,
    Parser,
    add_address,
    add_executor,
    check_words,
    name,
)
from macid.files import UsageError, check_file, new_folder, write_json
from macid.running import run_command, start_mujoco
from macid.state import MAX_SPEED, RADII, RADIUS, TOP_SPEED

_ENGINE = "native (CPU), mjx or warp (GPU), with options as in warp:contacts=4 (default: the best there is; it is told)"
_PRESETS = ["fast", "gpu", "human", "paper", "paper-batch", "paper-ppo"]
_ROLLOUT = {"kind": int, "least": 1, "most": 1_000_000}


def _engine(text):
    """The name of an engine, for argparse."""
    try:
        return engines.engine_name(text)
    except UsageError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _chosen(args):
    """(the engine to use, what to tell of it on stderr); --engine, else the best there is."""
    if args.engine:
        engines.engine_kind(args.engine)
        return args.engine, None
    engine, why = engines.best_engine()
    return engine, f"engine {engine}: {why}"


def _after(note, show):
    """`show`, before whose first line `note` is told on stderr: what is refused before work begins is one line."""
    notes = [note] if note else []

    def tell(line):
        while notes:
            _say(notes.pop())
        show(line)

    return tell


def _preferred_speed(text):
    """A preferred speed, for argparse: a number, LO:HI, or human."""
    from macid.traits import check_preferred_speed

    try:
        parts = [float(part) for part in text.split(":")]
    except ValueError:
        parts = [text]
    try:
        return check_preferred_speed(parts[0] if len(parts) == 1 else tuple(parts))
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _add_people(command):
    """Adds the flags that say what people are like."""
    command.number("--radius", float, *RADII, default=RADIUS, help="of people [m]")
    command.add_argument(
        "--preferred-speed",
        type=_preferred_speed,
        help="at which people want to walk [m/s]: a number, LO:HI, or human (default: each model's own)",
    )
    command.number("--max-speed", float, 0.1, TOP_SPEED, default=MAX_SPEED, help="of people [m/s]")
    command.number("--companions", float, 0.0, 1.0, help="share of people who walk in twos and threes (default: none)")


def _level(text):
    return int(text) if text.isdecimal() else text


def _say(line):
    print(line, file=sys.stderr, flush=True)


def _evaluate(args):
    from macid import benchmark
    from macid.evaluate import format_table

    engine, note = _chosen(args)
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
        show=_after(note, _say),
        radius=args.radius,
        preferred_speed=args.preferred_speed,
        max_speed=args.max_speed,
        companions=args.companions,
    )
    print(format_table(rows))
    print(f"Written to {pathlib.Path(args.out)}")
    return 0


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
        show=_say,
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


def _train(args):
    from macid import benchmark

    engine, note = _chosen(args)
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
        show=_after(note, lambda line: print(line, flush=True)),
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
    engine, note = _chosen(args)
    rows = bench.run(
        engine,
        args.levels,
        args.worlds,
        args.seconds,
        args.preset,
        _after(note, lambda line: print(line, flush=True)),
        rollout=args.rollout,
        only=args.only,
        profile=args.profile,
    )
    if args.out:
        with new_folder(pathlib.Path(args.out).parent):
            write_json(args.out, rows)
    return 0


def _human_data(args):
    from macid.human.command import data_files

    words = ["macid", "human", "data", "DIR", *(["--figures", "OUT"] if args.figures else [])]
    data_files(args.data, args.figures, print, " ".join(words))
    return 0


def _human_measure(args):
    from macid.human.measure import Options, measure, table

    engine, note = _chosen(args)
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
    document = measure(args.pedestrian, args.data, options, args.out, show=_after(note, _say))
    print(table(document))
    print(f"Written to {pathlib.Path(args.out)}")
    return 0


def parser() -> Parser:
    """The command's parser."""
    root = Parser(prog="macid", description="Pedestrian crowds on MuJoCo.")
    models = "a rule, a shipped policy, or a policy file (.npz)"
    commands = root.add_subparsers(dest="command", required=True, metavar="command")
    evaluate = commands.add_parser(
        "evaluate",
        help="a pedestrian model on the paper's levels (Table II)",
        formatter_class=HelpFormatter,
    )
    evaluate.add_argument("--pedestrian", type=name, required=True, help=models)
    evaluate.add_argument(
        "--levels",
        type=_level,
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
    _add_people(evaluate)
    evaluate.add_argument("--engine", type=_engine, default=None, help=_ENGINE)
    evaluate.add_argument("--out", type=name, default="macid-evaluate.json", help="JSON file")
    evaluate.set_defaults(run=_evaluate)

    watch = commands.add_parser("watch", help="film a crowd", formatter_class=HelpFormatter)
    watch.add_argument("--pedestrian", type=name, default="macid", help=models)
    watch.add_argument("--level", type=_level, default=2, help="as of evaluate: 1 to 4, v1 to v4, foyer, ...")
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
    _add_people(watch)
    watch.add_argument("--scale", type=float, default=0.75, help="of the picture: 1 is 1500 x 760")
    watch.add_argument("--out", type=name, default="crowd.webm", help="a .webm film, or a .png picture")
    watch.set_defaults(run=_watch)

    live = commands.add_parser(
        "live",
        help="a page with a crowd in 3D, whose LCFs are turned while it walks (extra `live`)",
        formatter_class=HelpFormatter,
    )
    live.add_argument("--pedestrian", type=name, default="macid", help=models)
    live.add_argument("--level", type=_level, default=2, help="as of evaluate: 1 to 4, v1 to v4, foyer, ...")
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
    export.add_argument("--level", type=_level, help="as of evaluate: 1 to 4, v1 to v4, foyer, ... (default: 2)")
    export.add_argument("--map", type=name, help="instead of a level, a map's name (bson list) or file")
    export.number("--people", int, 1, MOST_PEOPLE, default=None, help="(default: the level's or the map's, else 50)")
    export.number(
        "--seed", int, 0, MOST_SEED, default=0, help="of a level, the episode of 'evaluate --episodes 1' with it"
    )
    export.number("--period", float, **PERIOD, default=0.02, help="time between decisions [s]")
    export.add_argument("--lcf", type=float, nargs=2, default=(-2.0, 2.0), metavar=("LO", "HI"), help="range of LCFs")
    _add_people(export)
    export.add_argument("--out", type=name, required=True, help="folder, new or empty")
    export.set_defaults(run=_export)

    train = commands.add_parser("train", help="train pedestrians by multi-agent PPO", formatter_class=HelpFormatter)
    train.add_argument(
        "--method", type=name, default="macid", help="ipo, mfpo, copo, macid, macid-tri, -touch or -human"
    )
    train.add_argument("--engine", type=_engine, default=None, help=_ENGINE)
    train.add_argument("--level", type=_level, default=2, help="as of evaluate: 1 to 4, v1 to v4, foyer, ...")
    train.number("--seed", int, 0, MOST_TRAINING_SEED, default=0, help="the first seed")
    train.number("--seeds", int, 1, MOST_SEEDS, default=1, help="how many, at once")
    train.number("--worlds", int, 1, MOST_WORLDS, help="crowds at once (default: 16; preset gpu: 1024; paper: 1)")
    train.number("--rollout", **_ROLLOUT, help="decisions between updates (default: 125; gpu: 25; paper: 1000)")
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
    train.add_argument("--preset", default="fast", choices=_PRESETS, help="hyperparameters")
    train.add_argument("--out", type=name, default="runs", help="folder; each seed gets one in it")
    train.add_argument("--resume", action="store_true", help="go on from the last checkpoint")
    add_executor(train)
    train.add_argument("--tensorboard", action="store_true", help="also log the curves for TensorBoard")
    train.set_defaults(run=_train)

    bench = commands.add_parser("bench", help="measure agent-steps/s", formatter_class=HelpFormatter)
    bench.add_argument("--engine", type=_engine, default=None, help=_ENGINE)
    bench.add_argument("--levels", type=_level, nargs="+", default=[1, 2, 3, 4])
    bench.number("--worlds", int, 1, MOST_WORLDS, nargs="+", default=[1, 4, 16, 64])
    bench.number("--seconds", float, 0.0, 1e6, above=True, default=3.0, help="a case")
    bench.number("--rollout", **_ROLLOUT, default=50, help="decisions between updates")
    bench.add_argument("--only", default=None, choices=["rollout", "training"], help="one of the two alone")
    bench.add_argument("--profile", action="store_true", help="also what the parts of an iteration take")
    bench.add_argument("--preset", default="fast", choices=_PRESETS)
    bench.add_argument("--out", type=name, default=None, help="JSON file")
    bench.set_defaults(run=_bench)

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
    measure.add_argument("--pedestrian", type=name, required=True, help=f"{models}; or a file of people's walks")
    measure.add_argument("--data", type=name, default=None, metavar="DIR", help="people's files, to be replayed")
    measure.number("--radius", float, *RADII, help="of people [m] (default: the policy's own, or 0.35)")
    measure.number("--seeds", int, 1, MOST_SEEDS, default=3, help="a method's policies, or runs")
    measure.number(
        "--lcf", float, -10.0, 10.0, nargs="+", default=None, help="everybody's LCF, or a range (default: Table II's)"
    )
    measure.add_argument("--matched", action="store_true", help="in open scenes, at the real people's mean speeds")
    measure.add_argument(
        "--preferred-speed", type=_preferred_speed, help="a number [m/s], LO:HI, or human (default: the policy's own)"
    )
    measure.number("--max-speed", float, 0.1, TOP_SPEED, help="of people [m/s] (default: the policy's own, or 1.5)")
    measure.number("--period", float, **PERIOD, help="time between decisions [s] (default: the policy's own)")
    measure.add_argument("--only", default=None, choices=["open", "flows", "knob"], help="one part of it alone")
    measure.add_argument("--engine", type=_engine, default=None, help=_ENGINE)
    measure.add_argument("--out", type=name, default="macid-human", help="folder: measured.json, index.html, film.webm")
    measure.set_defaults(run=_human_measure)
    return root


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code. Without `argv`, it is the command of this process (see macid.start)."""
    if argv is None:
        return start.run("macid", start.macid_command)

    def command():
        check_words(argv)
        args = parser().parse_args(argv)
        args.argv = argv
        start_mujoco(draws=args.run not in (_export, _live))
        return args.run(args)

    return run_command("macid", command)


if __name__ == "__main__":
    sys.exit(start.macid())
