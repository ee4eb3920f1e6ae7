"""Writes the frozen levels that are drawn from seeds to assets/layouts: the paper's four (Fig. 1, sec. IV-A), lv1 to
lv4, the four for validation, v1 to v4, and three of other kinds. (foyer, crossroads and furnished were drawn by
hand.)"""

import pathlib

import numpy as np

from macid import layout

PEOPLE = {1: 25, 2: 50, 3: 100, 4: 200}
OBSTACLES = 20
FOLDER = pathlib.Path(__file__).resolve().parent.parent / "assets" / "layouts"


def main():
    """Writes all of them."""
    for level, people in PEOPLE.items():
        write(f"lv{level}", f"Lv.{level}", level, people)
        write(f"v{level}", f"validation {level}", 100 + level, people)
    write("big-boxes", "big boxes", 201, 50, 9, half=(2.5, 5.0))
    write("small-boxes", "small boxes", 202, 50, 120, half=(0.15, 0.5))
    write("crowded", "crowded", 203, 80, 4, size=24.0)


def write(file, name, seed, people, obstacles=OBSTACLES, **shape):
    """Draws a level from `seed`, with `obstacles` boxes, and writes it to `file`.toml."""
    drawn = layout.random_layout(np.random.default_rng(seed), obstacles, **shape)
    rows = "\n".join(f"    [{', '.join(f'{value:.3f}' for value in row)}]," for row in drawn.obstacles)
    text = (
        f"# Made by tools/make_levels.py from seed {seed}. Rows: x, y, half_x, half_y [m], yaw [rad].\n"
        f'name = "{name}"\nsize = {drawn.size}\npedestrians = {people}\nobstacles = [\n{rows}\n]\n'
    )
    (FOLDER / f"{file}.toml").write_text(text)
    print(f"{file}.toml: {people} people, {obstacles} obstacles")


if __name__ == "__main__":
    main()
