"""The built wheel, not the checkout, runs by itself."""

import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder with the wheel's content alone."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    site = folder / "site"
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", str(site)]
    subprocess.run([*install, str(wheel)], check=True, capture_output=True)
    return site


def run(site, code):
    command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(site)!r}); {code}"]
    return subprocess.run(command, cwd=site.parent, check=True, capture_output=True, text=True).stdout


def test_an_installed_wheel_finds_its_assets_and_steps(installed):
    code = (
        "import gymnasium, bson, macid.assets; print(macid.assets.root());"
        "from bson.evaluation.suites import suite_names;"
        "print(suite_names()); from macid.layout import load_level; print(load_level(4).pedestrians);"
        "env = gymnasium.make('BSON/LocalLidar2D-v0', num_pedestrians=2); env.reset(seed=0);"
        "env.step(env.action_space.sample()); print('stepped')"
    )
    lines = run(installed, code).splitlines()
    assert lines[0] == str(installed / "macid" / "_assets") and (installed / "macid" / "py.typed").exists()
    assert "paper" in lines[1] and lines[2:] == ["200", "stepped"]


def test_an_installed_wheel_makes_pages(installed):
    code = (
        "from bson.reporting.heatmap import Scale, Tile, cell_maps;"
        "print(cell_maps([Tile({'axis': '<b>'}, 0.5, 0.1, 0.9)], Scale(0.0, 1.0), 'heading'))"
    )
    assert "&lt;b&gt;" in run(installed, code)
    folders = [root / "bson" / "reporting" / "templates" for root in (ROOT, installed)]
    templates = [{path.name for path in folder.iterdir()} for folder in folders]
    assert templates[0] == templates[1]
    assert {"report.html", "compare.html", "page.css"} <= templates[1]


def test_an_installed_wheel_has_its_types(installed):
    assert (installed / "bson" / "py.typed").exists()
