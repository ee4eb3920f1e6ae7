"""The `bson` command."""

import argparse
import ast
import dataclasses
import pathlib
import shlex
import sys

from macid.files import UsageError, output_folder, run_command, write_bytes, write_json


def _track(args, make_agent):
    """The track and sensors that an agent wants, unless the command line says otherwise."""
    from bson.tracks import make_track

    return make_track(args.track or make_agent.track, args.sensor or make_agent.sensor)


def _overrides(pairs):
    """`KEY=VALUE` words as a dict; values are Python literals or plain text."""
    changes = {}
    for pair in pairs:
        key, equals, text = pair.partition("=")
        if not equals:
            raise UsageError(f"--set takes KEY=VALUE, not '{pair}'.")
        try:
            changes[key] = ast.literal_eval(text)
        except (ValueError, SyntaxError):
            changes[key] = text
    return changes


def _check_spawn(config, seeds):
    """Draws the episodes `seeds`, so that a map without room is told before anything runs."""
    import numpy as np

    from bson.task import spawn

    for seed in seeds:
        spawn(config, np.random.default_rng(seed))


def _play(make_agent, config, track, seeds, name):
    """The episodes `seeds`, with a progress bar on stderr."""
    from tqdm import tqdm

    from bson.evaluate import run_episodes

    with tqdm(total=len(seeds), unit="episode", desc=name, file=sys.stderr, smoothing=0) as bar:
        steps = 0

        def progress(control_steps, episode):
            nonlocal steps
            steps += control_steps
            if episode is not None:
                bar.update()
            if episode is not None or steps % 160 == 0:
                bar.set_postfix_str(f"{steps / max(bar.format_dict['elapsed'], 1e-9):,.0f} steps/s", refresh=True)

        return run_episodes(make_agent, config, track, seeds, name, progress)


def _films(played, cells, track, folder, number, name):
    """Films the worst, the best, and episodes between; returns (path, caption) pairs and why there are none.

    played: the episodes of each of `cells`.
    """
    from tqdm import tqdm

    from bson import film
    from bson.metrics import sns, spread_by_score
    from bson.world import build_model
    from macid import drawing

    if number == 0:
        return [], "No films were asked for (--videos 0)."
    if problem := drawing.gl_problem():
        print(f"No video: {problem}", file=sys.stderr)
        return [], f"No video: {problem}"
    output_folder(folder)
    cell_of = {id(episode): cell for cell, episodes in zip(cells, played, strict=True) for episode in episodes}
    chosen = spread_by_score([episode for episodes in played for episode in episodes], number)
    made = []
    for place, episode in enumerate(tqdm(chosen, unit="film", desc="filming", file=sys.stderr)):
        cell = cell_of[id(episode)]
        path = folder / f"seed-{episode.seed}.webm"
        if len(cells) > 1:
            path = folder / f"seed-{episode.seed}-{cell.name.replace(', ', '-')}.webm"
        film.film(build_model(cell.config, track.sensors), episode, path, title=name)
        kind = {0: ", the worst episode", len(chosen) - 1: ", the best episode"}.get(place, "")
        where = f" in {cell.name}" if len(cells) > 1 else ""
        made.append((path, f"seed {episode.seed}{where}{kind}: SNS {sns(episode):.1f}"))
    return made, ""


def _evaluate(args):
    from bson.agents import load_agent
    from bson.evaluate import format_summary, results, summarise_cells
    from bson.report import make_report
    from bson.suites import load_suite

    suite = load_suite(args.suite)
    seeds = suite.drawn(args.episodes, args.seed)
    changes = _overrides(args.set)
    cells = [dataclasses.replace(cell, config=cell.config.replace(**changes)) for cell in suite.cells]
    make_agent = load_agent(args.agent)
    track = _track(args, make_agent)
    if args.videos < 0:
        raise UsageError(f"--videos must be at least 0, not {args.videos}.")
    for cell in cells:
        _check_spawn(cell.config, seeds)
    out = output_folder(args.out)
    if (out / "results.json").is_dir():
        raise UsageError(f"'{out / 'results.json'}' is a folder. Choose another --out.")
    played = []
    for cell in cells:
        name = args.agent if len(cells) == 1 else f"{args.agent}: {cell.name}"
        played.append(_play(make_agent, cell.config, track, seeds, name))
    episodes = [episode for each in played for episode in each]
    content = results(
        args.agent,
        suite.name,
        cells[0].config,
        episodes,
        people=cells[0].config.people,
        cells=summarise_cells(cells, played),
        suite_digest=suite.digest if not changes else None,
        track=[args.track or make_agent.track, args.sensor or make_agent.sensor],
        overrides={key: str(value) for key, value in changes.items()},
        frozen_seeds=args.seed == 0,
        command="bson " + shlex.join(args.argv),
    )
    print(format_summary(content), flush=True)
    # What an earlier run left here does not belong to these results.
    for stale in (out / "report.html", *(out / "videos").glob("seed-*.webm")):
        stale.unlink(missing_ok=True)
    write_json(out / "results.json", content)
    videos, why_not = _films(played, cells, track, out / "videos", args.videos, args.agent)
    write_bytes(out / "report.html", make_report(content, episodes, videos, why_not).encode())
    print(f"Written: {out / 'results.json'}, {out / 'report.html'}" + "".join(f", {path}" for path, _ in videos))
    return 0


def _render(args):
    from bson import film
    from bson.agents import load_agent
    from bson.task import TaskConfig
    from bson.world import build_model
    from macid import drawing

    config = TaskConfig().replace(**_overrides(args.set))
    make_agent = load_agent(args.agent)
    track = _track(args, make_agent)
    path = pathlib.Path(args.out)
    if path.suffix not in (".webm", ".png"):
        raise UsageError(f"--out must end in .webm (a film) or .png (a picture), not '{path.name}'.")
    if args.seed < 0:
        raise UsageError(f"A seed must be at least 0, not {args.seed}.")
    if path.is_dir():
        raise UsageError(f"--out '{path}' is a folder. Name a file.")
    if problem := drawing.gl_problem():
        raise UsageError(f"No pictures here: {problem}")
    _check_spawn(config, [args.seed])
    output_folder(path.parent)
    (episode,) = _play(make_agent, config, track, [args.seed], args.agent)
    model = build_model(config, track.sensors)
    if path.suffix == ".png":
        step = len(episode.pose) // 2 if args.step is None else args.step
        if not -len(episode.pose) <= step < len(episode.pose):
            raise UsageError(f"--step must be below {len(episode.pose)}, the episode's length, not {step}.")
        film.still(model, episode, path, step)
    else:
        film.film(model, episode, path, title=args.agent)
    print(f"Written: {path}")
    return 0


def _bench(args):
    from bson import bench
    from macid.pedestrians import make_controller

    make_controller(args.pedestrian_model, 0.1)
    if min(args.pedestrians) < 0 or min(args.worlds) < 1 or not 0 < args.seconds < 1e6:
        raise UsageError("--pedestrians must be at least 0, --worlds at least 1, --seconds above 0.")
    rows = bench.run(args.pedestrians, args.worlds, args.sensors, args.seconds, args.pedestrian_model)
    if args.out:
        path = pathlib.Path(args.out)
        output_folder(path.parent)
        write_json(path, {"machine": bench.machine(), "rows": rows})
    return 0


def _doctor(args):
    from bson import doctor

    return 0 if doctor.run() else 1


def _list(args):
    from bson.agents import BUILT_IN
    from bson.env import ENVIRONMENTS
    from bson.suites import load_suite, suite_names
    from macid.maps import map_names
    from macid.pedestrians import model_names

    print("environments  " + ", ".join(ENVIRONMENTS))
    print("agents        " + ", ".join(BUILT_IN) + ", or module:function, or file.py[:function]")
    print("pedestrians   " + ", ".join(model_names()))
    print("maps          " + ", ".join(map_names()) + ", or a .toml or .yaml file (--set map=NAME)")
    for name in suite_names():
        suite = load_suite(name)
        count = f"{len(suite.cells)} cells x {len(suite.seeds)}" if len(suite.cells) > 1 else f"{len(suite.seeds)}"
        print(f"suite         {name}: {suite.description} ({count} seeds)")
    return 0


def _add_setting(command):
    command.add_argument("--agent", default="vfh", help="a name (bson list), module:function, or file.py[:function]")
    command.add_argument("--track", default=None, help="local or global (default: what the agent wants)")
    command.add_argument("--sensor", default=None, help="lidar2d, ... (default: what the agent wants)")
    command.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change a field of the task, e.g. pedestrian_model=orca; may be repeated",
    )


def _add_evaluation(command, out, suite):
    command.add_argument("--suite", default=suite, help="smoke or paper (bson list)")
    command.add_argument("--episodes", type=int, default=None, help="only the suite's first N episodes")
    command.add_argument("--seed", type=int, default=0, help="0: the suite's own seeds; else another set of its kind")
    command.add_argument("--videos", type=int, default=2, help="films, from the worst episode to the best")
    command.add_argument("--out", default=out, help="folder for results.json, report.html and videos/")
    command.set_defaults(run=_evaluate)


def parser():
    """The command's parser."""
    defaults = {"formatter_class": argparse.ArgumentDefaultsHelpFormatter}
    root = argparse.ArgumentParser(prog="bson", description="A benchmark for robots that drive among people.")
    commands = root.add_subparsers(dest="command", required=True, metavar="command")

    demo = commands.add_parser(
        "demo", help="evaluate the reactive agent on ten episodes, with a report and films", **defaults
    )
    _add_setting(demo)
    _add_evaluation(demo, "bson-demo", "smoke")

    evaluate = commands.add_parser("evaluate", help="score an agent on a suite", **defaults)
    _add_setting(evaluate)
    _add_evaluation(evaluate, "results", "paper")

    render = commands.add_parser("render", help="film one seed", **defaults)
    _add_setting(render)
    render.add_argument("--seed", type=int, default=0)
    render.add_argument("--step", type=int, default=None, help="of a .png: the control step (default: halfway)")
    render.add_argument("--out", default="episode.webm", help="a .webm film, or a .png picture")
    render.set_defaults(run=_render)

    bench = commands.add_parser("bench", help="measure control steps/s", **defaults)
    bench.add_argument("--pedestrians", type=int, nargs="+", default=[24, 50, 100, 200])
    bench.add_argument("--worlds", type=int, nargs="+", default=[1, 16])
    bench.add_argument(
        "--sensors", nargs="+", default=["none", "lidar2d"], choices=["none", "lidar2d", "lidar3d", "camera"]
    )
    bench.add_argument("--seconds", type=float, default=2.0, help="time a case")
    bench.add_argument("--pedestrian-model", default="macid")
    bench.add_argument("--out", default=None, help="JSON file")
    bench.set_defaults(run=_bench)

    commands.add_parser("doctor", help="check this installation").set_defaults(run=_doctor)
    commands.add_parser("list", help="environments, agents, pedestrians, suites").set_defaults(run=_list)
    return root


def main(argv=None):
    """Entry point; returns the exit code."""
    argv = sys.argv[1:] if argv is None else argv
    args = parser().parse_args(argv)
    args.argv = argv
    return run_command("bson", lambda: args.run(args))


if __name__ == "__main__":
    sys.exit(main())
