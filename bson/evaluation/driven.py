"""Episodes that people drove (`bson live`): results.json of the agent `human`, and the episodes with what the robot saw
and what the person did, from which `bson train --algo bc --demonstrations` learns."""

import json
import pathlib
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np

from bson.episodes.record import Episode
from bson.episodes.tracks import make_track, sensor_label, sensor_settings
from bson.evaluation import metrics
from bson.evaluation.metrics import sns
from bson.evaluation.play import results
from bson.evaluation.results import Results
from bson.evaluation.store import Stored, basis, files_digest, read_basis
from bson.evaluation.suites import Cell
from bson.interfaces.drive import NAME, Drive
from bson.task import TaskConfig
from macid.files import UsageError, check_file, check_folder

EPISODES = "episodes"  # the folder in that of the results
_ACTIONS, _SEEN = "actions", "observation/"  # names of arrays in an episode's file
_MOST_SEEN = 4096  # numbers of a reading that is kept: pictures and maps are left out


class _Kept(Stored):
    _refusal = (
        "The episodes in '{folder}' were driven under other conditions: {changed} changed since. Name another --out."
    )
    _cure = "Name another --out."

    def saved(self, path: pathlib.Path) -> tuple[Episode, dict[str, np.ndarray], np.ndarray] | None:
        """The Episode in the file `path`, its observations (T + 1, ...) and actions (T, 2); None where it is
        damaged."""
        fields = self._fields(path)
        if fields is None or _ACTIONS not in fields:
            return None
        episode = self._episode(fields)
        seen = {name.removeprefix(_SEEN): value for name, value in fields.items() if name.startswith(_SEEN)}
        return episode, seen, fields[_ACTIONS]

    def files(self) -> list[pathlib.Path]:
        """The files of the episodes, in order."""
        return sorted(self._folder.glob("*.npz"))


class Driven:
    """People's episodes in the folder `out`: those that were driven before, and those that will be.

    suite: its name; cells: its Cells. track: (track, sensor) as for make_track. notes: further content of results.json.
    Raises UsageError where the folder has episodes of something else, or can't be written.
    """

    def __init__(
        self, out: str | pathlib.Path, suite: str, cells: Sequence[Cell], track: tuple[str, Any], **notes: Any
    ):
        self.folder, self._suite, self._cells = check_folder(out), suite, {cell.name: cell for cell in cells}
        self._lock = threading.Lock()  # pages have threads of their own
        check_file(self.folder / "results.json")
        self._track = make_track(*track)
        follows_from = basis(NAME, track, cells, False)
        self._store = _Kept(self.folder / EPISODES, follows_from, resume=True)
        self._notes = {
            **notes,
            "task_digest": files_digest(follows_from),
            "track": [track[0], sensor_label(track[1])],
            "sensors": sensor_settings(self._track.sensors),
            "paired": False,
        }
        self._episodes: dict[str, dict[int, Episode]] = {name: {} for name in self._cells}
        for name, cell in self._cells.items():
            for seed in self._store.seeds(cell):
                if (episode := self._store.load(cell, seed)) is not None:
                    self._episodes[name][seed] = episode

    def seeds(self, cell: str) -> frozenset[int]:
        """The seeds of the episodes of the cell of this name that were driven."""
        return frozenset(self._episodes[cell])

    def keep(self, drive: Drive, cell: str) -> str:
        """Keeps the episode of `drive`, which is over, as one of the cell of this name, if a person drove all of it,
        and nothing was changed. Returns what to tell the person. Raises UsageError where it can't be written."""
        episode = drive.episode()
        told = f"SNS {sns(episode):.1f}."
        if episode.fault:
            return "Not kept."
        if why := drive.why_not_human:
            return f"{told} Not kept: {why}."
        if drive.track != self._track:
            return f"{told} Not kept: the world was made for another agent's sensors."
        with self._lock:
            return f"{told} {self._save(drive, cell, episode)}"

    def _save(self, drive, cell, episode):
        if episode.seed in self._episodes[cell]:
            return f"Not kept: seed {episode.seed} was driven before, and the first drive counts."
        seen = {
            _SEEN + key: np.stack([each[key] for each in drive.observations])
            for key, value in drive.observations[0].items()
            if value.size <= _MOST_SEEN
        }
        self._store.save(self._cells[cell], episode, {_ACTIONS: np.stack(drive.actions), **seen})
        self._episodes[cell][episode.seed] = episode
        found = self.results()
        found.save(self.folder / "results.json")
        count = len(found.content["episodes"])
        return f"Kept: {count} in '{self.folder}', mean SNS {found.summary['SNS']:.1f}."

    def results(self) -> Results:
        """The Results of all episodes that were kept."""
        cells = [cell for name, cell in self._cells.items() if self._episodes[name]]
        played = [[episode for _, episode in sorted(self._episodes[cell.name].items())] for cell in cells]
        content = results(NAME, self._suite, cells, played, **self._notes)
        return Results(json.loads(json.dumps(content)), str(self.folder))


def score_so_far(drive: Drive) -> list[tuple[str, str]]:
    """(name, value) of the score so far, and of its parts (eq. 6)."""
    names = ("start_distance", "distance", "travelled", "time")
    start, left, driven, time = (float(drive.now(name)) for name in names)
    so_far = metrics.Driven(start, left, driven, time, int(drive.now("collisions")))
    parts = (metrics.route_completion, metrics.speed_score, metrics.path_efficiency)
    shown = ", ".join(f"{part(so_far):.2f}" for part in parts)
    return [("SNS so far", f"{metrics.sns(so_far):.1f}"), ("RC, SP, PE", shown)]


def is_driven(out: str | pathlib.Path) -> bool:
    """Whether `out` is a folder of `bson live` with episodes that people drove."""
    return (pathlib.Path(out) / EPISODES / "basis.json").is_file()


def read_driven(out: str | pathlib.Path, config: TaskConfig) -> list[tuple[Episode, dict[str, np.ndarray], np.ndarray]]:
    """The episodes that people drove in the folder `out` of `bson live`: (Episode, observations (T + 1, ...) by key,
    actions (T, 2)) each. Raises UsageError where there are none, one is damaged, or they were driven with other actions
    than those of the task `config`: another period, or other top speeds."""
    folder = pathlib.Path(out) / EPISODES
    nothing = f"'{out}' has no episodes that a person drove. Name a folder that bson live wrote (--out)."
    if not is_driven(out):
        raise UsageError(nothing)
    follows_from = read_basis(folder / "basis.json", "Name another folder.")
    store, found = _Kept(folder, follows_from, resume=True), []
    for path in store.files():
        if (one := store.saved(path)) is None:
            raise UsageError(f"The episode '{path}' is damaged. Delete it, or name another folder.")
        found.append(one)
    if not found:
        raise UsageError(nothing)
    wanted = config.control_period, config.robot.max_speed, config.robot.max_yaw_rate
    for _, setting, *_ in follows_from["cells"]:
        robot = setting["robot"]
        driven = setting["control_period"], robot["max_speed"], robot["max_yaw_rate"]
        if driven != wanted:
            told = [f"{period:g} s, {speed:g} m/s, {rate:g} rad/s" for period, speed, rate in (driven, wanted)]
            raise UsageError(f"'{out}' was driven at a control period and top speeds of {told[0]}, not {told[1]}.")
    return found
