"""The `bson` command."""

import ast
import contextlib
import dataclasses
import functools
import pathlib
import shlex
import sys

from macid import start
from macid.command import (
    MOST_PEOPLE,
    MOST_SEED,
    MOST_STEPS,
    MOST_TRAINING_SEED,
    MOST_WORLDS,
    Parser,
    check_words,
    name,
)
from macid.files import (
    HelpFormatter,
    UsageError,
    check_file,
    check_folder,
    lock_folder,
    new_folder,
    output_folder,
    remove_leftovers,
    run_command,
    start_mujoco,
    write_bytes,
    write_json,
)

_MOST_FILMS = 10_000


def _track_names(args, make_agent):
    """Names of the track and the sensors that an agent wants, unless the command line says otherwise."""
    return args.track or make_agent.track, args.sensor or make_agent.sensor


def _overrides(pairs):
    """`KEY=VALUE` words as a dict of TaskConfig's fields; values are Python literals or plain text. Raises UsageError."""
    from bson.task import TaskConfig
    from macid.documents import check_values, shown

    fields = [field.name for field in dataclasses.fields(TaskConfig)]
    changes = {}
    for pair in pairs:
        key, equals, text = pair.partition("=")
        if not equals:
            raise UsageError(f"--set takes KEY=VALUE, not {shown(pair)}.")
        if key not in fields:
            raise UsageError(f"Unknown option {shown(key)}. Choose among {', '.join(fields)}.")
        changes[key] = _literal(key, text)

    def tell(key, problem):
        raise UsageError(f"--set {key}: {problem}.")

    check_values(changes, tell)
    return changes


def _literal(key, text):
    """`text` as the Python literal that it is, of what JSON has, else as it is. Raises UsageError."""
    from macid.documents import shown

    try:
        value = ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text
    except (RecursionError, MemoryError):
        raise UsageError(f"--set {key}: the value is nested too deeply: {shown(text)}.") from None
    except TypeError as error:  # a list as a dict's key
        raise UsageError(f"--set {key}: {shown(text)} is no value ({error}).") from None
    waiting = [value]
    while waiting:
        one = waiting.pop()
        if isinstance(one, dict):
            waiting += one.values()
        elif isinstance(one, list | tuple):
            waiting += one
        elif not isinstance(one, None | bool | int | float | str):
            raise UsageError(f"--set {key} takes numbers, texts, lists and dicts, not {shown(one)}.")
    return value


def _check_spawn(config, seeds):
    """Draws the episodes `seeds`, so that a map without room is told before anything runs."""
    import numpy as np

    from bson.task import spawn

    for seed in seeds:
        spawn(config, np.random.default_rng(seed))


@contextlib.contextmanager
def _progress(name, total, done=0, keep=None):
    """A progress bar on stderr, as the `progress` of bson.evaluate. keep(episode) is called with each that ends."""
    from tqdm import tqdm

    with tqdm(total=total, initial=done, unit="episode", desc=name, file=sys.stderr, smoothing=0) as bar:
        steps = 0

        def progress(control_steps, episode):
            nonlocal steps
            steps += control_steps
            if episode is not None:
                if keep:
                    keep(episode)
                bar.update()
            if episode is not None or steps % 160 == 0:
                bar.set_postfix_str(f"{steps / max(bar.format_dict['elapsed'], 1e-9):,.0f} steps/s", refresh=True)

        yield progress


def _play(make_agent, cell, track, seeds, name, unfinished, paired):
    """The Episodes `seeds` of a cell: those that `unfinished` has, and those that it lacks, which it gets."""
    from bson.evaluate import pair, run_episodes

    keep = functools.partial(unfinished.save, cell)
    found = {seed: episode for seed in seeds if (episode := unfinished.load(cell, seed))}
    missing = [seed for seed in seeds if seed not in found]
    with _progress(name, len(seeds), len(found), keep) as progress:
        played = run_episodes(make_agent, cell.config, track, missing, name, progress) if missing else []
    found |= {episode.seed: episode for episode in played}
    episodes = [found[seed] for seed in seeds]
    if not paired:
        return episodes
    done = sum(episode.fault != "" or episode.people_alone is not None for episode in episodes)
    with _progress(f"{name}, without the robot", len(seeds), done, keep) as progress:
        return pair(cell.config, episodes, progress)


def _to_film(played, number):
    """Which episodes to film, as (the cell's place, the episode, what to tell of it).

    played: the episodes of each cell. Of one cell `number` episodes, evenly from the worst SNS to the best; of several
    the worst of each of the `number` worst cells, and the best of the best.
    """
    from bson.metrics import sns, spread_by_score

    if len(played) == 1:
        chosen = [(0, episode) for episode in spread_by_score(played[0], number)]
        kinds = {len(chosen) - 1: "the best episode", 0: "the worst episode"}
    else:
        ranked = sorted(
            ((place, sorted(episodes, key=sns)) for place, episodes in enumerate(played) if episodes),
            key=lambda cell: sum(map(sns, cell[1])) / len(cell[1]),
        )
        chosen = [(place, episodes[0]) for place, episodes in ranked[:number]]
        kinds = dict.fromkeys(range(len(chosen)), "its worst episode") | {0: "the worst cell's worst episode"}
        best, episodes = ranked[-1]
        if all(episode is not episodes[-1] for _, episode in chosen):
            kinds[len(chosen)] = "the best cell's best episode"
            chosen.append((best, episodes[-1]))
    return [(*each, kinds.get(rank, "")) for rank, each in enumerate(chosen)]


def _films(played, cells, track, folder, number, name):
    """Films episodes (see _to_film); returns (path, caption) pairs and why there are none.

    played: the episodes of each of `cells`.
    """
    from tqdm import tqdm

    from bson import film
    from bson.metrics import sns
    from bson.simulation.scene import build_model
    from macid import drawing

    if number == 0:
        return [], "No films were asked for (--videos 0)."
    if problem := drawing.gl_problem():
        print(f"No video: {problem}", file=sys.stderr)
        return [], f"No video: {problem}"
    output_folder(folder)
    model = functools.cache(lambda config: build_model(config, track.sensors))
    made = []
    for place, episode, kind in tqdm(_to_film(played, number), unit="film", desc="filming", file=sys.stderr):
        cell, several = cells[place], len(cells) > 1
        path = folder / f"seed-{episode.seed}{'-' + cell.slug if several else ''}.webm"
        film.film(model(cell.config), episode, path, title=f"{name}: {cell.name}" if several else name)
        where = f" in '{cell.name}'" if several else ""
        made.append((path, f"seed {episode.seed}{where}{kind and f', {kind}'}: SNS {sns(episode):.1f}"))
    return made, ""


def _evaluate(args):
    from bson.agents import check_settings, load_agent
    from bson.evaluate import format_summary, results, sound
    from bson.report import make_report
    from bson.resume import Unfinished, basis, files_digest
    from bson.suites import load_suite
    from bson.tracks import make_track, sensor_label, sensor_settings

    suite = load_suite(args.suite)
    seeds = suite.drawn(args.episodes, args.seed)
    changes = _overrides(args.set)
    cells = [dataclasses.replace(cell, config=cell.config.replace(**changes)) for cell in suite.cells]
    make_agent = load_agent(args.agent, args.untrained_setting)
    track_names = _track_names(args, make_agent)
    track = make_track(*track_names)
    check_settings(make_agent, [cell.config for cell in cells], track)
    for cell in cells:
        _check_spawn(cell.config, seeds)
    out = check_folder(args.out)
    for file in (out / "results.json", out / "report.html", *(out / "videos").glob("seed-*.webm")):
        check_file(file)
    check_folder(out / "videos")
    follows_from = basis(args.agent, track_names, cells, args.paired)
    with lock_folder(out):
        unfinished = Unfinished(out, follows_from, args.resume)
        played = []
        for cell in cells:
            name = args.agent if len(cells) == 1 else f"{args.agent}: {cell.name}"
            played.append(_play(make_agent, cell, track, seeds, name, unfinished, args.paired))
        content = results(
            args.agent,
            suite.name,
            cells,
            played,
            suite_digest=suite.digest if not changes else None,
            task_digest=files_digest(follows_from),
            track=[track_names[0], sensor_label(track_names[1])],
            sensors=sensor_settings(track.sensors),
            paired=args.paired,
            overrides={key: str(value) for key, value in changes.items()},
            frozen_seeds=args.seed == 0,
            command="bson " + shlex.join(word for word in args.argv if word != "--resume"),
        )
        # What an earlier run left here does not belong to these results.
        remove_leftovers(out / "videos")
        for stale in (out / "report.html", *(out / "videos").glob("seed-*.webm")):
            if not stale.is_symlink():
                stale.unlink(missing_ok=True)
        write_json(out / "results.json", content)
        print(format_summary(content), flush=True)
        played = [sound(episodes) for episodes in played]
        videos, why_not = _films(played, cells, track, out / "videos", args.videos, args.agent)
        report = make_report(content, [e for each in played for e in each], videos, why_not)
        write_bytes(out / "report.html", report.encode())
        unfinished.discard()
    print(f"Written: {out / 'results.json'}, {out / 'report.html'}" + "".join(f", {path}" for path, _ in videos))
    return 0


def _compare(args):
    from bson.compare import compare, format_comparison, load_run, make_page

    content = compare([load_run(source) for source in args.results])
    page, out = make_page(content), check_folder(args.out)
    for file in ("compare.json", "compare.html"):
        check_file(out / file)
    with lock_folder(out):
        write_json(out / "compare.json", content)
        write_bytes(out / "compare.html", page.encode())
    print(format_comparison(content))
    print(f"Written: {out / 'compare.json'}, {out / 'compare.html'}")
    return 0


def _leaderboard(args):
    from bson.compare import load_run
    from bson.leaderboard import fill_readme, leaderboard

    text = leaderboard([load_run(source) for source in args.results])
    if args.readme:
        fill_readme(args.readme, text)
    print(text)
    if args.readme:
        print(f"Written: {args.readme}", file=sys.stderr)
    return 0


def _render(args):
    from bson import film
    from bson.agents import check_settings, load_agent
    from bson.evaluate import run_episodes
    from bson.simulation.scene import build_model
    from bson.task import TaskConfig
    from bson.tracks import make_track
    from macid import drawing

    config = TaskConfig().replace(**_overrides(args.set))
    make_agent = load_agent(args.agent, args.untrained_setting)
    track = make_track(*_track_names(args, make_agent))
    check_settings(make_agent, [config], track)
    path = pathlib.Path(args.out)
    if path.suffix not in (".webm", ".png"):
        raise UsageError(f"--out must end in .webm (a film) or .png (a picture), not '{path.name}'.")
    check_file(path)
    if problem := drawing.gl_problem():
        raise UsageError(f"No pictures here: {problem}")
    _check_spawn(config, [args.seed])
    with _progress(args.agent, 1) as progress:
        (episode,) = run_episodes(make_agent, config, track, [args.seed], args.agent, progress)
    if episode.fault:
        raise UsageError(f"Physics failed in the episode of seed {args.seed}: {episode.fault}. Choose another --seed.")
    model = build_model(config, track.sensors)
    if path.suffix == ".png":
        step = len(episode.pose) // 2 if args.step is None else args.step
        if not -len(episode.pose) <= step < len(episode.pose):
            raise UsageError(f"--step must be below {len(episode.pose)}, the episode's length, not {step}.")
        with new_folder(path.parent):
            film.still(model, episode, path, step)
    else:
        with new_folder(path.parent):
            film.film(model, episode, path, title=args.agent)
    print(f"Written: {path}")
    return 0


@contextlib.contextmanager
def _agents_extra():
    """Tells what to install where the extra `agents` is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise UsageError(f"Training needs {error.name}: pip install 'bson-macid[agents]'.") from None


def _train(args):
    if args.engine == "warp":
        return _train_warp(args)
    with _agents_extra():
        from bson.learning.train import ALGORITHMS, PRESETS, TrainConfig, train_with_bar

    if args.algo not in ALGORITHMS:
        raise UsageError(f"Unknown algorithm '{args.algo}'. Choose one of {', '.join(ALGORITHMS)}.")
    hyperparameters = PRESETS[args.preset][args.algo]
    config = TrainConfig(
        args.algo, args.seed, int(args.steps), _overrides(args.set), args.worlds or 16, hyperparameters=hyperparameters
    )
    start.cleaning_up()
    folder = train_with_bar(config, args.out, args.resume, args.tensorboard)
    print(
        f"Written: {folder / 'policy.npz'}, {folder / 'policy.json'}. Score it: bson evaluate --agent {folder / 'policy.npz'}"
    )
    return 0


def _train_warp(args):
    if args.preset != "fast":
        raise UsageError("--engine warp has hyperparameters of its own, for thousands of worlds: leave --preset out.")
    from tqdm import tqdm

    from bson.learning.device_ppo import DeviceTrainConfig, train

    worlds = {} if args.worlds is None else {"num_envs": args.worlds}
    config = DeviceTrainConfig(args.seed, int(args.steps), _overrides(args.set), algo=args.algo, **worlds)
    start.cleaning_up()
    with tqdm(total=config.steps, unit="step", unit_scale=True, desc=config.name, file=sys.stderr, delay=0.5) as bar:

        def show(steps, figures):
            bar.n = min(steps, config.steps)
            bar.set_postfix_str("  ".join(f"{name} {value:.3g}" for name, value in figures.items()))

        folder = train(config, args.out, args.resume, show)
    print(f"Written: {folder / 'policy.npz'}, {folder / 'policy.json'}. Score it: bson evaluate --agent {folder / 'policy.npz'}")
    return 0


def _bench(args):
    from bson import bench
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
        TaskConfig(num_pedestrians=people)  # raises what is wrong with it
    if args.out:
        path = check_file(args.out, "file for --out")
    if args.engine == "warp":
        rows = _bench_warp(args, given)
    elif args.train is None:
        rows = bench.run(**given, model=args.pedestrian_model)
    elif args.sensors is not None:
        raise UsageError("--train measures learning on the 2D LIDAR: leave --sensors out.")
    else:
        with _agents_extra():
            rows = bench.run_learning(**given, model=args.pedestrian_model)
    if args.out:
        with new_folder(path.parent):
            write_json(path, {"machine": bench.machine(), "rows": rows})
    return 0


def _bench_warp(args, given):
    from bson import bench_warp

    if "batches" in given:
        given["worlds"] = given.pop("batches")
    algos = given.pop("algos", None)
    if args.train is None:
        return bench_warp.run(**given, model=args.pedestrian_model)
    if algos not in (None, ["ppo"]) or args.sensors is not None:
        raise UsageError("--engine warp measures training of ppo on the 2D LIDAR: leave other algorithms and --sensors out.")
    return bench_warp.run(**given, sensors=("lidar2d",), model=args.pedestrian_model, train=True)


def _doctor(args):
    from bson import doctor

    return 0 if doctor.run() else 1


def _list(args):
    from bson import ENVIRONMENTS
    from bson.agents import agent_names
    from bson.robot import robot_names
    from bson.suites import load_suite, suite_names
    from macid.maps import map_names
    from macid.pedestrians import model_names

    print("environments  " + ", ".join(ENVIRONMENTS))
    print("agents        " + ", ".join(agent_names()) + ", or module:function, file.py[:function], policy.npz")
    print("pedestrians   " + ", ".join(model_names()))
    print("maps          " + ", ".join(map_names()) + ", or a .toml or .yaml file (--set map=NAME)")
    print("robots        " + ", ".join(robot_names()) + ", or a .toml file (--set robot=NAME)")
    for suite in map(load_suite, suite_names()):
        count = f"{len(suite.cells)} cells x {len(suite.seeds)}" if len(suite.cells) > 1 else f"{len(suite.seeds)}"
        print(f"suite         {suite.name}: {suite.description} ({count} seeds)")
    return 0


def _add_setting(command):
    command.add_argument("--agent", type=name, default="vfh", help="a name (bson list), module:function, or file.py[:function]")
    command.add_argument("--track", type=name, default=None, help="local or global (default: what the agent wants)")
    command.add_argument("--sensor", type=name, default=None, help="lidar2d, ... (default: what the agent wants)")
    command.add_argument(
        "--untrained-setting",
        action="store_true",
        help="let a trained policy try with another robot, control period or LIDAR than it was trained with",
    )
    _add_task(command)


def _add_task(command):
    command.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change a field of the task, e.g. pedestrian_model=orca; may be repeated",
    )


def _add_evaluation(command, out, suite):
    command.add_argument("--suite", type=name, default=suite, help="a name (bson list)")
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
        "--paired",
        action="store_true",
        help="also play each episode without the robot, for what it does to others: delay, detour, added_contact",
    )
    command.add_argument(
        "--resume", action="store_true", help="go on with an evaluation that was cut short in the folder --out"
    )
    command.add_argument("--out", type=name, default=out, help="folder for results.json, report.html and videos/")
    command.set_defaults(run=_evaluate)


def parser():
    """The command's parser."""
    defaults = {"formatter_class": HelpFormatter}
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

    compare = commands.add_parser(
        "compare", help="results beside each other, with paired differences from the first", **defaults
    )
    compare.add_argument("results", type=name, nargs="+", help="folders that bson evaluate wrote, or their results.json")
    compare.add_argument("--out", type=name, default="comparison", help="folder for compare.json and compare.html")
    compare.set_defaults(run=_compare)

    leaderboard = commands.add_parser("leaderboard", help="results as a Markdown table, sorted by SNS", **defaults)
    leaderboard.add_argument("results", type=name, nargs="+", help="folders that bson evaluate wrote, or their results.json")
    leaderboard.add_argument(
        "--readme",
        type=name,
        default=None,
        help="also put it into this file, between <!-- leaderboard --> and <!-- /leaderboard -->",
    )
    leaderboard.set_defaults(run=_leaderboard)

    render = commands.add_parser("render", help="film one seed", **defaults)
    _add_setting(render)
    render.number("--seed", int, 0, MOST_SEED, default=0)
    render.number("--step", int, -MOST_SEED, MOST_SEED, default=None, help="of a .png: the control step (default: halfway)")
    render.add_argument("--out", type=name, default="episode.webm", help="a .webm film, or a .png picture")
    render.set_defaults(run=_render)

    train = commands.add_parser("train", help="train a robot: PPO, SAC, TAC or BC (extra `agents`)", **defaults)
    train.add_argument("--algo", type=name, default="ppo", help="ppo, sac, tac, or bc, which learns from the shipped ppo")
    train.number(
        "--steps", float, 1.0, MOST_STEPS, default=1e6, help="control steps of all worlds; of demonstrations with bc"
    )
    train.number("--worlds", int, 1, MOST_WORLDS, default=None, help="at once (default: 16; with --engine warp 1024)")
    train.add_argument(
        "--engine", choices=("native", "warp"), default="native", help="warp: ppo in MJX-Warp, on a GPU if there is one"
    )
    train.number("--seed", int, 0, MOST_TRAINING_SEED, default=0)
    train.add_argument(
        "--preset", default="fast", choices=["fast", "paper"], help="hyperparameters; paper: as far as it gives them"
    )
    _add_task(train)
    train.add_argument("--out", type=name, default="runs", help="folder; each training gets one in it")
    train.add_argument("--resume", action="store_true", help="go on from the last checkpoint")
    train.add_argument("--tensorboard", action="store_true", help="also log the curve for TensorBoard")
    train.set_defaults(run=_train)

    bench = commands.add_parser("bench", help="measure control steps/s, of stepping or of training")
    bench.add_argument("--train", type=name, nargs="*", metavar="ALGO", help="measure training: ppo, sac, tac (none named: all)")
    bench.number("--pedestrians", int, 0, MOST_PEOPLE, nargs="+", help="(default: 24 50 100 200; training: 24)")
    bench.number("--worlds", int, 1, MOST_WORLDS, nargs="+", help="at once (default: 1 16; training: 16)")
    bench.add_argument("--sensors", type=name, nargs="+", help="none, or as --sensor of evaluate (default: none lidar2d)")
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


_DRAW_NOTHING = (_compare, _leaderboard, _doctor, _list)


def main(argv=None):
    """Entry point; returns the exit code. Without `argv`, it is the command of this process (see macid.start)."""
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
