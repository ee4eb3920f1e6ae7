"""A draw of small tasks, in which trainings of robots with a memory are tried."""

DRAW = """
name = "mine"
description = "a test"
sizes = [0, 2]
[[kinds]]
share = 1
[kinds.config]
map_size = 14.0
goal_distance = [3.0, 6.0]
num_pedestrians = {people}
horizon = 30
[[validation]]
map_size = 14.0
num_pedestrians = 0
goal_distance = [3.0, 6.0]
horizon = 5
"""
