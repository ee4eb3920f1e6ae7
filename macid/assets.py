"""Where the data files are: in `assets/` of a checkout, in `macid/_assets/` of an installed wheel."""

import functools
import pathlib


@functools.cache
def root() -> pathlib.Path:
    """The assets folder. Raises FileNotFoundError when the installation lacks it."""
    package = pathlib.Path(__file__).resolve().parent
    for folder in (package / "_assets", package.parent / "assets"):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"No assets beside {package}: this installation is incomplete; reinstall bson.")


def path(*parts: str) -> pathlib.Path:
    """Path of the asset `parts` (folder names and a file name). Raises FileNotFoundError, naming what there is."""
    found = root().joinpath(*parts)
    if not found.exists():
        siblings = sorted(p.name for p in found.parent.iterdir()) if found.parent.is_dir() else []
        raise FileNotFoundError(f"No asset '{'/'.join(parts)}'. There are: {', '.join(siblings) or 'none'}.")
    return found


def names(folder: str, suffix: str) -> list[str]:
    """Names, without `suffix`, of the assets in `folder`, sorted."""
    return sorted(p.name[: -len(suffix)] for p in (root() / folder).glob(f"*{suffix}"))
