"""What others' programs read: `bson dataset`, `bson export`."""

import pathlib
import shlex
from typing import Any

from bson.commands.flags import add_setting, add_task, overrides
from macid import start
from macid.command import MOST_SEED, name
from macid.files import UsageError


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
        overrides=overrides(args),
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
    export(config.replace(**overrides(args)), track, args.seed, args.out, "bson " + shlex.join(args.argv))
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


def add_commands(commands: Any, defaults: dict[str, Any]) -> None:
    """Adds the commands to `commands`, argparse's subparsers; `defaults`: what each is made with."""
    dataset = commands.add_parser(
        "dataset", help="write episodes to a Minari dataset, for offline learning (extra `data`)", **defaults
    )
    add_setting(dataset, None, " (default: three datasets: tac as expert, ppo-paper as medium, and random)")
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
    add_task(export)
    export.add_argument("--out", type=name, required=True, help="folder, new or empty")
    export.set_defaults(run=_export)


DRAW_NOTHING = (_export,)  # commands that need no OpenGL
