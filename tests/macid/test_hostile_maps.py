"""A map's files, changed at random, are read or refused in one line, and never anything else."""

import pathlib
import tempfile

import cv2
import hostile
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from macid.maps import load_map

LAYOUT = """name = "small"
size = 12.0
walls = [[0.0, -6.0, 0.0, -1.5], [0.0, 1.5, 0.0, 6.0]]
obstacles = [[-3.0, 3.0, 1.0, 0.4, 0.3], [3.0, -3.0, 0.6, 0.6, 0.785]]
routes = [[[-4.0, -4.0], [-1.5, 0.0], [1.5, 0.0], [4.0, 4.0]]]
routed = true
pedestrians = 4
[regions]
robot_start = [[-4.0, 0.0, 1.0, 3.0, 0.0]]
robot_goal = [[4.0, 0.0, 1.0, 3.0, 0.0]]
"""
YAML = """image: floor.pgm
resolution: 0.5
origin: [-3.0, 2.0, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
mode: trinary
"""
PICTURE = np.full((20, 24), 254, np.uint8)
PICTURE[5:9, 3:12], PICTURE[12:, 15] = 0, 205
KINDS = (".pgm", ".png", ".jpg", ".bmp", ".webp", ".tiff")
IMAGES = {ending: bytes(cv2.imencode(ending, PICTURE)[1]) for ending in KINDS}
IMAGES[".ascii.pgm"] = b"P2\n# noise\n24 20\n255\n" + " ".join(map(str, PICTURE.ravel())).encode()
IMAGES[".rgba.png"] = bytes(cv2.imencode(".png", np.dstack([PICTURE] * 4))[1])
few = settings(max_examples=500, deadline=None, suppress_health_check=list(HealthCheck), database=None)
many = settings(few, max_examples=20_000)


def check(files, name):
    with tempfile.TemporaryDirectory() as folder:
        for file, content in files.items():
            (pathlib.Path(folder) / file).write_bytes(content)
        return hostile.refused_in_one_line(load_map, f"{folder}/{name}")


def check_layout(content):
    check({"map.toml": content}, "map.toml")


def check_yaml(content):
    check({"map.yaml": content, "floor.pgm": IMAGES[".pgm"]}, "map.yaml")


def check_image(picture):
    check({"map.yml": YAML.replace("floor.pgm", "floor.img").encode(), "floor.img": picture}, "map.yml")


layouts = hostile.mutated(LAYOUT, " = ")
yamls = hostile.mutated(YAML, ": ", hostile.yaml_scalars())
images = st.sampled_from(sorted(IMAGES)).flatmap(lambda ending: hostile.mutated_bytes(IMAGES[ending]))
cut_images = st.sampled_from(sorted(IMAGES)).flatmap(
    lambda ending: st.integers(0, len(IMAGES[ending])).map(lambda length: IMAGES[ending][:length])
)
ALL = {"layout": (layouts, check_layout), "yaml": (yamls, check_yaml), "image": (images | cut_images, check_image)}


def test_the_files_are_valid_as_long_as_nothing_is_changed():
    assert not check({"map.toml": LAYOUT.encode()}, "map.toml")
    for ending, content in IMAGES.items():
        files = {"map.yml": YAML.replace(".pgm", ending).encode(), f"floor{ending}": content}
        assert not check(files, "map.yml"), ending


@pytest.mark.parametrize("kind", ALL)
def test_a_changed_file_is_read_or_refused_in_one_line(kind):
    strategy, run = ALL[kind]
    few(given(strategy)(run))()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ALL)
def test_twenty_thousand_changed_files(kind):
    strategy, run = ALL[kind]
    many(given(strategy)(run))()
