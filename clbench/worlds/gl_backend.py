"""Rendering back ends of MuJoCo: finds one that draws on this machine without a screen."""

from __future__ import annotations

import functools
import importlib
import os
import subprocess
import sys
from collections.abc import Iterable

from clbench.base.errors import ClbenchError

DEBIAN_PACKAGES = {"egl": "libegl1 libgl1-mesa-dri", "osmesa": "libosmesa6"}
"""Packages that make each headless back end of MuJoCo work on Debian and Ubuntu."""

_BACK_ENDS = tuple(DEBIAN_PACKAGES) if sys.platform == "linux" else ("glfw",)
"""Back ends in the order of trial. EGL draws a Fetch world in 0.03 s on one core, OSMesa in 0.14 s."""

_DRAW = """
import sys
from clbench.base.entry_points import resolve
thing = resolve(sys.argv[1])
if hasattr(thing, "proprioception"):  # a camera, which is ready to draw once it is made
    thing()
    sys.exit()
world = thing(render_mode="rgb_array")
world.reset(seed=0)
picture = world.render()
world.close()
if getattr(picture, "ndim", None) != 3:
    sys.exit(f"{sys.argv[1]}: render() returns {type(picture).__name__}, not a picture (H, W, 3)")
"""

_MAKE_CONTEXT = "import mujoco; mujoco.GLContext(8, 8).make_current()"


class RenderingError(ClbenchError):
    """No back end of this machine can draw a world."""


def rendering_fault(back_end: str, world: str | None = None) -> str | None:
    """Return the reason why a back end cannot draw, None if it can.

    The trial runs in a process of its own, which a failure may kill.

    Args:
        back_end: Value for the variable `MUJOCO_GL`.
        world: Entry point of an environment to draw, or of a camera to make; None only creates a rendering
            context.
    """
    command = [sys.executable, "-c", *((_MAKE_CONTEXT,) if world is None else (_DRAW, world))]
    try:
        result = subprocess.run(
            command, env=environment_of(back_end), capture_output=True, text=True, timeout=120, check=False
        )
    except subprocess.TimeoutExpired:
        return "no answer in two minutes"
    if result.returncode == 0:
        return None
    # the lines after the error come from the destructors of incomplete objects
    lines = result.stderr.partition("Exception ignored")[0].strip().splitlines()
    return lines[-1].removeprefix("clbench.base.errors.") if lines else f"exit code {result.returncode}"


def environment_of(back_end: str) -> dict[str, str]:
    """Return the environment variables of a process that uses a back end and the same import paths."""
    path = os.pathsep.join(entry for entry in sys.path if entry)
    return {**os.environ, "MUJOCO_GL": back_end, "PYTHONPATH": path}


@functools.cache
def draw_without_display() -> None:
    """Let MuJoCo draw in this process if there is neither a display nor a choice of `MUJOCO_GL`.

    Sets `MUJOCO_GL` to the first back end that can draw. Worlds read the variable when they first draw. If no
    back end can draw, nothing is set, and the world raises its own error.
    """
    if sys.platform != "linux" or any(
        os.environ.get(name) for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")
    ):
        return
    for back_end in _BACK_ENDS:
        if rendering_fault(back_end) is None:
            os.environ["MUJOCO_GL"] = back_end
            bound = sys.modules.get("mujoco.rendering.classic.gl_context")
            if bound is not None:  # MuJoCo's own renderer keeps the back end that its import found
                importlib.reload(bound)
            return


def choose_back_end(worlds: Iterable[str]) -> str:
    """Set `MUJOCO_GL` to the first back end that draws all worlds, and return it.

    Call it before MuJoCo is imported.

    Args:
        worlds: Entry points of environments.

    Raises:
        RenderingError: No back end draws them all; the message names the packages to install.
    """
    back_end = working_back_end(worlds, os.environ.get("MUJOCO_GL"))
    os.environ["MUJOCO_GL"] = back_end
    return back_end


def working_back_end(worlds: Iterable[str], chosen: str | None) -> str:
    """Return the first back end that draws all worlds: EGL or OSMesa on Linux, GLFW elsewhere.

    Args:
        worlds: Entry points of environments or cameras.
        chosen: The user's value of `MUJOCO_GL`, the only back end to try; None or empty tries all.

    Raises:
        RenderingError: No back end draws them all. The message names the world that fails where a back end
            works, else the packages to install.
    """
    needed = sorted(set(worlds))
    faults: dict[str, tuple[str, str]] = {}
    for back_end in (chosen,) if chosen else _BACK_ENDS:
        found = [(world, fault) for world in needed if (fault := rendering_fault(back_end, world))]
        if not found:
            return back_end
        faults[back_end] = found[0]
    for back_end, (world, fault) in faults.items():
        if rendering_fault(back_end) is None:
            raise RenderingError(f"{back_end} works on this machine, but cannot draw {world}: {fault}")
    tried = " or ".join(f"{back_end} ({fault})" for back_end, (_, fault) in faults.items())
    message = f"The worlds cannot be drawn with {tried}."
    if chosen:
        raise RenderingError(
            f"{message} MUJOCO_GL is set to {chosen}: unset it, and clbench chooses what works."
        )
    commands = " or ".join(f"apt-get install {packages}" for packages in DEBIAN_PACKAGES.values())
    raise RenderingError(f"{message} On Debian and Ubuntu: {commands}")
