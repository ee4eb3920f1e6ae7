"""Films of episodes: those of an evaluation, and one on its own."""

import functools
import pathlib
import sys
from collections.abc import Sequence
from typing import Any

from bson.benchmark.episodes import check_spawn, episodes_bar
from bson.episodes.record import Episode
from macid.files import UsageError, check_file, new_folder, output_folder


def to_film(played: Sequence[Sequence[Episode]], number: int) -> list[tuple[int, Episode, str]]:
    """The episodes to film, each as (the cell's place, the episode, a description of it).

    played: the episodes of each cell. With one cell: `number` of its episodes, evenly from the worst SNS to the best.
    With several cells: the worst episode of each of the `number` worst cells, and the best episode of the best cell.
    """
    from bson.evaluation.metrics import sns, spread_by_score

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


def film_episodes(
    played: Sequence[Sequence[Episode]],
    cells: Sequence[Any],
    track: Any,
    folder: pathlib.Path,
    number: int,
    name: str,
    quiet: bool,
) -> tuple[list[tuple[pathlib.Path, str]], str]:
    """Films episodes (see to_film) into `folder`; returns (path, caption) pairs, and the reason if there are none.

    played: the episodes of each of `cells`. name: the agent's. quiet: no progress on stderr.
    """
    from tqdm import tqdm

    from bson.episodes import film
    from bson.evaluation.metrics import sns
    from bson.simulation.scene import build_model
    from macid.drawing import gl

    if number == 0:
        return [], "No films were asked for (--videos 0)."
    if problem := gl.gl_problem():
        print(f"No video: {problem}", file=sys.stderr)
        return [], f"No video: {problem}"
    output_folder(folder)
    model = functools.cache(lambda config: build_model(config, track.sensors))
    made = []
    chosen = to_film(played, number)
    for place, episode, kind in tqdm(chosen, unit="film", desc="filming", file=sys.stderr, disable=quiet):
        cell, several = cells[place], len(cells) > 1
        path = folder / f"seed-{episode.seed}{'-' + cell.slug if several else ''}.webm"
        film.film(model(cell.config), episode, path, title=f"{name}: {cell.name}" if several else name)
        where = f" in '{cell.name}'" if several else ""
        made.append((path, f"seed {episode.seed}{where}{kind and f', {kind}'}: SNS {sns(episode):.1f}"))
    return made, ""


def film(
    agent: Any,
    out: str | pathlib.Path = "episode.webm",
    *,
    seed: int = 0,
    step: int | None = None,
    track: str | None = None,
    sensor: Any = None,
    overrides: dict[str, Any] | None = None,
    untrained: bool = False,
    quiet: bool = False,
) -> pathlib.Path:
    """Films the episode `seed` of an agent, as `bson render` does; returns the path.

    out: a .webm film, or a .png picture of the control step `step` (default: halfway; -1 is the last). The other
    arguments are as for `evaluate`. Where the request can't be met, raises UsageError before anything is played.
    """
    from bson.agents import agent_label, check_settings, load_agent
    from bson.episodes import film
    from bson.episodes.tracks import make_track
    from bson.evaluation.play import run_episodes
    from bson.simulation.scene import build_model
    from bson.task import TaskConfig
    from macid.drawing import gl

    config, name = TaskConfig().replace(**overrides or {}), agent_label(agent)
    make_agent = load_agent(agent, untrained)
    seen = make_track(track or make_agent.track, sensor or make_agent.sensor)
    check_settings(make_agent, [config], seen)
    path = pathlib.Path(out)
    if path.suffix not in (".webm", ".png"):
        raise UsageError(f"--out must end in .webm (a film) or .png (a picture), not '{path.name}'.")
    check_file(path)
    if problem := gl.gl_problem():
        raise UsageError(f"No pictures here: {problem}")
    check_spawn(config, [seed])
    with episodes_bar(name, 1, quiet) as progress:
        (episode,) = run_episodes(make_agent, config, seen, [seed], name, progress)
    if episode.fault:
        raise UsageError(f"Physics failed in the episode of seed {seed}: {episode.fault}. Choose another --seed.")
    model = build_model(config, seen.sensors)
    if path.suffix == ".png":
        step = len(episode.pose) // 2 if step is None else step
        if not -len(episode.pose) <= step < len(episode.pose):
            raise UsageError(f"--step must be below {len(episode.pose)}, the episode's length, not {step}.")
        with new_folder(path.parent):
            film.still(model, episode, path, step)
    else:
        with new_folder(path.parent):
            film.film(model, episode, path, title=name)
    return path
