"""Pedestrians for Python: what the commands `macid evaluate`, `watch` and `train` do, as calls.

Errors that a user can mend are ValueErrors of one line, most of them macid.files.UsageError.
"""

import pathlib
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from macid import start
from macid.executors import Executor, make_executor
from macid.files import UsageError, check_file, check_folder, new_folder, write_json
from macid.state import MAX_SPEED, RADIUS


def evaluate(
    pedestrian: str,
    levels: Sequence[int | str] = (1, 2, 3, 4),
    *,
    episodes: int = 5,
    seed: int = 0,
    period: float | None = None,
    lcf: tuple[float, float] | None = None,
    bins: bool = False,
    engine: str = "native",
    out: str | pathlib.Path | None = None,
    show: Callable[[str], None] = lambda line: None,
    radius: float = RADIUS,
    preferred_speed: float | tuple[float, float] | str | None = None,
    max_speed: float = MAX_SPEED,
    companions: float | None = None,
) -> list[dict[str, Any]]:
    """A pedestrian model on levels (Table II), as `macid evaluate` does: rows of macid.evaluate.evaluate_level.

    pedestrian: a rule, a shipped policy, or a policy file (.npz). period: between decisions [s] (default: the policy's
    own). lcf: range of LCFs (default: Table II's). bins: one row for each of Table I's six sections of the LCFs
    instead. out: a JSON file for the rows; None: nothing is written. show: called with a line as a level begins.
    radius: of people [m]. preferred_speed, max_speed, companions: see macid.crowd.CrowdConfig. Raises UsageError.
    """
    from macid import evaluate as scoring
    from macid.crowd import CrowdConfig
    from macid.layout import load_level

    period = scoring.usual_period(pedestrian) if period is None else period
    for level in levels:
        load_level(level)
    if bins and lcf:
        raise UsageError("--bins has LCFs of its own: leave --lcf out.")
    least, most = lcf or scoring.table_lcf(pedestrian)
    ranges = scoring.lcf_bins(pedestrian) if bins else [(least, most)]
    people = _people(radius, preferred_speed, max_speed, companions)
    configs = [CrowdConfig(period=period, lcf=each, **people) for each in ranges]
    path = None if out is None else check_file(out, "JSON file")
    rows = []
    for level in levels:
        show(f"{pedestrian} on {scoring.level_name(level)} ...")
        rows += [scoring.evaluate_level(pedestrian, level, episodes, seed, config, engine) for config in configs]
    if path is not None:
        with new_folder(path.parent):
            write_json(path, rows)
    return rows


def _people(radius, preferred_speed, max_speed, companions):
    """The fields of a CrowdConfig that say what people are like."""
    from macid.scene import PersonConfig

    return {
        "person": PersonConfig(radius=radius),
        "preferred_speed": preferred_speed,
        "max_speed": max_speed,
        "companions": companions,
    }


def watch(
    pedestrian: str = "macid",
    out: str | pathlib.Path = "crowd.webm",
    *,
    level: int | str = 2,
    lcf: tuple[float, float] | None = None,
    seed: int = 0,
    seconds: float = 20.0,
    period: float | None = None,
    speed: int = 1,
    follow: int | None = None,
    at: float | None = None,
    scale: float = 0.75,
    show: Callable[[str], None] = lambda line: None,
    quiet: bool = False,
    radius: float = RADIUS,
    preferred_speed: float | tuple[float, float] | str | None = None,
    max_speed: float = MAX_SPEED,
    companions: float | None = None,
) -> pathlib.Path:
    """Films a crowd, as `macid watch` does; returns the path.

    out: a .webm film, or a .png picture of the time `at` [s] (default: halfway). seconds: of the crowd's time. speed:
    how many times as fast a film plays. follow: through whose eyes to look (default: one with far to go). scale: of the
    picture, 1 is 1500 x 760. quiet: no progress on stderr. The rest as of `evaluate`. Raises UsageError.
    """
    from tqdm import tqdm

    from macid import watch
    from macid.crowd import CrowdConfig
    from macid.drawing import gl
    from macid.evaluate import level_name, table_lcf, usual_period
    from macid.layout import load_level

    period = usual_period(pedestrian) if period is None else period
    number = load_level(level).people
    path = pathlib.Path(out)
    if path.suffix not in (".webm", ".png"):
        raise UsageError(f"--out must end in .webm (a film) or .png (a picture), not '{path.name}'.")
    check_file(path)
    if not 0 < seconds <= 600:
        raise UsageError(f"--seconds must be above 0 and at most 600, not {seconds:g}.")
    if follow is not None and not 0 <= follow < number:
        raise UsageError(f"--follow must be 0 to {number - 1}, one of the {number} people, not {follow}.")
    if not 0.25 <= scale <= 2:
        raise UsageError(f"--scale must be 0.25 to 2, not {scale:g}.")
    if at is not None and path.suffix != ".png":
        raise UsageError("--at is for a picture: let --out end in .png.")
    if at is not None and not 0 <= at <= seconds:
        raise UsageError(f"--at must be 0 to {seconds:g}, the episode's length in seconds, not {at:g}.")
    least, most = lcf or table_lcf(pedestrian)
    people = _people(radius, preferred_speed, max_speed, companions)
    config = CrowdConfig(period=period, duration=seconds, lcf=(least, most), **people)
    if problem := gl.gl_problem():
        raise UsageError(f"No pictures here: {problem}")
    show(f"{pedestrian} on {level_name(level)} ...")
    start.cleaning_up()
    recording = watch.record(pedestrian, level, config, seed)
    with new_folder(path.parent):
        if path.suffix == ".png":
            watch.still(recording, path, at, follow, scale)
        else:
            with tqdm(unit="frame", desc="filming", file=sys.stderr, disable=quiet) as bar:

                def progress(done: int, total: int) -> None:
                    bar.total = total
                    bar.update()

                watch.film(recording, path, speed, follow, scale, progress)
    return path


def live(
    pedestrian: str = "macid",
    *,
    level: int | str = 2,
    people: int | None = None,
    lcf: tuple[float, float] | None = None,
    seed: int = 0,
    period: float | None = None,
    leave: bool = False,
    host: str = "127.0.0.1",
    port: int = 8080,
    token: str | None = None,
    stays: bool = False,
) -> None:
    """Serves pages in which a crowd walks, as `macid live` does; returns once the last page has been closed.

    people: how many (default: the level's own). leave: whether a person who arrives leaves the map, as in `evaluate`,
    instead of walking on to a new goal. host, port, token: where to listen, see macid.live.server.Server. stays: also
    without pages. The rest as of `evaluate`. Raises UsageError.
    """
    from macid.live.server import check_address, load_viser, serve

    check_address(host, token)
    load_viser()
    from macid.layout import load_level, sample_people
    from macid.live.crowd import CrowdPage, CrowdSetting

    setting = CrowdSetting(pedestrian, level, people, lcf, period, not leave)
    config = setting.config  # raises where a part of it is not valid
    sample_people(np.random.default_rng(seed), load_level(level), config.number)  # raises where there is no room
    serve(lambda client: CrowdPage(client, setting, seed), "macid live", host, port, token, stays)


def train(
    method: str = "macid",
    out: str | pathlib.Path = "runs",
    *,
    preset: str = "fast",
    seed: int = 0,
    seeds: int = 1,
    resume: bool = False,
    tensorboard: bool = False,
    executor: str | Executor = "local",
    ray_address: str | None = None,
    workers: int | None = None,
    show: Callable[[str], None] = print,
    **fields: Any,
) -> list[pathlib.Path]:
    """Trains pedestrians, as `macid train` does; returns the folders `out`/NAME-SEED of the seeds `seed` to `seed` +
    `seeds` - 1, each with policy.npz, policy.json and curve.csv.

    preset, fields: see macid.learning.config.preset; `nworld`, `agent_steps`, `level`, `engine`, `period` are such
    fields. resume: goes on from checkpoints. executor, ray_address, workers: see macid.executors.make_executor. In this
    process all seeds are trained at once, and sums are rounded otherwise than alone; elsewhere each is trained as if
    alone. show: called with lines on the progress. Raises UsageError or another ValueError of one line.
    """
    from macid.learning import config
    from macid.learning import train as training
    from macid.learning.jobs import folder_of

    first = config.preset(preset, method=method, seed=seed, **fields)
    folder = check_folder(out)
    configs = config.seeds_of(first, seeds)
    start.cleaning_up()
    with make_executor(executor, ray_address, workers) as runner:
        if runner.workers is not None:
            if tensorboard:
                raise UsageError("--tensorboard is for trainings in this process: leave it out with --executor ray.")
            return training.train_apart(runner, configs, folder, resume, show)
        training.train(first, folder, seeds, resume=resume, show=show, tensorboard=tensorboard)
    return [folder / folder_of(config) for config in configs]
