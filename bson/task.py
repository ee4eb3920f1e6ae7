"""The robot's task among people: its configuration, and the spawning of an episode."""

import dataclasses
import functools
from typing import Any, NamedTuple, Self

import numpy as np

from bson.robot import RobotConfig, robot_config
from macid import layout as layouts
from macid import pedestrians, traits
from macid.documents import is_number, shown
from macid.layout import GOAL_DISTANCE, MAP_SIZE, Layout, NoFreeSpace
from macid.maps import load_map
from macid.reward import RewardWeights
from macid.routing import Router, refuse_blocked_routes, rest_of_route
from macid.scene import check_radius
from macid.state import MAX_LCF, MAX_SPEED, PAPER_TRAITS, PHYSICS_STEP, RADIUS, Traits

PEDESTRIANS = 24  # the paper's number, sec. VI-D
MAX_PEDESTRIANS = 2000
MAX_HORIZON = 10**9  # [control steps]
_START_CLEARANCE = 1.0  # between the robot and people at the start, surface to surface [m]
_REWARD = RewardWeights(distance=1.0, goal=2.0, collision=1.0)
_ROBOT: Any = "jackal"  # a name; a TaskConfig makes a RobotConfig of it
_ROUTE_WIDTH = 2.0  # of the strip along a route in which people begin [m]
_GOAL_CLEARANCE = 0.5  # of the robot's start and goal from obstacles [m]


@dataclasses.dataclass(frozen=True)
class TaskConfig:
    """An episode's setting. Lengths in metres, times in seconds. The defaults are the paper's (sec. VI-D).

    The number of pedestrians is `num_pedestrians`, or `pedestrian_density` as a share of 0.08 persons/m2 (give one of
    the two; with neither, 24).

    person_radius to companions say what people are like: see macid.scene.PersonConfig and macid.crowd.CrowdConfig.
    Whatever the people's radius, they take the robot for a disc of the paper's, 0.35 m.
    """

    num_pedestrians: int | None = None
    pedestrian_density: float | None = None  # in [0, 1]
    obstacle_density: float = 0.0  # in [0, 1]: share of a maze's walls that stand
    pedestrian_model: str | tuple = "macid"  # or {name: share}: each pedestrian's model is drawn by these shares
    lcf: tuple[float, float] = (-2.0, 2.0)  # a number, or the range from which each pedestrian's LCF is drawn
    lcf_each: tuple[float, ...] | None = None  # one LCF for each pedestrian, in place of lcf
    map_size: float = MAP_SIZE
    map: str | None = None  # a map's name or file (macid.maps), in place of a maze; it has its own size
    control_period: float = 0.1  # between two decisions of the robot
    pedestrian_period: float = 0.1  # between two decisions of the pedestrians; at most the control period
    horizon: int = 1000  # control steps until truncation
    goal_distance: tuple[float, float] = (15.0, 40.0)  # from the robot's start to its goal, as the crow flies
    reward: RewardWeights = _REWARD
    robot: RobotConfig = _ROBOT  # or a name or file (bson.robot), or a dict of changed numbers
    person_radius: float = RADIUS  # of every pedestrian
    preferred_speed: Any = None  # of pedestrians [m/s]: a number, (least, most), "human"; None: each model's own
    person_max_speed: float = MAX_SPEED  # of pedestrians [m/s]
    companions: float | None = None  # share of pedestrians who walk in twos and threes; None: everybody walks alone

    def __post_init__(self):
        object.__setattr__(self, "lcf", _pair("lcf", self.lcf))
        if max(map(abs, self.lcf)) > MAX_LCF:
            raise ValueError(f"lcf must lie in [-{MAX_LCF:g}, {MAX_LCF:g}], not {self.lcf}.")
        object.__setattr__(self, "goal_distance", _pair("goal_distance", self.goal_distance))
        if self.num_pedestrians is not None and self.pedestrian_density is not None:
            raise ValueError("Give num_pedestrians or pedestrian_density, not both.")
        if self.map is not None:
            if not isinstance(self.map, str):
                raise ValueError(f"map must be a name or a file, not {shown(self.map)}.")
            if self.obstacle_density:
                raise ValueError(f"Map '{self.map}' has its own obstacles: leave obstacle_density at 0.")
            size = load_map(self.map).size
            if self.map_size not in (size, MAP_SIZE):
                raise ValueError(f"Map '{self.map}' has a size of its own, {size:g} m: leave map_size out.")
            object.__setattr__(self, "map_size", size)
        count = self.num_pedestrians
        if count is not None and not (_is_whole(count) and 0 <= count <= MAX_PEDESTRIANS):
            raise ValueError(
                f"num_pedestrians must be a whole number of at least 0, at most {MAX_PEDESTRIANS}, not {shown(count)}."
            )
        for name in ("pedestrian_density", "obstacle_density"):
            value = getattr(self, name)
            if value is None and name == "pedestrian_density":
                continue
            if value is None or not (is_number(value) and 0 <= value <= 1):
                raise ValueError(f"{name} must be between 0 and 1, not {shown(value)}.")
        if not (is_number(self.map_size) and 10.0 <= self.map_size <= 500.0):
            if self.map is not None:
                raise ValueError(f"Map '{self.map}' is {self.map_size:g} m wide; episodes need one of 10 to 500 m.")
            raise ValueError(f"map_size must be between 10 and 500 m, not {shown(self.map_size)}.")
        if self.people > MAX_PEDESTRIANS:
            raise ValueError(
                f"There may be at most {MAX_PEDESTRIANS} pedestrians; pedestrian_density {self.pedestrian_density} is "
                f"{self.people} on {self.map_size:g} x {self.map_size:g} m."
            )
        if not 1.0 <= self.goal_distance[0] <= self.goal_distance[1]:
            raise ValueError(
                f"goal_distance must be two lengths (least, most) of at least 1 m, not {self.goal_distance}."
            )
        if not (_is_whole(self.horizon) and 1 <= self.horizon <= MAX_HORIZON):
            raise ValueError(
                f"horizon must be a whole number of at least 1, at most {MAX_HORIZON}, not {shown(self.horizon)}."
            )
        _multiple("pedestrian_period", self.pedestrian_period, "the physics step", PHYSICS_STEP)
        _multiple("control_period", self.control_period, "the physics step", PHYSICS_STEP)
        if self.control_period > 10.0:
            raise ValueError(f"control_period must be at most 10 s, not {shown(self.control_period)}.")
        _multiple("control_period", self.control_period, "pedestrian_period", self.decision_period)
        object.__setattr__(self, "pedestrian_model", _models(self.pedestrian_model))
        if self.lcf_each is not None:
            object.__setattr__(self, "lcf_each", _each(self.lcf_each, self.people))
        check_radius("person_radius", self.person_radius)
        object.__setattr__(self, "preferred_speed", traits.check_preferred_speed(self.preferred_speed))
        traits.check_max_speed(self.person_max_speed, "person_max_speed")
        traits.check_companions(self.companions)
        if self.map is not None and self.person_radius > RADIUS:
            refuse_blocked_routes(load_map(self.map), self.person_radius)
        object.__setattr__(self, "reward", _weights(self.reward))
        object.__setattr__(self, "robot", robot_config(self.robot))
        for name in self.model_shares:
            check_model(name)

    @property
    def model_shares(self) -> dict[str, float]:
        """{pedestrian model: share}; the shares sum to 1."""
        return {self.pedestrian_model: 1.0} if isinstance(self.pedestrian_model, str) else dict(self.pedestrian_model)

    @property
    def people(self) -> int:
        """The number of pedestrians."""
        if self.pedestrian_density is not None:
            return layouts.person_count(self.pedestrian_density, self.map_size)
        if self.num_pedestrians is not None:
            return self.num_pedestrians
        own = load_map(self.map).pedestrians if self.map else None
        return PEDESTRIANS if own is None else own

    @property
    def people_goal_distance(self) -> tuple[float, float]:
        """Least and greatest distance from a pedestrian's place to its goal [m]; less than usual on small maps."""
        return min(GOAL_DISTANCE[0], self.map_size / 4), GOAL_DISTANCE[1]

    @property
    def decision_period(self) -> float:
        """Time between the pedestrians' decisions [s]: at least one falls in a control step."""
        return min(self.pedestrian_period, self.control_period)

    @property
    def decisions(self) -> int:
        """Pedestrians' decisions in a control step."""
        return round(self.control_period / self.decision_period)

    @property
    def substeps(self) -> int:
        """Physics steps in a pedestrians' decision."""
        return round(self.decision_period / PHYSICS_STEP)

    def replace(self, /, **changes: Any) -> Self:
        """This configuration with `changes`; a pedestrian count replaces a density and the other way round.

        Raises ValueError for an unknown name, listing the valid ones.
        """
        names = [field.name for field in dataclasses.fields(self)]
        if unknown := sorted(set(changes) - set(names)):
            raise ValueError(f"Unknown option '{unknown[0]}'. Choose among {', '.join(names)}.")
        if changes.get("num_pedestrians") is not None:
            changes = {"pedestrian_density": None, **changes}
        elif changes.get("pedestrian_density") is not None:
            changes = {"num_pedestrians": None, **changes}
        if self.map is not None and "map" in changes:  # the size belonged to the old map
            changes = {"map_size": MAP_SIZE, **changes}
        return dataclasses.replace(self, **changes)


def check_model(name: str) -> None:
    """Raises ValueError unless `name` is a pedestrian model; a shipped one is looked up once."""
    return pedestrians.check_model(name) if name.endswith(".npz") else _check_shipped(name)


_check_shipped = functools.lru_cache(64)(pedestrians.check_model)


def controller(name: str, period: float) -> Any:
    """The pedestrian model `name` from macid.pedestrians.make_controller; a shipped one is looked up once."""
    return pedestrians.make_controller(name, period) if name.endswith(".npz") else _shipped_controller(name, period)


_shipped_controller = functools.lru_cache(64)(pedestrians.make_controller)


def _is_whole(value):
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _pair(name, value):
    """`value` as (least, greatest): a number stands for both. Raises ValueError."""
    pair = (value, value) if is_number(value) else value
    try:
        least, most = pair
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a number or (least, most), not {shown(value)}.") from None
    if not (is_number(least) and is_number(most) and least <= most):
        raise ValueError(f"{name} must be a number or (least, most) with least <= most, not {shown(value)}.")
    return float(least), float(most)


def _models(value):
    """A model's name, or ((name, share), ...) of a dict, the shares brought to a sum of 1. Raises ValueError."""
    if isinstance(value, str):
        return value
    try:
        shares = dict(value)
    except (TypeError, ValueError):
        shares = {}
    good = all(isinstance(name, str) and is_number(share) and share >= 0 for name, share in shares.items())
    if not shares or not good or sum(shares.values()) <= 0:
        raise ValueError(f"pedestrian_model must be a name or {{name: share, ...}}, not {shown(value)}.")
    total = sum(shares.values())
    return tuple((name, share / total) for name, share in shares.items())


def _each(values, people):
    """One LCF for each of `people` pedestrians. Raises ValueError."""
    try:
        values = tuple(float(value) for value in values)
    except (TypeError, ValueError, OverflowError):
        values = ()
    if len(values) != people or not all(abs(value) <= MAX_LCF for value in values):
        raise ValueError(f"lcf_each must be {people} numbers in [-{MAX_LCF:g}, {MAX_LCF:g}], one for each pedestrian.")
    return values


def _weights(value):
    """`value`, or the default RewardWeights with a dict's numbers. Raises ValueError, naming the fields."""
    if isinstance(value, RewardWeights):
        return value
    fields = [field.name for field in dataclasses.fields(RewardWeights)]
    if isinstance(value, dict) and set(value) <= set(fields) and all(is_number(v) for v in value.values()):
        return dataclasses.replace(TaskConfig.reward, **value)
    raise ValueError(f"reward must be a dict of numbers for {', '.join(fields)}, not {shown(value)}.")


def _multiple(name, value, of_name, of):
    if not (is_number(value) and value > 0 and abs(round(value / of) * of - value) < 1e-9 and round(value / of) >= 1):
        raise ValueError(f"{name} must be a multiple of {of_name} ({of:g} s), not {shown(value)}.")


class Spawn(NamedTuple):
    """The beginning of an episode. World frame, metres and radians."""

    layout: Layout
    robot: np.ndarray  #: (3,) x, y, yaw
    goal: np.ndarray  #: (2,)
    people: np.ndarray  #: (K, 3) x, y, yaw
    people_goals: np.ndarray  #: (K, 2)
    lcf: np.ndarray  #: (K,)
    models: np.ndarray  #: (K,) index of each person's model in the config's model_shares
    router: Router | None  #: the people's router, where walls bar their view
    traits: Traits = PAPER_TRAITS  #: of people, (K,) each


def spawn(config: TaskConfig, rng: np.random.Generator) -> Spawn:
    """Draws an episode's map, the robot's start and goal, and the people, from the numpy Generator `rng`.

    The robot faces its goal. Where the map has routes, a person begins on its route and heads for one of the route's
    ends. If the map has a region in which people begin, they begin there and head for the farther end. On other maps
    they begin in the robot's connected part of the map. Raises macid.layout.NoFreeSpace where the map has no room, or
    no way from a start to a goal.
    """
    if config.map is None:
        layout = layouts.maze_layout(rng, config.obstacle_density, config.map_size)
    else:
        layout = load_map(config.map)
    start, goal = _robot_ends(config, layout, rng)
    router = Router(layout, config.person_radius) if layout.routed else None
    people, people_goals = _people_ends(config, layout, rng, start, router)
    towards = goal - start[0]
    yaw = rng.uniform(-np.pi, np.pi, (len(people), 1))
    lcf = rng.uniform(*config.lcf, len(people))
    shares = list(config.model_shares.values())
    models = rng.choice(len(shares), len(people), p=shares) if len(shares) > 1 else np.zeros(len(people), int)
    people, people_goals, drawn = _people_traits(config, layout, rng, start, people, people_goals)
    return Spawn(
        layout,
        np.array([*start[0], np.arctan2(towards[1], towards[0])]),
        goal,
        np.concatenate([people, yaw], axis=-1),
        people_goals,
        lcf if config.lcf_each is None else np.array(config.lcf_each),
        models,
        router,
        drawn,
    )


def _people_traits(config, layout, rng, robot, people, goals):
    """People's starts and goals (K, 2) [m], where companions stand together, and their Traits."""
    group, wanted = None, traits.draw_preferred_speed(rng, config.preferred_speed, len(people))
    if config.companions is not None:
        routes = np.arange(len(people)) % len(layout.routes) if layout.routes else None
        people, goals, group = traits.gather(
            rng, layout, people, goals, config.companions, config.person_radius, routes, robot, _START_CLEARANCE
        )
    return people, goals, traits.make_traits(config.person_radius, wanted, config.person_max_speed, group, len(people))


def stops(layout: Layout, person: int, place: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """The points (W, 2) [m] through which `person` goes from `place` (2,) to `goal` (2,), the goal last. They lie along
    the person's route, if the map has routes."""
    if not layout.routes:
        return goal[None]
    return rest_of_route(layout.routes[person % len(layout.routes)], place, goal)


def _robot_ends(config, layout, rng):
    """The robot's start (1, 2) and goal (2,) [m]."""
    router = Router(layout, config.robot.radius) if config.map else None  # in a maze all places are joined
    gap, regions = _GOAL_CLEARANCE, layout.regions
    failure = NoFreeSpace("The robot can't reach its goal.")
    for _ in range(50):  # again, as a start in the middle of a small map has no goal that is far enough
        start = layouts.sample_people(
            rng, layout, 1, gap=gap, region=regions.get("robot_start"), who="The robot", region_name="robot_start"
        )
        try:
            goal = layouts.sample_goals(
                rng,
                layout,
                start,
                config.goal_distance,
                gap=gap,
                region=regions.get("robot_goal"),
                who="the robot",
                region_name="robot_goal",
            )[0]
        except NoFreeSpace as error:
            failure = error
            continue
        try:
            if router is not None:
                router.path(start[0], goal)
            return start, goal
        except ValueError as error:
            failure = NoFreeSpace(f"The robot can't reach its goal. {error}")
    raise failure


def _people_ends(config, layout, rng, robot, router):
    """People's starts (K, 2) and goals (K, 2) [m]."""
    regions, radius = layout.regions, config.person_radius
    joins = ways_checker(config, router)
    if not layout.routes:
        region = regions.get("people_start")
        fits = None if joins is None or region is not None else lambda places: joins(places, robot)
        people = layouts.sample_people(
            rng, layout, config.people, taken=robot, keep_off=_START_CLEARANCE, region=region, fits=fits, radius=radius
        ).reshape(-1, 2)
        region = regions.get("people_goal")
        distance = config.people_goal_distance
        return people, layouts.sample_goals(rng, layout, people, distance, region=region, joins=joins, radius=radius)
    people, goals = np.empty((config.people, 2)), np.empty((config.people, 2))
    taken = robot
    for number, route in enumerate(layout.routes):
        who = np.arange(number, config.people, len(layout.routes))
        middle, along = (route[1:] + route[:-1]) / 2, route[1:] - route[:-1]
        length = np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-3)
        beside = np.full(len(along), _ROUTE_WIDTH / 2)
        strips = np.stack([*middle.T, length / 2, beside, np.arctan2(along[:, 1], along[:, 0])], axis=-1)
        region = regions.get("people_start")
        people[who] = layouts.sample_people(
            rng,
            layout,
            len(who),
            taken=taken,
            keep_off=_START_CLEARANCE,
            region=strips if region is None else region,
            region_name=f"routes[{number}]" if region is None else "people_start",
            radius=radius,
        ).reshape(-1, 2)
        taken = np.concatenate([taken, people[who]])
        end = rng.integers(0, 2, len(who))
        if region is not None:  # the end farther from the region
            far = np.linalg.norm(people[who, None] - route[[0, -1]], axis=-1)
            end = far.argmax(axis=-1)
        goals[who] = route[end * (len(route) - 1)]
    if joins is not None:
        for person, (place, goal) in enumerate(zip(people, goals, strict=True)):
            way = np.vstack([place, stops(layout, person, place, goal)])
            if not (joined := joins(way[:-1], way[1:])).all():
                router.path(*way[np.argmin(joined) :][:2])  # its error tells the two places
    return people, goals


def ways_checker(config: TaskConfig, router: Router | None) -> Any:
    """The test `joins` for macid.layout.sample_goals, which tells whether people can walk from a place to a goal: the
    `router`'s own test.

    None where people can walk anywhere: on an open map, and in a maze, all of which is joined.
    """
    return router.joins if config.map and router is not None else None
