"""`macid human`: what the command does, for Python."""

import pathlib
from collections.abc import Callable

from macid.files import new_folder, write_json
from macid.human import data
from macid.human.data import Walks


def describe(walks: Walks) -> str:
    """Lines about one file's walks."""
    import numpy as np

    from macid.human import measures

    person = measures.people(walks.position, walks.period)
    frames = "seconds" if walks.frames is None else f"{walks.frames:g} frames/s"
    lines = [
        f"{walks.name}: {walks.position.shape[1]} people, {walks.duration:.0f} s, {frames}; "
        f"{measures.mean(person.speed[person.walks]):.2f} m/s, "
        f"{100 * np.mean(~person.walks[~np.isnan(person.speed)]):.0f}% stand"
    ]
    if walks.source:
        known = walks.source
        lines += [f"  {known.title}", f"  source: {known.source}", f"  licence: {known.licence}"]
    else:
        lines += ["  not a known file: take source and licence from whoever gave it to you"]
    return "\n".join(lines)


def data_files(
    folder: str | pathlib.Path,
    figures: str | pathlib.Path | None = None,
    show: Callable[[str], None] = print,
    command: str = "macid human data",
) -> list[Walks]:
    """The walks of all files of `folder`, each told to `show`. figures: a folder for people's figures of all of them
    together, people.json. Raises UsageError at the first bad file."""
    found = []
    for walks in data.load_all(folder):
        show(describe(walks))
        found.append(walks)
    if figures is not None:
        from macid.human.figures import people

        with new_folder(figures) as out:
            write_json(out / "people.json", {"command": command, **people(found)})
        show(f"Written: {pathlib.Path(figures) / 'people.json'}")
    return found
