"""Results beside each other: as a comparison, a map of cells, a table."""

import pathlib
from collections.abc import Callable, Sequence
from typing import Any

from bson.evaluation.results import Results
from macid.files import UsageError, check_file, write_bytes


def _loaded(results):
    """The Results given, or those read from the folder or file of that name."""
    return results if isinstance(results, Results) else Results.load(results)


def compare(results: Sequence[Any], out: str | pathlib.Path | None = None) -> dict[str, Any]:
    """Results beside each other, with paired differences from the first, as `bson compare` does: the content of
    compare.json.

    results: Results, or folders that an evaluation wrote, or their results.json, or bson.reporting.compare.Groups of
    Results: the trainings of one agent, with intervals over these, too (see bson.evaluation.statistics). out: folder
    for compare.json and compare.html; None: nothing is written. Raises ValueError where they can't be compared.
    """
    from bson.reporting.compare import Group, compare, make_page
    from bson.reporting.page import publish

    content = compare([each if isinstance(each, Group) else _loaded(each) for each in results])
    if out is not None:
        publish(out, "compare", content, make_page(content))
    return content


def heatmap(results: Results | str | pathlib.Path, metric: str = "SNS", out: str | pathlib.Path | None = None) -> str:
    """A metric over the cells of a suite, drawn as the report draws the SNS: an HTML page.

    results: one item, as for `compare`. metric: a name of bson.evaluation.metrics.METRICS. out: an .html file to write.
    Raises UsageError where the suite has one cell only, or the metric is unknown.
    """
    from bson.evaluation.metrics import METRICS
    from bson.reporting.heatmap import Scale, Tile, cell_maps
    from bson.reporting.page import render

    found, known = _loaded(results), {one.name: one for one in METRICS}
    cells = found.content["cells"]
    if metric not in known:
        raise UsageError(f"Unknown metric '{metric}'. Choose one of {', '.join(known)}.")
    if len(cells) < 2:
        raise UsageError(
            f"The results of '{found.agent}' on '{found.suite}' have one cell only: there is nothing to map."
        )
    tiles = [
        Tile(cell["grades"], cell["summary"].get(metric), *cell["intervals"].get(metric, (None, None)))
        for cell in cells
    ]
    values = [end for tile in tiles if tile.value is not None for end in (tile.low, tile.high) if end is not None]
    share = known[metric].unit == "share" or metric in ("RC", "SP", "PE", "SPL")
    most = 100.0 if metric == "SNS" else 1.0 if share else max([*values, 1e-9])
    scale = Scale(min([0.0, *values]), max([most, *values]), known[metric].better or "up")
    drawn = cell_maps(tiles, scale, metric, f"{known[metric].unit} {known[metric].better}".strip())
    title = f"{metric} of {found.agent} on {found.suite}"
    page = render("cells.html", title=title, what=known[metric].what, axes=len(cells[0]["grades"]), map=drawn)
    if out is not None:
        write_bytes(check_file(out), page.encode())
    return page


def leaderboard(
    results: Sequence[Results | str | pathlib.Path],
    readme: str | pathlib.Path | None = None,
    *,
    out: str | pathlib.Path | None = None,
    everything: bool = False,
    told: Callable[[str], object] = lambda line: None,
) -> str:
    """Results as Markdown tables, sorted by SNS, as `bson leaderboard` does.

    results: Results that were read from files, or these folders or files. readme: a file that gets the tables too,
    between its marks. out: folder for board.json and board.html, of the results that `verify` found equal; everything:
    also of the others, marked. told: called with a line for each that is left out or marked. Raises ValueError where
    results of one suite have different episodes.
    """
    from bson.reporting.board import publish
    from bson.reporting.leaderboard import fill_readme, filled_readme, leaderboard

    found = [_loaded(each) for each in results]
    text = leaderboard(found)
    if readme is not None:
        filled_readme(readme, text)  # raises before anything is written
    if out is not None:
        for line in publish(found, out, everything):
            told(line)
    if readme is not None:
        fill_readme(readme, text)
    return text
