"""A pedestrian model measured against real people: every measure on its own, with its interval over seeds."""

import dataclasses
import pathlib
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from macid import traits
from macid.evaluate import lcf_bins, table_lcf, usual_period
from macid.files import UsageError, check_folder, new_folder, versions, write_json
from macid.geometry import Array
from macid.human import data, figures, flows, knob, replay
from macid.human.data import Walks
from macid.human.replay import Scene
from macid.human.stage import Body
from macid.pedestrians import Controller, is_learned, make_controller
from macid.policy import policy_names
from macid.scene import check_radius
from macid.state import MAX_LCF, MAX_SPEED, RADIUS, TOP_SPEED, CrowdState

RESULTS = "measured.json"
PAGE = "index.html"
FILM = "film.webm"
PARTS = ("open", "flows", "knob")
_CONFIDENCE = 0.95


@dataclasses.dataclass(frozen=True)
class Options:
    """How a model is measured.

    radius [m], preferred_speed, max_speed [m/s], lcf and period [s]: None for those that a learned model was trained
    with, as its card has them. For rules, and where it has none, they are the paper's radius and speeds, Table II's
    LCFs, and a decision every physics step. preferred_speed: as of macid.crowd.CrowdConfig. matched: everybody
    walks at its real one's mean speed, in open scenes. seeds: of a learned method the first policies, `name-0` and so
    on; else of chance. only: one of PARTS.
    """

    radius: float | None = None
    preferred_speed: traits.PreferredSpeed = None
    max_speed: float | None = None
    lcf: tuple[float, float] | None = None
    period: float | None = None
    matched: bool = False
    seeds: int = 3
    engine: str = "native"
    only: str | None = None

    def __post_init__(self):
        if self.radius is not None:
            check_radius("--radius", self.radius)
        if self.max_speed is not None:
            traits.check_max_speed(self.max_speed, "--max-speed")
        traits.check_preferred_speed(self.preferred_speed, "--preferred-speed")
        if self.lcf is not None and not -MAX_LCF <= self.lcf[0] <= self.lcf[1] <= MAX_LCF:
            raise UsageError(f"--lcf must be a range (least, most) in [-{MAX_LCF:g}, {MAX_LCF:g}], not {self.lcf}.")


class Troupe:
    """Several controllers as one: of a batch's worlds, each has as many, the first has the first."""

    def __init__(self, controllers: list[Controller]):
        self._controllers = controllers

    def __call__(self, state: CrowdState, boxes: Array, goals: Array, lcf: Array) -> Array:
        """As macid.pedestrians.Controller, with one leading axis of worlds."""
        first = self._controllers[0]
        if all(each is first for each in self._controllers):
            return first(state, boxes, goals, lcf)
        each = goals.shape[0] // len(self._controllers)
        commands = []
        for number, controller in enumerate(self._controllers):
            rows = slice(number * each, (number + 1) * each)
            commands.append(
                controller(jax.tree.map(lambda a, rows=rows: a[rows], state), boxes, goals[rows], lcf[rows])
            )
        return jnp.concatenate(commands)


def has_lcf(pedestrian: str) -> bool:
    """Whether `pedestrian` is a learned model that was trained with a range of LCFs."""
    if not is_learned(pedestrian):
        return False
    try:
        return bool(lcf_bins(pedestrian))
    except ValueError:
        return False


def is_recording(name: str) -> bool:
    """Whether `name` is a file of people's walks, not a model."""
    return pathlib.Path(name).suffix.lower() in data.ENDINGS


def troupe(pedestrian: str, seeds: int) -> list[str]:
    """The models that stand for `pedestrian`, one a seed: a learned method's policies of its first seeds, else the same
    each time. Raises UsageError where a method has fewer."""
    shipped = policy_names()
    own = [name for name in shipped if name.rpartition("-")[0] == pedestrian]
    if pedestrian in shipped or not own:
        return [pedestrian] * seeds
    if seeds > len(own):
        raise UsageError(f"--seeds: '{pedestrian}' has {len(own)} policies, not {seeds}.")
    return sorted(own, key=lambda name: int(name.rpartition("-")[2]))[:seeds]


def measure(
    pedestrian: str,
    folder: str | pathlib.Path | None = None,
    options: Options = Options(),
    out: str | pathlib.Path | None = None,
    page: bool = True,
    show: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Measures `pedestrian`: a rule, a shipped policy or method, a policy file (.npz), one's own model, or a file of
    people's walks, which goes through the same code.

    folder: people's files; None: flows alone, beside the figures of people that are shipped. out: a folder for
    measured.json, index.html and, where open scenes are replayed, film.webm; None: nothing is written. Raises
    UsageError.
    """
    begun = time.monotonic()
    if out is not None:
        check_folder(out)
    if options.only == "open" and folder is None and not is_recording(pedestrian):
        raise UsageError("--only open needs --data: people's files, whose open scenes are replayed.")
    walks = [] if folder is None else list(data.load_all(folder))
    if is_recording(pedestrian):
        played, scenes, values, curves, told = _recording(pedestrian)
    else:
        played, scenes, values, curves, told = _model(pedestrian, walks, options, show)
    known = figures.shipped()
    people = known if not walks or same_files(walks, known) else figures.people(walks)
    document = {
        "pedestrian": pathlib.Path(pedestrian).stem if is_recording(pedestrian) else pedestrian,
        **told,
        "data": [walk.name for walk in walks],
        "people_from": "shipped figures" if people is known else "these files",
        "measures": summary(values, people, known),
        "curves": {"model": curves, "people": {**known["curves"], **people["curves"]}},
        "seconds": round(time.monotonic() - begun, 1),
        "versions": versions("mujoco", "jax", "numpy"),
    }
    if out is not None:
        from macid.human import film as films
        from macid.human import page as pages

        with new_folder(out) as target:
            film = None
            if page and scenes:
                film = target / FILM
                show(f"film: {film}")
                films.film(film, scenes, played[0], document["pedestrian"], document.get("radius", films.BODY))
            write_json(target / RESULTS, document)
            if page:
                pages.write(target / PAGE, document, film)
    return document


def same_files(walks: list[Walks], known: dict[str, Any]) -> bool:
    """Whether `walks` are of just the files that the figures `known` were made from."""
    return {walk.name for walk in walks} == {each["name"] for each in known["files"]} and all(w.known for w in walks)


def _recording(path):
    """What _model gives, of a file of walks."""
    walk = data.load(path)
    if walk.scene == "open":
        scenes = [Scene(walk)]
        played = replay.as_they_were(scenes)
        values, curves = figures.open_figures(scenes, played, real=played)
        return [played], scenes, [values], curves, {}
    values, curves = figures.lab_figures([walk])
    return [], [], [values], curves, {}


def _model(pedestrian, walks, options, show):
    """([Played of each seed], scenes, [values of each seed], curves, what to tell) of a model."""
    names = troupe(pedestrian, options.seeds)
    if options.only == "knob" and not has_lcf(names[0]):
        raise UsageError(f"--only knob: '{pedestrian}' has no LCF that does anything.")
    period = usual_period(names[0]) if options.period is None else options.period
    made = {name: make_controller(name, period) for name in dict.fromkeys(names)}
    recipe = getattr(getattr(made[names[0]], "policy", None), "recipe", {})

    def usual(field, otherwise):
        given = getattr(options, field)
        return given if given is not None else recipe.get(field, otherwise)

    wanted = traits.check_preferred_speed(usual("preferred_speed", None))
    least, most = options.lcf or table_lcf(names[0])
    body = Body(usual("radius", RADIUS), usual("max_speed", MAX_SPEED), (least, most))
    told = {
        "policies": names if len(made) > 1 else names[:1],
        "period": period,
        "radius": body.radius,
        "preferred_speed": wanted,
        "max_speed": body.max_speed,
        "lcf": list(body.lcf) if is_learned(names[0]) else None,
        "matched": options.matched,
        "seeds": options.seeds,
    }
    controller = Troupe([made[name] for name in names])
    scenes = [Scene(walk) for walk in walks if walk.scene == "open"] if options.only in (None, "open") else []
    seeds = list(range(options.seeds))
    values, curves, played = [{} for _ in seeds], {}, []
    if scenes:
        played = _open(pedestrian, scenes, controller, names, made, period, body, wanted, options, show)
        real = replay.as_they_were(scenes)
        found = [figures.open_figures(scenes, each, real=real) for each in played]
        if len(found) == 1:
            told["open_seeds"] = 1  # nothing in it is left to chance
        for index in range(len(found)):
            values[index] |= found[index][0]
        curves |= _mean_curves([each for _, each in found])
    if options.only == "open":
        return played, scenes, values, curves, told

    def drawn(rng, number):
        return traits.draw_preferred_speed(rng, wanted, number)

    if options.only != "flows" and has_lcf(names[0]):
        told["knob"] = knob.knob(controller, period, body, seeds, drawn, options.engine, show)
    if options.only == "knob":
        return played, scenes, values, curves, told
    for index, run in enumerate(flows.flows(controller, period, body, seeds, drawn, options.engine, show)):
        values[index] |= run.values
        curves.setdefault("diagram", []).extend(run.curves["diagram"])
    return played, scenes, values, curves, told


def _open(pedestrian, scenes, controller, names, made, period, body, wanted, options, show):
    """Open scenes as each seed plays them."""
    speeds = []
    for seed in range(options.seeds):
        rng = np.random.default_rng((seed, 0x0BE))
        if options.matched:
            speeds.append([np.nan_to_num(scene.person.speed, nan=1.0) for scene in scenes])
        else:
            drawn = [traits.draw_preferred_speed(rng, wanted, len(scene.first)) for scene in scenes]
            # Companions want to walk at one speed.
            together = [None if d is None else d[scene.group] for d, scene in zip(drawn, scenes, strict=True)]
            speeds.append(together)
    if not is_learned(names[0]) and (options.matched or wanted is None or isinstance(wanted, float)):
        speeds, controller = speeds[:1], made[names[0]]
    if options.matched:  # some real people walk faster than the paper's
        body = dataclasses.replace(body, max_speed=max(body.max_speed, TOP_SPEED))
        speeds = [[np.clip(each, traits.LEAST_SPEED, TOP_SPEED) for each in scene] for scene in speeds]
    rng = np.random.default_rng((0, 0x0BE))
    return replay.play(scenes, controller, period, body, rng, speeds, options.engine, show)


def _mean_curves(curves):
    """The curves of open scenes, means over seeds."""
    energy = np.array([[row[1] if row[1] is not None else np.nan for row in each["E"]] for each in curves])
    shares = np.mean([each["speeds"]["share"] for each in curves], axis=0)
    taus = [row[0] for row in curves[0]["E"]]
    return {
        "E": [[tau, figures.rounded(each)] for tau, each in zip(taus, _finite_mean(energy), strict=True)],
        "speeds": {"edges": curves[0]["speeds"]["edges"], "share": shares.round(4).tolist()},
    }


def _finite_mean(values):
    """Means over the first axis, NaN where any value is none."""
    return np.where(np.isfinite(values).all(axis=0), values.mean(axis=0), np.nan)


def interval(values: list[float]) -> tuple[float, float] | None:
    """Student's interval of the mean of `values`, one a seed; None of fewer than two."""
    from scipy import stats

    if len(values) < 2:
        return None
    half = stats.t.ppf((1 + _CONFIDENCE) / 2, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values))
    return float(np.mean(values) - half), float(np.mean(values) + half)


def summary(values: list[dict[str, float]], people: dict[str, Any], otherwise: dict[str, Any]) -> dict[str, Any]:
    """{key of a measure: its row}, from each seed's `values` and the figures of `people`, or `otherwise` where these
    lack a measure. A measure that has no value for a seed, such as a speed at a density at which bodies have no room,
    has that seed's None."""
    rows = {}
    for each in figures.MEASURES:
        found = [figures.rounded(seed.get(each.key, np.nan)) for seed in values]
        known = people["measures"].get(each.key) or otherwise["measures"].get(each.key, {})
        numbers = [number for number in found if number is not None]
        if not numbers and each.group == "open" and not any(each.key in seed for seed in values):
            found, numbers = [], []
        between = interval(numbers)
        rows[each.key] = {
            "title": each.title,
            "unit": each.unit,
            "group": each.group,
            "people": known.get("people"),
            "halves": known.get("halves", [None, None]),
            "model": figures.rounded(float(np.mean(numbers))) if numbers else None,
            "interval": None if between is None else [figures.rounded(end) for end in between],
            "seeds": found,
        }
    return rows


def knob_lines(document: dict[str, Any]) -> list[str]:
    """What the LCF does, as lines of plain text: none for a model without LCFs."""
    if "knob" not in document:
        return []
    found, lines = document["knob"], []
    for name, title in (("touch", "share of time touching [%]"), ("way", "share of the sidestep")):
        for where in knob.WHERE:
            means = _finite_mean(np.array(found[name][where], dtype=float))
            ranks = ", ".join("-" if rank is None else f"{rank:.2f}" for rank in found[f"{name}_rank"][where])
            steps = ", ".join("-" if np.isnan(mean) else f"{mean:.2f}" for mean in means)
            lines.append(
                f"LCF {knob.LCFS[0]:g} to {knob.LCFS[-1]:g}, {where}: {title} {steps}; rank correlation {ranks}"
            )
    return lines


def table(document: dict[str, Any]) -> str:
    """The rows of a document of `measure` as plain text."""
    lines = [f"{'measure':<58}{'people':>9}{'halves apart':>14}{'model':>9}  {'95%':<18}"]
    digits = {each.key: each.digits for each in figures.MEASURES}
    for key, row in document["measures"].items():
        cells = [row["people"], None, row["model"]]
        if None not in row["halves"]:
            cells[1] = abs(row["halves"][0] - row["halves"][1])
        shown = ["-" if cell is None else f"{cell:.{digits[key]}f}" for cell in cells]
        between = "" if row["interval"] is None else "{:.{d}f} to {:.{d}f}".format(*row["interval"], d=digits[key])
        title = row["title"] + (f" [{row['unit']}]" if row["unit"] else "")
        lines.append(f"{title:<58}{shown[0]:>9}{shown[1]:>14}{shown[2]:>9}  {between:<18}".rstrip())
    return "\n".join([*lines, *knob_lines(document)])
