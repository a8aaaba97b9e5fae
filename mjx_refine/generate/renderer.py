"""Which of MuJoCo's ways to an OpenGL context works here: asked in a process apart, since importing MuJoCo settles it."""

from __future__ import annotations

import os
import subprocess
import sys

from mjx_refine.errors import InputError

VARIABLE = "MUJOCO_GL"

_PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string("<mujoco/>")
with mujoco.Renderer(model, 8, 8) as renderer:
    renderer.update_scene(mujoco.MjData(model))
    renderer.render()
"""


def choose_renderer() -> str:
    """The value of MUJOCO_GL with which MuJoCo draws a picture: the one that is set, else the first of those that may.

    Raises:
      InputError: none does.
    """
    given = os.environ.get(VARIABLE)
    display = ("glfw",) if "DISPLAY" in os.environ else ()
    names = (given,) if given else (*display, "egl", "osmesa")
    for name in names:
        if _works(name):
            return name
    tried = f"{VARIABLE}={given}" if given else f"none of {', '.join(names)} works"
    raise InputError(
        f"--rgb: MuJoCo cannot draw pictures here ({tried}); install libegl1 and set {VARIABLE}=egl, or libosmesa6 and "
        f"{VARIABLE}=osmesa, or leave --rgb out"
    )


def _works(name: str) -> bool:
    environment = {**os.environ, VARIABLE: name}
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE], env=environment, capture_output=True, timeout=120, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0
