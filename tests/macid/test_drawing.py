"""Colours of LCFs; and what the user is told where nothing can be drawn. (Films themselves: test_watch, bson's test_film.)"""

import os
import pathlib
import subprocess
import sys

import numpy as np
import pytest

from macid import drawing


def test_lcf_colours_run_from_red_over_light_to_blue():
    adversarial, neutral, cooperative = drawing.lcf_colour(np.array([-2.0, 0.0, 2.0]))
    assert adversarial[0] > 2 * adversarial[2] and cooperative[2] > 2 * cooperative[0]
    assert neutral.sum() > max(adversarial.sum(), cooperative.sum())
    assert np.allclose(drawing.lcf_colour(np.array([-9.0, 9.0])), [adversarial, cooperative])


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
        f"{before}\nfrom macid import drawing\nimport sys\nassert 'cv2' not in sys.modules\nprint(drawing.gl_problem())\n"
        "try:\n    drawing.gl_context(8, 8)\nexcept drawing.Unavailable: print('raised')"
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
