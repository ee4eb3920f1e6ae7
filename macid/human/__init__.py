"""Real people, and pedestrian models measured against them.

| module | what |
|---|---|
| `data` | files of people's walks: recognised, read, checked |
| `measures` | what is measured of walks: pure NumPy |
| `stage` | any pedestrian model on a layout where people come and go |
| `replay` | open scenes, everybody replaced by a model |
| `flows` | the lab's corridors: an exit, one way, two ways |
| `figures` | people's figures: made from data, shipped without it |
| `measure` | a model measured, and the folder of its results |
| `page` | the page of these results |
| `command` | what `macid human data` does |

No walk of a real person is part of this project: figures of them are (assets/human).
"""
