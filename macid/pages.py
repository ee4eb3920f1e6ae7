"""What pages of HTML are made with: their templates, colours, and pictures that are in them.

A page is one file: pictures and films are in it, and it needs no other file.
"""

import base64
import io
import pathlib
from typing import Any

import jinja2

INK, ACCENT, BAD, GRID = "#1d2733", "#1f6f8b", "#c0392b", "#d9dfe5"


def templates(folder: pathlib.Path) -> jinja2.Environment:
    """The templates in `folder`. They escape the texts that they are given, and refuse a name that they are not
    given."""
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def new_figure(*args: Any, **kwargs: Any) -> Any:
    """A Matplotlib figure made without pyplot, so that no display or global state is touched."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(*args, layout="constrained", **kwargs)
    FigureCanvasAgg(figure)
    return figure


def png(figure: Any, dots: int = 110) -> str:
    """A Matplotlib figure as the text of a `data:image/png;base64,` address, at `dots` pixels an inch."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dots, facecolor="white")
    return base64.b64encode(buffer.getvalue()).decode()


def base64_of(path: pathlib.Path) -> str:
    """The file `path` as the text of a base64 address, such as `data:video/webm;base64,`."""
    return base64.b64encode(path.read_bytes()).decode()
