"""How fast this machine is: `bson bench`."""

import dataclasses
from typing import Any

from bson.commands.flags import add_engine
from macid.command import MOST_PEOPLE, MOST_WORLDS, name
from macid.files import UsageError, check_file, new_folder, write_json


def _bench(args):
    from bson import bench
    from bson.benchmark.training import agents_extra
    from bson.simulation.engines import engine_limits, engine_name
    from bson.task import TaskConfig
    from macid.pedestrians import make_controller

    limits = engine_limits(args.engine)
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
    elif engine_name(args.engine) == "warp":
        rows = _bench_warp(args, given, limits)
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


def _bench_warp(args, given, limits):
    from bson import bench_warp
    from bson.simulation.engines.warp import check_warp

    check_warp()
    given["engine"] = dataclasses.asdict(limits)

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


def add_commands(commands: Any, defaults: dict[str, Any]) -> None:
    """Adds the commands to `commands`, argparse's subparsers; `defaults`: what each is made with."""
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
    add_engine(bench, "default worlds then 1024 4096")
    bench.add_argument("--out", type=name, help="JSON file")
    bench.set_defaults(run=_bench)
