"""Colours of LCFs; and what the user is told where nothing can be drawn. (Films themselves: test_watch, bson's
test_film.)"""

import contextlib
import os
import pathlib
import subprocess
import sys

import numpy as np
import pytest

from macid.drawing import colours, video


def test_lcf_colours_run_from_red_over_light_to_blue():
    adversarial, neutral, cooperative = colours.lcf_colour(np.array([-2.0, 0.0, 2.0]))
    assert adversarial[0] > 2 * adversarial[2] and cooperative[2] > 2 * cooperative[0]
    assert neutral.sum() > max(adversarial.sum(), cooperative.sum())
    assert np.allclose(colours.lcf_colour(np.array([-9.0, 9.0])), [adversarial, cooperative])


@pytest.mark.parametrize(
    ("environment", "before", "says"),
    [
        ({"MUJOCO_GL": "off"}, "", "MUJOCO_GL=off"),
        ({"MUJOCO_GL": "egl", "MUJOCO_EGL_DEVICE_ID": "99"}, "", "libegl1"),
        ({"MUJOCO_GL": ""}, "import sys; sys.modules['mujoco.egl'] = None", "libgl1-mesa-dri"),
    ],
)
def test_without_gl_the_import_works_and_the_message_says_how_to_mend_it(environment, before, says):
    code = (
        f"{before}\nfrom macid.drawing import gl\nimport sys\nassert 'cv2' not in sys.modules\n"
        "print(gl.gl_problem())\n"
        "try:\n    gl.gl_context(8, 8)\nexcept gl.Unavailable: print('raised')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **environment},
        cwd=pathlib.Path(__file__).parents[2],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    problem, raised = done.stdout.splitlines()
    assert says in problem and "MUJOCO_GL=egl" in problem and raised == "raised"


def noise(number):
    """Pictures that hardly compress."""
    rng = np.random.default_rng(0)
    yield from (rng.integers(0, 255, (240, 320, 3), np.uint8) for _ in range(number))


def frames(path):
    """How many pictures a film has, by a name that OpenCV takes."""
    import cv2

    (path.parent / "copy.webm").write_bytes(path.read_bytes())
    with contextlib.chdir(path.parent):
        video = cv2.VideoCapture("copy.webm")
        count = 0
        while video.grab():
            count += 1
    (path.parent / "copy.webm").unlink()
    return count


def test_a_film_s_name_and_folder_need_not_be_utf_8(tmp_path):
    folder = tmp_path / os.fsdecode(b"caf\xe9\xff")
    folder.mkdir()
    path = folder / os.fsdecode(b"a\xff.webm")
    assert video.write_webm(path, noise(4), 4, 10) == path
    assert frames(path) == 4 and os.listdir(folder) == [path.name]


def test_a_cut_film_is_told_and_the_old_one_stays(tmp_path, capfd):
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=600k", "tmpfs", tmp_path], capture_output=True).returncode:
        pytest.skip("may not mount a file system")
    try:
        video.write_webm(tmp_path / "a.webm", noise(2), 2, 10)
        with pytest.raises(OSError, match=r"a.webm': only \d+ of its 40 pictures can be read back"):
            video.write_webm(tmp_path / "a.webm", noise(40), 40, 10)
        assert frames(tmp_path / "a.webm") == 2 and os.listdir(tmp_path) == ["a.webm"]
    finally:
        subprocess.run(["umount", tmp_path], check=True)
    assert capfd.readouterr().err == ""
