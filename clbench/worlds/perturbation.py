"""Perturbations: what is disturbed in the world of a perturbed episode.

A perturbed episode begins with the seed, the instruction and the policy's draws of the test episode of its
number; only the start pose, the mass of what is moved and, where a policy sees pictures, camera and light
differ. What these become follows from that seed alone, in a stream of its own: no other draw of the episode
moves. Each suite says how far it displaces a start, and each camera how far its view, and why.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from clbench.base.seeding import numpy_generator
from clbench.worlds.camera import VIEW_SIZE

if TYPE_CHECKING:
    import mujoco

MASSES = (0.5, 2.0)
"""How many times as heavy a thing is as in the plain world, and as hard to turn. Policies have met the plain
mass alone, and experts succeed with either of these. Two values rather than a range: no episode is nearly
undisturbed, and episodes of one mass share a compiled model; Fetch's takes 9 MB, one of Meta-World's 18."""


@dataclass(frozen=True)
class Perturbation:
    """How the world of one episode differs from the plain one."""

    mass: float
    """What masses and moments of inertia are multiplied by, one of `MASSES`."""
    start: tuple[float, float, float]
    """Displacement of the start pose, from -1 to 1 along each axis; the suite gives it a scale."""
    view: tuple[float, ...]
    """Displacement of camera and light, `VIEW_SIZE` numbers from -1 to 1; the camera gives them scales."""


def draw_perturbation(seed: int) -> Perturbation:
    """Return what is disturbed in the episode whose initial state has this seed."""
    generator = numpy_generator("perturbation", seed)
    mass = MASSES[int(generator.integers(len(MASSES)))]
    x, y, z = generator.uniform(-1.0, 1.0, 3).tolist()
    return Perturbation(mass, (x, y, z), tuple(generator.uniform(-1.0, 1.0, VIEW_SIZE).tolist()))


def with_mass(model: mujoco.MjModel, bodies: Sequence[int], mass: float) -> mujoco.MjModel:
    """Return a copy of a model in which some bodies are `mass` times as heavy and as hard to turn.

    What MuJoCo derives from masses, as the weights of constraints, is computed again.
    """
    import mujoco

    changed = copy.copy(model)
    changed.body_mass[bodies] *= mass
    changed.body_inertia[bodies] *= mass
    mujoco.mj_setConst(changed, mujoco.MjData(changed))
    return changed
