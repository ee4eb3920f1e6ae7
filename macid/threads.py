"""How many threads MuJoCo's batches take."""

import os

VARIABLE = "BSON_THREADS"


def physics_threads() -> int:
    """Threads of a MuJoCo batch that is told no number: what the environment variable BSON_THREADS says, else 0, which
    is MuJoCo's own choice, one a core. Results are the same with any number. Raises ValueError for what is no
    number."""
    text = os.environ.get(VARIABLE, "0")
    if not text.isdecimal() or int(text) > 1024:
        raise ValueError(f"{VARIABLE} must be a whole number from 0 (one a core) to 1024, not '{text[:100]}'.")
    return int(text)
