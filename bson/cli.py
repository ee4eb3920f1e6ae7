"""The `bson` command."""

import pathlib
import shlex
import sys
from collections.abc import Sequence
from typing import Any

from bson.commands import board
from macid import start
from macid.command import (
    MOST_PEOPLE,
    MOST_SEED,
    MOST_SEEDS,
    MOST_STEPS,
    MOST_TRAINING_SEED,
    MOST_WORLDS,
    Parser,
    add_address,
    add_executor,
    check_words,
    name,
)
from macid.files import (
    HelpFormatter,
    UsageError,
    check_file,
    new_folder,
    run_command,
    start_mujoco,
    write_json,
)

_MOST_FILMS = 10_000


def _overrides(args):
    """What the flag --set changes of the task."""
    from bson.evaluation.overrides import read_overrides

    return read_overrides(args.set)


_PLACE = ("--resume",)  # flags that don't change results: without a value here, with one below
_PLACE_WITH = ("--executor", "--ray-address", "--workers")


def _words(argv):
    """The command line without the flags that don't change results."""
    kept, skip = [], False
    for word in argv:
        if not skip and word not in _PLACE and word.partition("=")[0] not in _PLACE_WITH:
            kept.append(word)
        skip = not skip and word in _PLACE_WITH
    return "bson " + shlex.join(kept)


def _evaluate(args):
    from bson import benchmark
    from bson.evaluation.play import format_summary

    found = benchmark.evaluate(
        args.agent,
        args.suite,
        passphrase=board.read_passphrase(args),
        out=args.out,
        episodes=args.episodes,
        seed=args.seed,
        track=args.track,
        sensor=args.sensor,
        overrides=_overrides(args),
        untrained=args.untrained_setting,
        paired=args.paired,
        metrics=args.metric,
        videos=args.videos,
        record=args.record,
        resume=args.resume,
        executor=args.executor,
        ray_address=args.ray_address,
        workers=args.workers,
        engine=args.engine,
        stamped=not args.twist,
        real_time=args.real_time,
        timeout=args.timeout,
        command=_words(args.argv),
        told=lambda results: print(format_summary(results.content), flush=True),
    )
    print(f"Written: {', '.join(map(str, found.written))}")
    return 0


def _render(args):
    from bson import benchmark

    path = benchmark.film(
        args.agent,
        args.out,
        seed=args.seed,
        step=args.step,
        track=args.track,
        sensor=args.sensor,
        overrides=_overrides(args),
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
        overrides=_overrides(args),
        untrained=args.untrained_setting,
        host=args.host,
        port=args.port,
        token=args.token,
        stays=args.stay,
        command=_words(args.argv),
    )
    return 0


def _ros(args):
    from bson import benchmark

    benchmark.ros(
        suite=args.suite,
        seed=args.seed,
        episodes=args.episodes,
        track=args.track,
        sensor=args.sensor,
        overrides=_overrides(args),
        lockstep=args.lockstep,
        stamped=not args.twist,
        timeout=args.timeout,
        told=lambda text: print(text, flush=True),
    )
    return 0


def _deploy(args):
    from bson import benchmark

    benchmark.deploy(
        args.agent,
        robot=args.robot,
        period=args.period,
        untrained=args.untrained_setting,
        stamped=not args.twist,
        timeout=args.timeout,
        goal_frames=args.goal_frame,
    )
    return 0


def _record(args):
    from bson import benchmark

    written = benchmark.record(
        args.agent,
        args.out,
        suite=args.suite,
        seed=args.seed,
        episodes=args.episodes,
        track=args.track,
        sensor=args.sensor,
        overrides=_overrides(args),
        untrained=args.untrained_setting,
        stamped=not args.twist,
        real_time=args.real_time,
        timeout=args.timeout,
        command="bson " + shlex.join(args.argv),
    )
    print(f"Written: {', '.join(map(str, written))}")
    return 0


def _replay(args):
    from bson import benchmark
    from bson.evaluation.play import format_summary

    found = benchmark.replay(args.bags, args.out)
    for row in found.content["episodes"]:
        print(f"{row['cell']}, seed {row['seed']}: SNS {row['SNS']!r}")
    print(format_summary(found.content))
    if args.out:
        print(f"Written: {found.written[0]}")
    return 0


def _dataset(args):
    from bson import benchmark

    written = benchmark.dataset(
        args.agent,
        args.out,
        name=args.id,
        suite=args.suite,
        cell=args.cell,
        episodes=args.episodes,
        seed=args.seed,
        track=args.track,
        sensor=args.sensor,
        overrides=_overrides(args),
        untrained=args.untrained_setting,
        command="bson " + shlex.join(args.argv),
    )
    print(f"Written: {', '.join(map(str, written))}")
    return 0


def _export(args):
    from bson.episodes.tracks import make_track
    from bson.interfaces.export import export
    from bson.task import TaskConfig

    config = _cell(args.suite, args.cell) if args.suite or args.cell else TaskConfig()
    track = make_track(args.track, args.sensor)
    start.cleaning_up()
    export(config.replace(**_overrides(args)), track, args.seed, args.out, "bson " + shlex.join(args.argv))
    print(f"Written: {args.out}. How to read it: {pathlib.Path(args.out) / 'README.md'}")
    return 0


def _cell(suite, cell):
    """The TaskConfig of the cell named `cell` of the suite named `suite`. Raises UsageError."""
    from bson.evaluation.suites import load_suite
    from macid.documents import shown

    if suite is None:
        raise UsageError("--cell is one of a suite: give --suite, too.")
    cells = {one.name: one.config for one in load_suite(suite).cells}
    if cell is None and len(cells) == 1:
        return next(iter(cells.values()))
    if cell not in cells:
        problem = "needs a --cell" if cell is None else f"has no cell {shown(cell)}"
        raise UsageError(f"Suite '{suite}' {problem}. Choose one of {', '.join(map(repr, cells))}.")
    return cells[cell]


def _train(args):
    if args.engine == "warp":
        return _train_warp(args)
    from bson import benchmark

    folders = benchmark.train(
        args.algo,
        args.out,
        seed=args.seed,
        seeds=args.seeds,
        steps=int(args.steps),
        worlds=args.worlds or 16,
        preset=args.preset,
        overrides=_overrides(args),
        demonstrations=args.demonstrations,
        inputs=args.inputs,
        draw=args.draw,
        teacher=args.teacher,
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


def _train_warp(args):
    if args.demonstrations is not None:
        raise UsageError("--demonstrations are what bc learns from, and --engine warp has no bc: leave them out.")
    if args.teacher is not None:
        raise UsageError("--teacher is whom bc imitates, and --engine warp has no bc: leave it out.")
    if args.preset != "fast":
        raise UsageError("--engine warp has hyperparameters of its own, for thousands of worlds: leave --preset out.")
    if args.seeds != 1 or args.executor != "local":
        raise UsageError("--engine warp trains one seed in this process: leave --seeds and --executor out.")
    from tqdm import tqdm

    from bson.learning.device_ppo import STARTED, DeviceTrainConfig, train

    more = {} if args.worlds is None else {"num_envs": args.worlds}
    more |= {} if args.start is None else {"hyperparameters": STARTED}
    more |= {"algo": args.algo, "inputs": args.inputs, "draw": args.draw, "start": args.start}
    config = DeviceTrainConfig(args.seed, int(args.steps), _overrides(args), **more)
    start.cleaning_up()
    with tqdm(total=config.steps, unit="step", unit_scale=True, desc=config.name, file=sys.stderr, delay=0.5) as bar:

        def show(steps, figures, validation=False):
            bar.n = min(steps, config.steps)
            text = "  ".join(f"{name} {value:.3g}" for name, value in figures.items())
            if validation:
                bar.write(f"{steps:,} steps, validation: {text}", file=sys.stderr)
            bar.set_postfix_str(text)

        folder = train(config, args.out, args.resume, show, tensorboard=args.tensorboard)
    policy = folder / "policy.npz"
    print(f"Written: {policy}, {folder / 'policy.json'}. Score it: bson evaluate --agent {policy}")
    return 0


def _bench(args):
    from bson import bench
    from bson.benchmark import agents_extra
    from bson.task import TaskConfig
    from macid.pedestrians import make_controller

    make_controller(args.pedestrian_model, 0.1)
    given = {
        "people": args.pedestrians,
        "batches": args.worlds,
        "seconds": args.seconds,
        "sensors": args.sensors,
        "algos": args.train or None,
    }
    given = {name: value for name, value in given.items() if value is not None}
    for people in args.pedestrians or []:
        TaskConfig(num_pedestrians=people)  # raises where this number is not valid
    path = check_file(args.out, "file for --out") if args.out else None
    if args.record:
        rows = _bench_recording(args, given)
    elif args.engine == "warp":
        rows = _bench_warp(args, given)
    elif args.train is None:
        rows = bench.run(**given, model=args.pedestrian_model)
    elif args.sensors is not None:
        raise UsageError("--train measures learning on the 2D LIDAR: leave --sensors out.")
    else:
        with agents_extra():
            rows = bench.run_learning(**given, model=args.pedestrian_model)
    if path is not None:
        with new_folder(path.parent):
            write_json(path, {"machine": bench.machine(), "rows": rows})
    return 0


def _bench_recording(args, given):
    from bson import bench
    from bson.interfaces import bag

    bag.check()
    if args.engine != "native" or args.train is not None or "batches" in given or "seconds" in given:
        raise UsageError("--record measures bags of 60 s: leave --train, --engine, --worlds and --seconds out.")
    return bench.run_recording(**given, model=args.pedestrian_model)


def _bench_warp(args, given):
    from bson import bench_warp

    if "batches" in given:
        given["worlds"] = given.pop("batches")
    algos = given.pop("algos", None)
    if args.train is None:
        return bench_warp.run(**given, model=args.pedestrian_model)
    if algos not in (None, ["ppo"]) or args.sensors is not None:
        raise UsageError(
            "--engine warp measures training of ppo on the 2D LIDAR: leave other algorithms and --sensors out."
        )
    return bench_warp.run(**given, sensors=("lidar2d",), model=args.pedestrian_model, train=True)


def _doctor(args):
    from bson import doctor

    return 0 if doctor.run() else 1


def _list(args):
    from bson import ENVIRONMENTS
    from bson.evaluation.suites import HELD_OUT, load_suite, suite_names
    from bson.registry import KINDS, kind

    print("environments  " + ", ".join(ENVIRONMENTS))
    for what, (_, given) in KINDS.items():
        try:
            found = kind(what)
        except ModuleNotFoundError as error:
            print(f"{what:<13} need {error.name}: pip install 'bson-macid[agents]'")
            continue
        print(f"{what:<13} {', '.join(found.names())}{found.forms and f', or {found.forms}'} ({given})")
    for suite in map(load_suite, suite_names()):
        count = f"{len(suite.cells)} cells x {len(suite.seeds)}" if len(suite.cells) > 1 else f"{len(suite.seeds)}"
        print(f"suite         {suite.name}: {suite.description} ({count} seeds)")
    print(f"suite         {HELD_OUT}: cells of standard, seeds that follow from a passphrase (--passphrase-file)")
    return 0


def _add_setting(command, agent: str | None = "vfh", more: str = ""):
    command.add_argument(
        "--agent", type=name, default=agent, help=f"a name (bson list), module:function, or file.py[:function]{more}"
    )
    command.add_argument("--track", type=name, default=None, help="local or global (default: what the agent wants)")
    command.add_argument("--sensor", type=name, default=None, help="lidar2d, ... (default: what the agent wants)")
    command.add_argument(
        "--untrained-setting",
        action="store_true",
        help="let a trained policy try with another robot, control period or LIDAR than it was trained with",
    )
    _add_task(command)


def _add_wire(command):
    command.add_argument("--twist", action="store_true", help="commands as Twist, not as TwistStamped")
    command.number(
        "--timeout",
        float,
        0.0,
        3600.0,
        above=True,
        default=10.0,
        help="with ROS 2: how long a message may stay out [s]",
    )


def _add_pace(command):
    command.add_argument(
        "--real-time", action="store_true", help="with --agent ros: a control step each period, not in lockstep"
    )


def _add_task(command):
    command.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change a field of the task, e.g. pedestrian_model=orca; may be repeated",
    )


def _add_evaluation(command, out, suite):
    command.add_argument(
        "--engine",
        default="native",
        choices=("native", "warp"),
        help="warp: all episodes of a cell at once in MJX-Warp, on a GPU if there is one; for learned policies",
    )
    command.add_argument("--suite", type=name, default=suite, help="a name (bson list)")
    board.add_passphrase(command)
    command.number("--episodes", int, -MOST_SEED, MOST_SEED, default=None, help="only the suite's first N episodes")
    command.number(
        "--seed", int, 0, 9 * 10**12, default=0, help="0: the suite's own seeds; else another set of its kind"
    )
    command.number(
        "--videos",
        int,
        0,
        _MOST_FILMS,
        default=2,
        help="films, from the worst episode to the best; of several cells the worst episodes of this many worst cells, "
        "and the best of the best",
    )
    command.add_argument(
        "--record", action="store_true", help="also write the worst and the best episode to bags/ (extra `record`)"
    )
    command.add_argument(
        "--metric",
        type=name,
        action="append",
        default=[],
        help="a metric of your own, module:function or file.py:function of an Episode; may be repeated",
    )
    command.add_argument(
        "--paired",
        action="store_true",
        help="also play each episode without the robot, for what it does to others: delay, detour, added_contact",
    )
    command.add_argument(
        "--resume", action="store_true", help="go on with an evaluation that was cut short in the folder --out"
    )
    command.add_argument("--out", type=name, default=out, help="folder for results.json, report.html and videos/")
    _add_wire(command)
    _add_pace(command)
    add_executor(command)
    command.set_defaults(run=_evaluate)


def parser() -> Parser:
    """The command's parser."""
    defaults: dict[str, Any] = {"formatter_class": HelpFormatter}
    root = Parser(prog="bson", description="A benchmark for robots that drive among people.")
    commands = root.add_subparsers(dest="command", required=True, metavar="command")

    demo = commands.add_parser(
        "demo", help="evaluate the reactive agent on ten episodes, with a report and films", **defaults
    )
    _add_setting(demo)
    _add_evaluation(demo, "bson-demo", "smoke")

    evaluate = commands.add_parser("evaluate", help="score an agent on a suite", **defaults)
    _add_setting(evaluate)
    _add_evaluation(evaluate, "results", "paper")

    board.add_commands(commands, defaults)

    render = commands.add_parser("render", help="film one seed", **defaults)
    _add_setting(render)
    render.number("--seed", int, 0, MOST_SEED, default=0)
    render.number(
        "--step", int, -MOST_SEED, MOST_SEED, default=None, help="of a .png: the control step (default: halfway)"
    )
    render.add_argument("--out", type=name, default="episode.webm", help="a .webm film, or a .png picture")
    render.set_defaults(run=_render)

    live = commands.add_parser(
        "live", help="a page to drive in, in 3D; what a person drives is scored (extra `live`)", **defaults
    )
    _add_setting(live, None, "; it drives at first, and you take over with the keys (default: you drive)")
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

    record = commands.add_parser(
        "record", help="write episodes to rosbag2 folders with MCAP storage (extra `record`)", **defaults
    )
    _add_setting(record)
    record.add_argument("--suite", type=name, default=None, help="record a suite's episodes (bson list)")
    record.number("--episodes", int, -MOST_SEED, MOST_SEED, default=None, help="only the suite's first N episodes")
    record.number(
        "--seed", int, 0, 9 * 10**12, default=0, help="the episode; with --suite as for bson evaluate, 0: its own seeds"
    )
    _add_wire(record)
    _add_pace(record)
    record.add_argument("--out", type=name, required=True, help="folder; each episode gets one in it, seed-N")
    record.set_defaults(run=_record)

    ros = commands.add_parser("ros", help="a world as a ROS 2 node: sensors out, /cmd_vel in (extra `ros`)", **defaults)
    ros.add_argument("--suite", type=name, default=None, help="play a suite's episodes, one after another (bson list)")
    ros.number("--episodes", int, -MOST_SEED, MOST_SEED, default=None, help="only the suite's first N episodes")
    ros.number(
        "--seed", int, 0, 9 * 10**12, default=0, help="the episode; with --suite as for bson evaluate, 0: its own seeds"
    )
    ros.add_argument("--track", type=name, default="local", help="local or global")
    ros.add_argument("--sensor", type=name, default="lidar2d", help="lidar2d, lidar3d, camera, or your own")
    pace = ros.add_mutually_exclusive_group()
    pace.add_argument("--lockstep", action="store_true", help="the world waits for one command in each control step")
    pace.add_argument("--real-time", action="store_true", help="one control step each period (the default)")
    _add_wire(ros)
    _add_task(ros)
    ros.set_defaults(run=_ros)

    deploy = commands.add_parser(
        "deploy",
        help="drive a robot with an agent, as a ROS 2 node: /scan, /odom and a goal in (extra `ros`)",
        **defaults,
    )
    deploy.add_argument(
        "--agent",
        type=name,
        default="vfh",
        help="a name (bson list), a policy.npz, module:function, or file.py[:function]",
    )
    deploy.add_argument("--robot", type=name, default="jackal", help="whose limits hold (bson list), or a .toml")
    deploy.number("--period", float, 0.0, 10.0, above=True, default=0.1, help="between two decisions [s]")
    deploy.add_argument(
        "--goal-frame",
        type=name,
        action="append",
        default=[],
        help="a frame of goals that is the odometry's, by another name; may be repeated. In BSON's worlds: map",
    )
    deploy.add_argument(
        "--untrained-setting",
        action="store_true",
        help="let a trained policy try with another robot, control period or LIDAR than it was trained with",
    )
    _add_wire(deploy)
    deploy.set_defaults(run=_deploy)

    replay = commands.add_parser("replay", help="score recorded episodes again (extra `record`)", **defaults)
    replay.add_argument("bags", type=name, nargs="+", metavar="BAG", help="folders of bson record, or folders of these")
    replay.add_argument("--out", type=name, default=None, help="folder for results.json")
    replay.set_defaults(run=_replay)

    dataset = commands.add_parser(
        "dataset", help="write episodes to a Minari dataset, for offline learning (extra `data`)", **defaults
    )
    _add_setting(dataset, None, " (default: three datasets: tac as expert, ppo-paper as medium, and random)")
    dataset.add_argument("--suite", type=name, default="paper", help="a name (bson list)")
    dataset.add_argument("--cell", type=name, default=None, help="only this cell of the suite")
    dataset.number("--episodes", int, -MOST_SEED, MOST_SEED, default=None, help="only the suite's first N episodes")
    dataset.number("--seed", int, 0, 9 * 10**12, default=0, help="as for bson evaluate; 0: the suite's own seeds")
    dataset.add_argument("--id", type=name, default=None, help="the dataset's (default: bson/SUITE/AGENT-v0)")
    dataset.add_argument(
        "--out", type=name, default=None, help="folder of datasets (default: Minari's, MINARI_DATASETS_PATH)"
    )
    dataset.set_defaults(run=_dataset)

    export = commands.add_parser(
        "export", help="write one seed's scene as MJCF, for MuJoCo, its viewer and MJX without this project", **defaults
    )
    export.number("--seed", int, 0, MOST_SEED, default=0)
    export.add_argument("--track", type=name, default="local", help="local or global")
    export.add_argument("--sensor", type=name, default="lidar2d", help="lidar2d, lidar3d or camera")
    export.add_argument("--suite", type=name, default=None, help="take the task of a suite's cell (bson list)")
    export.add_argument("--cell", type=name, default=None, help="its name, of a suite with several")
    _add_task(export)
    export.add_argument("--out", type=name, required=True, help="folder, new or empty")
    export.set_defaults(run=_export)

    train = commands.add_parser("train", help="train a robot: PPO, SAC, TAC or BC (extra `agents`)", **defaults)
    train.add_argument(
        "--algo", type=name, default="ppo", help="ppo, sac, tac, or bc, which learns from the shipped ppo"
    )
    train.number(
        "--steps", float, 1.0, MOST_STEPS, default=1e6, help="control steps of all worlds; of demonstrations with bc"
    )
    train.number("--worlds", int, 1, MOST_WORLDS, default=None, help="at once (default: 16; with --engine warp 1024)")
    train.add_argument(
        "--engine", choices=("native", "warp"), default="native", help="warp: ppo in MJX-Warp, on a GPU if there is one"
    )
    train.number("--seed", int, 0, MOST_TRAINING_SEED, default=0, help="the first seed")
    train.number(
        "--seeds", int, 1, MOST_SEEDS, default=1, help="how many, one after the other, or at once with --executor ray"
    )
    train.add_argument(
        "--preset", default="fast", choices=["fast", "paper"], help="hyperparameters; paper: as far as it gives them"
    )
    _add_task(train)
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
        help="what the robot sees: scans; guided: a planner's way and people, on the map, guided-scans: by the LIDAR "
        "alone; with a memory (bc, ppo) gru: as guided-scans, gru-map: as guided, camera, gru-scans",
    )
    train.add_argument(
        "--draw", type=name, default=None, help="draw episodes' settings: standard, or a .toml file; not with scans"
    )
    train.add_argument("--teacher", type=name, default=None, metavar="AGENT", help="of bc with a memory (default: tac)")
    train.add_argument(
        "--start", type=name, default=None, metavar="POLICY", help="of ppo with a memory: goes on from this policy: gru"
    )
    train.add_argument("--resume", action="store_true", help="go on from the last checkpoint")
    add_executor(train)
    train.add_argument("--tensorboard", action="store_true", help="also log the curve for TensorBoard")
    train.set_defaults(run=_train)

    bench = commands.add_parser("bench", help="measure control steps/s, of stepping or of training; or writing bags")
    bench.add_argument(
        "--train", type=name, nargs="*", metavar="ALGO", help="measure training: ppo, sac, tac (none named: all)"
    )
    bench.add_argument("--record", action="store_true", help="measure writing bags of 60 s (extra `record`)")
    bench.number("--pedestrians", int, 0, MOST_PEOPLE, nargs="+", help="(default: 24 50 100 200; training: 24)")
    bench.number("--worlds", int, 1, MOST_WORLDS, nargs="+", help="at once (default: 1 16; training: 16)")
    bench.add_argument(
        "--sensors", type=name, nargs="+", help="none, or as --sensor of evaluate (default: none lidar2d)"
    )
    bench.number("--seconds", float, 0.0, 1e6, above=True, help="time a case (default: 2; training: 20)")
    bench.add_argument("--pedestrian-model", type=name, default="macid", help="(default: macid)")
    bench.add_argument(
        "--engine",
        choices=("native", "warp"),
        default="native",
        help="native: MuJoCo on CPUs; warp: MJX-Warp, on a GPU if there is one (default worlds then: 1024 4096)",
    )
    bench.add_argument("--out", type=name, help="JSON file")
    bench.set_defaults(run=_bench)

    commands.add_parser("doctor", help="check this installation").set_defaults(run=_doctor)
    commands.add_parser("list", help="environments, agents, pedestrians, suites").set_defaults(run=_list)
    return root


_DRAW_NOTHING = (*board.DRAW_NOTHING, _replay, _export, _doctor, _list)


def main(argv: Sequence[str] | None = None) -> int | str | None:
    """Entry point; returns the exit code. Without `argv`, it runs the command line of this process (see
    macid.start)."""
    if argv is None:
        return start.run("bson", start.bson_command)

    def command():
        check_words(argv)
        args = parser().parse_args(argv)
        args.argv = argv
        start_mujoco(draws=args.run not in _DRAW_NOTHING)
        return args.run(args)

    return run_command("bson", command)


if __name__ == "__main__":
    sys.exit(start.bson())
