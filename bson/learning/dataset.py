"""Played episodes as Minari datasets (extra `data`), for offline learning: written while they are played, and read back
as demonstrations."""

import contextlib
import copy
import dataclasses
import json
import pathlib
import re
from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium
import numpy as np

from bson import ENVIRONMENTS
from bson.agents.contract import act, made_for, reset_agent
from bson.episodes.record import Episode
from bson.episodes.session import Session
from bson.episodes.tracks import make_track, sensor_documents
from bson.evaluation.driven import is_driven, read_driven
from bson.evaluation.metrics import sns
from bson.evaluation.play import run_episodes
from bson.features import FEATURES, SECTORS, Features
from bson.interfaces.gym import ACTION_SPACE
from bson.simulation.data import QUANTITIES
from bson.task import TaskConfig
from macid.documents import shown
from macid.files import UsageError, named, remove_leftover_folders, whole_folder

#: {the name of a set of the paper's setting: its agent}
LEVELS = {"expert": "tac", "medium": "ppo-paper", "random": "random"}
_INFOS = tuple(each.name for each in QUANTITIES if each.info and each.kind is not str and each.name != "seed")
_SEEN = ("goal", "velocity", "lidar")  # what learned robots observe (bson.features)
_FILES = {"data", "data/main_data.hdf5", "data/metadata.json"}  # of a dataset
_ID = re.compile(r"([-_\w]+/)*[-_\w]+-v\d+")  # as Minari has them, with a version


def _minari() -> Any:
    """The package minari. Raises UsageError where it, or what it stores data with, is missing."""
    try:
        import h5py  # noqa: F401
        import minari
    except ModuleNotFoundError as error:
        raise UsageError(f"Datasets need {error.name}: pip install 'bson-macid[data]'.") from None
    return minari


def check() -> None:
    """Raises UsageError, one line that says what to install, where the extra `data` is missing."""
    _minari()


def check_id(name: str) -> str:
    """`name`, if it is a dataset's id. Raises UsageError."""
    if not _ID.fullmatch(name):
        raise UsageError(f"--id must be words of letters, digits, - and _ with a version, a/b-v0, not {shown(name)}.")
    return name


def folder_of(name: str, out: str | pathlib.Path | None = None) -> pathlib.Path:
    """The folder of the dataset `name` in the folder of datasets `out`, by default Minari's own. Raises UsageError
    where there is one already."""
    if out is None:
        from minari.storage import get_dataset_path

        out = get_dataset_path()
    folder = pathlib.Path(out) / check_id(name)
    if folder.exists():
        raise UsageError(f"There is a dataset in {named(folder)} already: give another --id or --out, or delete it.")
    return folder


class _Exact:
    """An agent whose actions are float32 in [-1, 1], as the dataset keeps them: played again, they give the same
    episode."""

    def __init__(self, agent, name):
        self._agent, self._name = agent, name

    def reset(self, seed):
        reset_agent(self._agent, seed, self._name)

    def __call__(self, observation):
        return np.clip(act(self._agent, observation, self._name), -1.0, 1.0).astype(np.float32)


class _Rows:
    """What a dataset has of one episode that is played (bson.evaluation.play.Watch)."""

    def __init__(self, session, index, end):
        self._session, self._index, self._end = session, index, end
        self.seed = int(session.world.seed[index])
        self.observations, self.actions, self.infos = [], [], []
        self.rewards, self.terminations, self.truncations = [], [], []
        self._note()

    def _note(self):
        observation, info = self._session.observe([self._index]), self._session.info([self._index])
        self.observations.append({name: value[0] for name, value in observation.items()})
        self.infos.append({name: info[name][0] for name in _INFOS})

    def snap(self, action, reward, terminated, truncated):
        self.actions.append(np.asarray(action, np.float32))
        self.rewards.append(float(reward))
        self.terminations.append(bool(terminated))
        self.truncations.append(bool(truncated))
        self._note()

    def end(self, episode):
        self._end(self, episode)

    def buffer(self, options):
        """As Minari takes it."""
        from minari.data_collector import EpisodeBuffer

        def columns(rows):
            return {name: np.stack([row[name] for row in rows]) for name in rows[0]}

        return EpisodeBuffer(
            seed=self.seed,
            options=options,
            observations=columns(self.observations),
            actions=np.stack(self.actions),  # pyright: ignore[reportArgumentType]
            rewards=self.rewards,
            terminations=self.terminations,
            truncations=self.truncations,
            infos=columns(self.infos),
        )


def _spec(config, track, sensor):
    """The EnvSpec of the environment in which episodes of `config` can be played, or None for a track of the user's
    own."""
    wanted = {"track": track, "sensor": sensor if sensor in ("lidar2d", "lidar3d", "camera") else "lidar2d"}
    found = [name for name, arguments in ENVIRONMENTS.items() if arguments == wanted]
    if not found:
        return None
    default, own = TaskConfig(), dataclasses.asdict(config)
    spec = copy.deepcopy(gymnasium.spec(found[0]))
    changed = {name: value for name, value in own.items() if value != dataclasses.asdict(default)[name]}
    spec.kwargs = {**spec.kwargs, **json.loads(json.dumps(changed, default=np.ndarray.tolist))}
    if wanted["sensor"] != sensor:
        spec.kwargs["sensor"] = sensor_documents(sensor)
    return spec


@contextlib.contextmanager
def _storage(folder, name, config, track, wanted, about) -> Iterator[Any]:
    """A MinariStorage to be filled in a `with`, which then is in `folder`."""
    _minari()
    from minari import __version__
    from minari.dataset.minari_storage import MinariStorage

    with whole_folder(folder) as temporary:
        remove_leftover_folders(temporary.parent, _unfinished)
        storage = MinariStorage.new(
            temporary / "data",
            observation_space=track.space(config),
            action_space=ACTION_SPACE,
            env_spec=_spec(config, *wanted),
            jpeg_encoding=False,  # which would change pictures
        )
        storage.update_metadata({"dataset_id": name, "minari_version": __version__, **about})
        yield storage


def _unfinished(path, name):
    """Whether the temporary folder `path` holds what a run that was killed left of a dataset."""
    return {str(file.relative_to(path)) for file in path.rglob("*")} == _FILES


def write(
    folder: pathlib.Path,
    name: str,
    make_agent: Any,
    agent: str,
    cells: Sequence[Any],
    wanted: tuple[str, Any],
    seeds: Sequence[int],
    about: dict[str, Any],
    progress: Any = None,
) -> None:
    """Plays the episodes `seeds` of each of `cells` (bson.evaluation.suites.Cell) and writes them to the dataset `name`
    in `folder`, in the order of cells and seeds.

    make_agent: the factory of the agent `agent`. wanted: (track, sensor), as for make_track. about: more for the
    dataset's metadata. progress: as for run_episodes. Actions are rounded to float32 before they are executed. An
    episode in which physics fails is left out. Raises UsageError where the cells' observations differ in shape.
    """
    track = make_track(*wanted)
    if any(track.space(cell.config) != track.space(cells[0].config) for cell in cells):
        raise UsageError("A dataset has one observation space, and this suite's cells differ: name one by --cell.")

    def exact(setting):
        return _Exact(made_for(make_agent, setting), agent)

    with _storage(folder, name, cells[0].config, track, wanted, about) as storage:
        for cell in cells:
            ended: dict[int, tuple[_Rows, Episode]] = {}
            order = list(seeds)

            def end(rows, episode, cell=cell, ended=ended, order=order):
                ended[rows.seed] = rows, episode
                while order and order[0] in ended:  # Minari numbers episodes as they come
                    done, its = ended.pop(order.pop(0))
                    if not its.fault:
                        options = {"cell": cell.name, "SNS": sns(its), "collisions": its.collisions}
                        storage.update_episodes([done.buffer(options)])

            def watch(session: Session, index: int, end=end):
                return _Rows(session, index, end)

            run_episodes(exact, cell.config, track, seeds, agent, progress, watch=watch)


def load(name: str) -> Any:
    """The MinariDataset `name`: an id in Minari's folder of datasets, or the dataset's folder. Raises UsageError."""
    minari = _minari()
    folder = pathlib.Path(name)
    try:
        if (folder / "data").is_dir():
            return minari.MinariDataset(folder / "data")
        return minari.load_dataset(name)
    except Exception as error:  # Minari and HDF5 raise errors of many kinds
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        raise UsageError(f"Can't read the dataset {shown(name)}: {reason}") from None


def demonstrations(name: str, config: TaskConfig, steps: int) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """The episodes of the dataset `name` (see `load`), or of the folder `name` in which `bson live` keeps what people
    drove, until they hold `steps` control steps, as bson.learning.imitation.demonstrate gives them: [(SNS, features (T,
    FEATURES), actions (T, 2)), ...].

    config: the setting of the robot that learns. Raises UsageError where the observations are not the Local track's,
    with the 2D LIDAR, or people drove at another control period or other top speeds.
    """
    top = np.array([config.robot.max_speed, config.robot.max_yaw_rate])
    if is_driven(name):
        return _driven(name, config, top, steps)
    dataset, found, collected = load(name), [], 0
    space = dataset.observation_space
    sizes = {key: part.shape for key, part in getattr(space, "spaces", {}).items() if key in _SEEN}
    if len(sizes) < len(_SEEN) or len(sizes["lidar"]) != 1 or sizes["lidar"][0] % SECTORS:
        wanted = f"goal, velocity, and a lidar whose beams are a multiple of {SECTORS}"
        raise UsageError(f"The dataset {shown(name)} can't be learned from: its observations need {wanted}.")
    told = dataset.storage.get_episode_metadata(range(dataset.total_episodes))
    for episode, noted in zip(dataset.iterate_episodes(), told, strict=True):
        x = _features(episode.observations, len(episode.actions), top)
        score = noted.get("options", {}).get("SNS", float(np.sum(episode.rewards)))
        found.append((float(score), x, np.asarray(episode.actions)))
        collected += len(x)
        if collected >= steps:
            break
    if not found:
        raise UsageError(f"The dataset {shown(name)} has no episode.")
    return found


def check_demonstrations(name: str, config: TaskConfig) -> None:
    """Raises UsageError where `demonstrations` would find nothing of that name."""
    if is_driven(name):
        read_driven(name, config)
    else:
        load(name)


def _driven(name, config, top, steps):
    """`demonstrations` of the folder of `bson live`."""
    found, collected = [], 0
    for episode, seen, actions in read_driven(name, config):
        if "lidar" not in seen or seen["lidar"].ndim != 2 or seen["lidar"].shape[1] % SECTORS:
            wanted = f"a lidar whose beams are a multiple of {SECTORS}"
            raise UsageError(f"What people drove in {shown(name)} can't be learned from: it needs {wanted}.")
        found.append((sns(episode), _features(seen, len(actions), top), actions))
        collected += len(actions)
        if collected >= steps:
            break
    return found


def _features(observations, number, top):
    """Features (number, FEATURES) of the first `number` observations of an episode."""
    features, x = Features(1, top), np.empty((number, FEATURES), np.float32)
    for step in range(number):
        row = {key: observations[key][step : step + 1] for key in _SEEN}
        x[step] = (features.step if step else features.begin)([0], row)[0]
    return x
