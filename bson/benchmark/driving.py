"""A page to drive in (extra `live`)."""

import contextlib
import dataclasses
import pathlib
from typing import Any

from bson.benchmark.episodes import check_spawn
from macid.files import (
    UsageError,
    lock_folder,
)


def live(
    agent: Any = None,
    out: str | pathlib.Path = "human",
    *,
    suite: str | None = None,
    cell: str | None = None,
    seed: int = 0,
    track: str | None = None,
    sensor: Any = None,
    overrides: dict[str, Any] | None = None,
    untrained: bool = False,
    host: str = "127.0.0.1",
    port: int = 8080,
    token: str | None = None,
    stays: bool = False,
    command: str | None = None,
) -> None:
    """Serves pages to drive in, as `bson live` does; returns once the last page has been closed.

    agent: drives at first, as of `evaluate`; None: the person does. out: folder for the episodes that a person drives
    from beginning to end: results.json of the agent `human`, and episodes/, from which `train` with demonstrations=out
    learns. suite, cell: whose settings and seeds are driven, with `seed` as of `evaluate`; without a suite the default
    task, and the seeds from `seed` on. host, port, token: where to listen, see macid.live.server.Server. stays: also
    without pages. The rest as of `evaluate`. Raises UsageError.
    """
    from macid.live.server import check_address, load_viser, serve

    check_address(host, token)
    load_viser()
    from bson.agents import agent_label, check_settings, load_agent
    from bson.episodes.tracks import make_track
    from bson.evaluation.driven import Driven, score_so_far
    from bson.evaluation.suites import Cell, load_suite
    from bson.interfaces.drive import PERSON, Course
    from bson.interfaces.live import DrivePage, DriveSetting
    from bson.task import TaskConfig
    from macid.documents import shown

    changes = overrides or {}
    if suite is None:
        if cell is not None:
            raise UsageError("--cell is one of a suite: give --suite, too.")
        cells, seeds, digest, called = [Cell((), TaskConfig())], (), None, "live"
    else:
        chosen = load_suite(suite)
        cells, seeds, digest, called = chosen.cells, tuple(chosen.drawn(None, seed)), chosen.digest, chosen.name
    cells = [dataclasses.replace(each, config=each.config.replace(**changes)) for each in cells]
    settings = {each.name: each.config for each in cells}
    if cell is not None and cell not in settings:
        raise UsageError(f"Suite '{suite}' has no cell {shown(cell)}. Choose one of {', '.join(map(repr, settings))}.")
    course = Course(settings, seeds, seed)
    begun_with = (track or "local", sensor or "lidar2d")
    seen = make_track(*begun_with)
    if agent is not None:
        factory = load_agent(agent, untrained)
        check_settings(factory, settings.values(), make_track(track or factory.track, sensor or factory.sensor))
    for config in settings.values():
        check_spawn(config, [course.after(None)])
        for one in seen.sensors:
            one.every(config.control_period)
    name = PERSON if agent is None else agent_label(agent)
    setting = DriveSetting(course, cell or cells[0].name, agent or PERSON, name, track, sensor, untrained)
    with lock_folder(out, ["results.json"]) as folder:
        driven = Driven(
            folder,
            called,
            cells,
            begun_with,
            suite_digest=digest if not changes else None,
            overrides={key: str(value) for key, value in changes.items()},
            frozen_seeds=suite is not None and seed == 0,
            command=command,
        )
        serve(
            lambda client: DrivePage(client, setting, score_so_far, driven.keep, driven.seeds),
            "bson live",
            host,
            port,
            token,
            stays,
        )
    with contextlib.suppress(OSError):
        folder.rmdir()  # where nobody has driven
