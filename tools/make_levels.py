"""Writes the four frozen levels of the paper (Fig. 1, sec. IV-A), lv1 to lv4, and the four for validation, v1 to v4, to
assets/layouts, each from its seed."""

import pathlib

import numpy as np

from macid import layout

PEOPLE = {1: 25, 2: 50, 3: 100, 4: 200}
OBSTACLES = 20
FOLDER = pathlib.Path(__file__).resolve().parent.parent / "assets" / "layouts"


def main():
    for level, people in PEOPLE.items():
        write(f"lv{level}", f"Lv.{level}", level, people)
        write(f"v{level}", f"validation {level}", 100 + level, people)


def write(file, name, seed, people):
    """Draws a level from `seed` and writes it to `file`.toml."""
    drawn = layout.random_layout(np.random.default_rng(seed), OBSTACLES)
    rows = "\n".join(f"    [{', '.join(f'{value:.3f}' for value in row)}]," for row in drawn.obstacles)
    text = (
        f"# Made by tools/make_levels.py from seed {seed}. Rows: x, y, half_x, half_y [m], yaw [rad].\n"
        f'name = "{name}"\nsize = {drawn.size}\npedestrians = {people}\nobstacles = [\n{rows}\n]\n'
    )
    (FOLDER / f"{file}.toml").write_text(text)
    print(f"{file}.toml: {people} people, {OBSTACLES} obstacles")


if __name__ == "__main__":
    main()
