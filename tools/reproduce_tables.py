"""Tables I and II and Fig. 2 of the paper from trained policies: evaluates what is missing, and writes them beside the
paper's figures.

    tools/reproduce_tables.py --policies assets/policies --out tables

Writes OUT/table1.md, table2.md, figure2.png, figure2.csv; each evaluation is kept in OUT/rows, so that a stopped run goes
on where it was. A method's figures are the mean over its seeds and their standard deviation.
"""

import argparse
import json
import pathlib
import sys

import numpy as np

from macid.crowd import CrowdConfig
from macid.evaluate import TOLERATED, evaluate_level, lcf_bins, table_lcf
from macid.files import UsageError, output_folder, run_command, write_bytes, write_json
from macid.layout import LEVELS
from macid.learning.methods import METHODS

COLUMNS = ("SR10", "CP", "PE")
RULES = ("social-force", "social-force-bodies", "orca")

# The paper's tables: SR10, CP, PE on Lv.1, Lv.2, Lv.3, Lv.4.
PAPER_TABLE_2 = {
    "social-force": (38.4, 13.3, 76.3, 19.2, 73.8, 77.3, 8.2, 86.5, 71.8, 2.7, 128.4, 54.4),
    "ipo": (69.6, 10.1, 93.7, 53.7, 21.0, 92.4, 34.8, 31.1, 89.2, 12.9, 75.8, 83.1),
    "mfpo": (71.3, 12.8, 93.8, 49.5, 25.9, 92.6, 29.5, 40.7, 89.6, 10.5, 90.2, 83.7),
    "copo": (69.1, 8.8, 93.9, 50.4, 20.6, 92.9, 29.8, 31.7, 89.3, 10.4, 76.1, 83.6),
    "macid-tri": (79.0, 3.4, 92.0, 68.0, 10.0, 89.9, 48.5, 12.2, 84.1, 20.3, 47.1, 76.0),
    "macid": (76.9, 5.1, 94.6, 64.5, 12.3, 92.9, 43.7, 18.6, 89.1, 17.2, 53.7, 81.4),
}
PAPER_TABLE_1 = (
    (58.7, 38.7, 93.3, 40.9, 57.9, 91.1, 19.5, 83.2, 85.3, 4.6, 157.8, 76.4),
    (67.4, 24.2, 94.2, 46.9, 40.7, 92.6, 26.5, 56.7, 88.4, 6.6, 119.8, 81.0),
    (72.6, 15.7, 94.9, 55.1, 22.4, 93.4, 31.7, 38.0, 89.8, 9.3, 90.0, 82.7),
    (75.8, 10.1, 95.3, 58.4, 16.2, 93.5, 38.8, 23.8, 89.9, 13.4, 67.3, 82.9),
    (76.0, 7.1, 94.6, 62.5, 10.4, 92.9, 43.4, 19.3, 89.1, 16.8, 55.0, 81.6),
    (76.7, 4.0, 93.7, 63.8, 8.9, 91.1, 46.3, 15.0, 86.6, 18.8, 49.7, 78.2),
)


def find_policies(folder):
    """{method: [policy files]} of a folder, read from the recipes, in the order of their seeds."""
    found = {}
    for file in sorted(pathlib.Path(folder).rglob("*.npz")):
        recipe = json.loads(file.with_suffix(".json").read_text())
        found.setdefault(recipe["method"], []).append((recipe["seed"], str(file)))
    return {method: [file for _, file in sorted(found[method])] for method in METHODS if method in found}


def evaluated(rows, name, pedestrian, level, lcf, episodes, period):
    """A row of `evaluate_level`, from the folder `rows` if it is there."""
    path = rows / f"{name}-lv{level}-({lcf[0]:.2f},{lcf[1]:.2f}).json"
    if path.exists():
        return json.loads(path.read_text())
    print(f"{name} on Lv.{level}, LCF ({lcf[0]:.2f}, {lcf[1]:.2f})", file=sys.stderr, flush=True)
    row = evaluate_level(pedestrian, level, episodes, config=CrowdConfig(period=period, lcf=lcf))
    write_json(path, row)
    return row


def over_seeds(rows_by_seed):
    """Mean over seeds of every column on every level (levels * columns,), and the standard deviation; None of one."""
    values = np.array(
        [[row[c] if row[c] is not None else np.nan for row in rows for c in COLUMNS] for rows in rows_by_seed]
    )
    return np.nanmean(values, axis=0), np.nanstd(values, axis=0) if len(values) > 1 else None


def line(label, mean, std=None):
    """A row of a Markdown table."""
    cells = [f"{m:.1f}" if std is None else f"{m:.1f} ± {s:.1f}" for m, s in zip(mean, mean if std is None else std)]
    return f"| {label} | " + " | ".join(cells) + " |"


def header(first):
    """The two header lines of a Markdown table."""
    names = [f"Lv.{level} {column}" for level in LEVELS for column in COLUMNS]
    return [f"| {first} | " + " | ".join(names) + " |", "|---" * (1 + len(names)) + "|"]


def spearman(values):
    """Rank correlation of `values` with their order."""
    ranks = np.argsort(np.argsort(values))
    return float(np.corrcoef(np.arange(len(values)), ranks)[0, 1])


def plot(curves, path):
    """Fig. 2: SR_n against n, a panel a level; curves {name: (levels, TOLERATED)}."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    for index, (axes, level) in enumerate(zip(figure.subplots(1, len(LEVELS)), LEVELS, strict=True)):
        for name, curve in curves.items():
            style = {"linewidth": 2.6} if name.startswith("macid") else {"linewidth": 1.4, "alpha": 0.85}
            axes.plot(np.arange(1, TOLERATED + 1), curve[index], label=name, **style)
        axes.set_title(f"Lv.{level}")
        axes.set_xlabel("n")
        axes.set_ylim(0, 100)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("SR$_n$ [%]")
    figure.axes[-1].legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(path, dpi=130)


def run(args):
    """Makes the tables; returns the exit code."""
    policies = find_policies(args.policies)
    if not policies:
        raise UsageError(f"No policies in '{args.policies}'. Train some: macid train --method macid --out runs.")
    out = output_folder(args.out)
    rows = output_folder(out / "rows")

    table, curves = header("model"), {}
    models = {**{rule: [rule] for rule in RULES}, **policies}
    for name, files in models.items():
        seeds = [
            [
                evaluated(rows, f"{name}-{index}", file, level, table_lcf(file), args.episodes, args.period)
                for level in LEVELS
            ]
            for index, file in enumerate(files)
        ]
        mean, std = over_seeds(seeds)
        label = f"{name} ({len(files)} seed{'s' if len(files) > 1 else ''})" if name in policies else name
        table.append(line(label, mean, std))
        if name in PAPER_TABLE_2:
            table.append(line("*paper*", PAPER_TABLE_2[name]))
        curves[name] = np.mean([[row["SR"] for row in levels] for levels in seeds], axis=0)
    write_bytes(out / "table2.md", ("\n".join(table) + "\n").encode())
    lines = ["model,level,n,SR_n"]
    for name, curve in curves.items():
        for level, values in zip(LEVELS, curve, strict=True):
            lines += [f"{name},{level},{n},{value:.3f}" for n, value in enumerate(values, start=1)]
    write_bytes(out / "figure2.csv", ("\n".join(lines) + "\n").encode())
    plot(curves, out / "figure2.png")
    print("\n".join(table))

    sections = []
    for method in ("macid", "macid-tri"):
        if method not in policies or args.skip_table_1:
            continue
        table, means = header(f"{method}: LCF"), []
        for number, lcf in enumerate(lcf_bins(policies[method][0])):
            seeds = [
                [evaluated(rows, f"{method}-{i}", file, level, lcf, args.episodes, args.period) for level in LEVELS]
                for i, file in enumerate(policies[method])
            ]
            mean, std = over_seeds(seeds)
            means.append(mean)
            table.append(line(f"({lcf[0]:.2f}, {lcf[1]:.2f})", mean, std))
            if method == "macid":
                table.append(line("*paper*", PAPER_TABLE_1[number]))
        table.append(line("rank correlation with the LCF", [spearman(column) for column in np.array(means).T]))
        sections.append("\n".join(table))
    if sections:
        write_bytes(out / "table1.md", ("\n\n".join(sections) + "\n").encode())
        print("\n" + "\n\n".join(sections))
    return 0


def main():
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policies", default="assets/policies", help="folder with .npz and .json files")
    parser.add_argument("--episodes", type=int, default=5, help="a level and seed")
    parser.add_argument("--period", type=float, default=0.02, help="between decisions [s]")
    parser.add_argument("--skip-table-1", action="store_true", help="only Table II and Fig. 2")
    parser.add_argument("--out", default="tables")
    args = parser.parse_args()
    return run_command("reproduce_tables", lambda: run(args))


if __name__ == "__main__":
    sys.exit(main())
