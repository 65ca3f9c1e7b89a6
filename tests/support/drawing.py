"""Whether MuJoCo itself can draw on this machine, without a line of this project's."""

from __future__ import annotations

import functools
import os
import subprocess
import sys

_CODE = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8).render()"


@functools.cache
def draws(way: str) -> bool:
    """`way` is a value of MUJOCO_GL. In a process of its own: MuJoCo chooses how to draw when it is first imported."""
    kind = os.environ | {"MUJOCO_GL": way}
    return subprocess.run([sys.executable, "-c", _CODE], env=kind, capture_output=True).returncode == 0
