"""Perturbations: the changes to the world in a perturbed episode.

A perturbed episode has the seed, the instruction and the policy's draws of the test episode with the same
number. Only the start (its pose, or on dm_control its speeds), the masses of objects and, where a policy sees
pictures, camera and light differ. These changes depend on the seed alone, and have their own random stream:
all other draws of the episode stay the same. Each suite gives the scale of a displaced start, and each camera
the scale of its view, with reasons.
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
"""Factors on the mass and the moments of inertia of an object. Policies have met only the plain mass, and
experts of skills succeed with both factors. There are two values rather than a range: no episode is nearly
plain, and all episodes of one mass share a compiled model, of 9 MB in Fetch and 18 MB in Meta-World."""


@dataclass(frozen=True)
class Perturbation:
    """How the world of one episode differs from the plain one."""

    mass: float
    """Factor on masses and moments of inertia, one of `MASSES`."""
    start: tuple[float, float, float]
    """Displacement of the start pose, from -1 to 1 along each axis; the suite gives the scale."""
    view: tuple[float, ...]
    """Displacement of camera and light, `VIEW_SIZE` numbers from -1 to 1; the camera gives the scales."""


def draw_perturbation(seed: int) -> Perturbation:
    """Return the perturbation of the episode whose initial state has this seed."""
    generator = numpy_generator("perturbation", seed)
    mass = MASSES[int(generator.integers(len(MASSES)))]
    x, y, z = generator.uniform(-1.0, 1.0, 3).tolist()
    return Perturbation(mass, (x, y, z), tuple(generator.uniform(-1.0, 1.0, VIEW_SIZE).tolist()))


def with_mass(model: mujoco.MjModel, bodies: Sequence[int], mass: float) -> mujoco.MjModel:
    """Return a copy of a model in which some bodies are `mass` times as heavy and as hard to turn.

    MuJoCo recomputes the values that it derives from masses, such as the weights of constraints.

    Args:
        model: Compiled scene.
        bodies: Ids of the bodies.
        mass: Factor on their masses and moments of inertia.
    """
    import mujoco

    changed = copy.copy(model)
    changed.body_mass[bodies] *= mass
    changed.body_inertia[bodies] *= mass
    mujoco.mj_setConst(changed, mujoco.MjData(changed))
    return changed
