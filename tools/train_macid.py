"""The MJX training script: `macid train` without an installed package. Needs jax, optax, mujoco and mujoco-mjx only."""

import pathlib
import sys

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent))

from macid.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
