"""Path planners on an occupancy grid with pedestrians as costs, and a follower, for the robot's Global track.

Points and paths are in the world frame [m]. A path's cost is the integral of `1 + cost` along it [m]: its length, plus
its cost to people. Cost maps are constant within a cell, so lines are checked and integrated cell by cell, exactly.

`plan` runs every planner:

- `dijkstra` (Dijkstra 1959) on the eight-connected grid, without cutting corners; `astar` (Hart, Nilsson and Raphael
  1968) is the same plus a heuristic;
- `rrt` (LaValle 1998) grows a tree towards random samples; `rrt-star` (Karaman and Frazzoli, IJRR 2011) also chooses
  the best parent and rewires; `carrt-star` (cost-aware RRT*: Suh, Gong and Oh, "Fast sampling-based cost-aware path
  planning with nonmyopic extensions using cross entropy", T-RO 2017) also chooses each extension by the cross-entropy
  method, here as one turn and one length.

All but `rrt`, which stops at its first path, heed the cost map.
"""

from bson.planners.grid import Grid, NoPath, path_cost
from bson.planners.planning import PLANNERS, plan, shortcut
from bson.planners.pursuit import PurePursuit, nearest_on
from bson.planners.search import AStarConfig, DijkstraConfig
from bson.planners.social_cost import SocialCostConfig, social_cost
from bson.planners.trees import CarrtStarConfig, RrtConfig, RrtStarConfig

__all__ = [
    "PLANNERS",
    "AStarConfig",
    "CarrtStarConfig",
    "DijkstraConfig",
    "Grid",
    "NoPath",
    "PurePursuit",
    "RrtConfig",
    "RrtStarConfig",
    "SocialCostConfig",
    "nearest_on",
    "path_cost",
    "plan",
    "shortcut",
    "social_cost",
]
