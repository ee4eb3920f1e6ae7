"""The parts of the HTML pages (see macid.pages), and how they are published.

A template escapes the texts that it is given, but not the output of another template.
"""

import pathlib
from typing import Any

from markupsafe import Markup

from macid import pages
from macid.files import check_file, check_folder, lock_folder, write_bytes, write_json

DASH = Markup("&ndash;")  # where there is no value
BETTER = {"up": Markup("&uarr;"), "down": Markup("&darr;"), "": ""}  # {a metric's `better`: its arrow}


def publish(out: str | pathlib.Path, name: str, content: Any, page: str) -> None:
    """Writes `content` to NAME.json and `page` to NAME.html in the folder `out`. Raises UsageError, before anything is
    written, where one of them can't be."""
    folder = check_folder(out)
    for file in (f"{name}.json", f"{name}.html"):
        check_file(folder / file)
    with lock_folder(folder):
        write_json(folder / f"{name}.json", content)
        write_bytes(folder / f"{name}.html", page.encode())


def numbers(*values: float, digits: int | None = None, signed: bool = False) -> list[str]:
    """`values` as texts with the same number of decimals: `digits`; by default as many as show three digits of the
    largest value.

    signed: with a plus before values above 0.
    """
    largest = max(map(abs, values))
    if digits is None:
        digits = 0 if largest == 0 else sum(largest < bound for bound in (99.95, 9.995, 0.9995))
    rounded = [round(value, digits) + 0.0 for value in values]  # + 0.0 turns -0 into 0
    return [f"{'+' if signed and value > 0 else ''}{value:.{digits}f}" for value in rounded]


def plural(count: int, noun: str) -> str:
    """A count with its noun, such as "1 episode", "27 episodes"."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def image(figure: Any, caption: str, dots: int = 130) -> Any:
    """A Matplotlib figure as HTML, at `dots` pixels an inch."""
    return _PARTS.image(pages.png(figure, dots), caption)


def video(path: pathlib.Path, caption: str) -> Any:
    """The .webm film `path` as HTML."""
    return _PARTS.video(pages.base64_of(path), caption)


def render(template: str, **content: Any) -> Markup:
    """HTML: the file `template` of the folder templates with `content` in it."""
    return Markup(_TEMPLATES.get_template(template).render(content))


_TEMPLATES = pages.templates(pathlib.Path(__file__).with_name("templates"))
_TEMPLATES.globals["plural"] = plural
_PARTS: Any = _TEMPLATES.get_template("parts.html").module
