"""The leaderboard: results of `bson evaluate` as Markdown tables, one a suite, sorted by SNS, in a README or alone."""

import pathlib
import shlex
from collections.abc import Sequence

from bson.evaluation.results import Results
from bson.reporting.compare import check_comparable, check_different
from bson.reporting.page import plural
from macid.documents import read_bytes
from macid.files import UsageError, check_file, named, write_bytes

BEGIN, END = "<!-- leaderboard -->", "<!-- /leaderboard -->"
_MOST_BYTES = 1 << 26  # of a README
COLUMNS = (  # after the SNS: metric, heading, format of a mean
    ("success", "success", "{:.0%}"),
    ("Coll", "Coll", "{:.1f}"),
    ("SP", "SP", "{:.3f}"),
    ("PE", "PE", "{:.3f}"),
    ("RC", "RC", "{:.3f}"),
    ("personal_space", "personal space", "{:.3f}"),
)


def played(run: Results) -> set[tuple[str, int]]:
    """(cell, seed) of all episodes that the run played, the faulty ones included."""
    return run.rows.keys() | {(fault["cell"], fault["seed"]) for fault in run.content.get("faults", [])}


def _check(runs):
    """Raises ValueError unless all `runs` of a suite have the same version, setting and episodes."""
    check_comparable(runs)
    check_different(runs)
    for run in runs[1:]:
        if played(run) != played(runs[0]):
            raise ValueError(
                f"'{runs[0].source}' and '{run.source}' didn't play the same episodes of '{run.content['suite']}' "
                f"({len(played(runs[0]))} and {len(played(run))}). Evaluate with the same --episodes and --seed."
            )


def _plain(text):
    """`text` as Markdown that shows it unchanged: characters with a meaning in HTML or Markdown are written as
    numbers."""
    return "".join(f"&#{ord(c)};" if c in "<>&`|*_~[]\\" else c for c in text)


def _code(text):
    """`text` as code in Markdown, also where it has characters that would end the code, or one of the marks BEGIN and
    END."""
    return f"<code>{_plain(text)}</code>" if "`" in text or "<" in text else f"`{text}`"


def _row(rank, run):
    content = run.content
    agent, summary = _code(content["agent"]).replace("|", "\\|"), content["summary"]
    faults = f" ({len(content['faults'])} faulty)" if content.get("faults") else ""
    score = "-"
    if "SNS" in summary:
        low, high = content["intervals"]["SNS"]
        score = f"{summary['SNS']:.1f} [{low:.1f}, {high:.1f}]"
    values = [form.format(summary[name]) if name in summary else "-" for name, _, form in COLUMNS]
    return [str(rank), f"{agent}{faults}", _plain(", ".join(content.get("track") or ["-"])), score, *values]


def _caption(run):
    content, episodes = run.content, len(played(run))
    digest = f", digest {_code(content['suite_digest'])}" if content.get("suite_digest") else ""
    cells = f" in {len(content['cells'])} cells" if len(content["cells"]) > 1 else ""
    seeds = len({seed for _, seed in played(run)})
    drawn = f", which draw the {seeds} seeds, each with all of its episodes" if seeds < episodes else ""
    other = "" if content.get("frozen_seeds", True) else ", not the suite's own seeds"
    words = ["bson", "evaluate", "--agent", "AGENT", "--suite", content["suite"]]
    words += ["--episodes", str(episodes // len(content["cells"]))]
    for key, value in content.get("overrides", {}).items():
        words += ["--set", f"{key}={value}"]
    return (
        f"Suite {_code(content['suite'])}{digest}: {plural(episodes, 'episode')}{cells}{other}; means, with bootstrap "
        f"95% intervals for the SNS{drawn}.\nEach row: {_code(shlex.join(words))}; the table: `bson leaderboard`."
    )


def by_suite(runs: Sequence[Results]) -> list[list[Results]]:
    """The `runs` of each suite, the best SNS first. Raises ValueError where runs of one suite differ in its version,
    setting or episodes."""
    suites = {}
    for run in runs:
        suites.setdefault(run.content["suite"], []).append(run)
    for group in suites.values():
        _check(group)
        group.sort(key=lambda run: (-run.content["summary"].get("SNS", -float("inf")), run.source))
    return list(suites.values())


def leaderboard(runs: Sequence[Results]) -> str:
    """Markdown: a table for each suite of `runs`, the best SNS first, with a line on the suite.

    Raises ValueError where runs of one suite differ in its version, setting or episodes.
    """
    tables = []
    for ranked in by_suite(runs):
        lines = [["rank", "agent", "track, sensor", "SNS", *(heading for _, heading, _ in COLUMNS)]]
        lines.append(["---"] * len(lines[0]))
        lines += [_row(rank, run) for rank, run in enumerate(ranked, start=1)]
        table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
        tables.append(f"{table}\n\n{_caption(ranked[0])}")
    return "\n\n".join(tables)


def filled_readme(path: str | pathlib.Path, text: str) -> bytes:
    """The content of the file `path` with `text` between its marks BEGIN and END. Raises ValueError."""
    path, wanted = check_file(path), f"Name a text file with {BEGIN} and {END}."
    try:
        content = read_bytes(path, "README", _MOST_BYTES).decode()
    except UnicodeDecodeError:
        raise UsageError(f"{named(path)} is no text in UTF-8. {wanted}") from None
    except UsageError as error:
        raise UsageError(f"{error} {wanted}") from None
    before, begin, rest = content.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end or content.count(BEGIN) != 1 or content.count(END) != 1:
        raise ValueError(f"'{path}' must have the lines {BEGIN} and {END}, once each and in this order.")
    newline = "\r\n" if "\r\n" in content else "\n"
    table = f"{BEGIN}\n{text}\n{END}".replace("\n", newline)
    return f"{before}{table}{after}".encode()


def fill_readme(path: str | pathlib.Path, text: str) -> None:
    """Puts `text` between the marks BEGIN and END of the file `path`, all or nothing. Raises ValueError."""
    write_bytes(path, filled_readme(path, text))
