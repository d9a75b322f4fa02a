"""The scenes of the LIBERO world: one compiled model for all tasks with the same objects."""

from __future__ import annotations

import copy
import functools
from dataclasses import dataclass, replace
from typing import Any, TypeAlias
from xml.etree import ElementTree

import mujoco
import numpy as np
from numpy.typing import NDArray

from clbench.worlds.perturbation import with_mass
from clbench.worlds.threads import Copies

from .arm import JOINTS, REST, Arm, Sensed

Vector: TypeAlias = NDArray[np.float64]
Places: TypeAlias = tuple[Vector, Vector]
"""Positions (bodies, 3) and quaternions (bodies, 4) of all bodies in the bodies that hold them."""

BELOW_HAND = 0.17
"""Height in metres of the arm at rest over what the camera looks at: 10 cm above a table, or the floor."""
SOLID = 0
"""Group of the geoms that collide, which LIBERO does not draw."""
SEEN, HIDDEN = 1, 3
"""A group that MuJoCo draws unless it is told otherwise, and one that it does not draw."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A compiled scene, shared by all its episodes in a process."""

    xml: str
    """The scene in MJCF."""
    model: mujoco.MjModel
    """The scene without unused sensors, and without the parts that are only seen, 95 % of the full memory."""
    models: Copies[mujoco.MjModel]
    """The model, for threads that advance episodes at the same time: each moves the fixtures in its own."""
    places: Places
    """Compiled places of the bodies; a problem moves the fixtures among them."""
    rest: Sensed
    """What the controller senses when the arm is at rest."""

    def __deepcopy__(self, _: dict[int, Any]) -> Scene:
        """Return the scene itself: a copied world shares it, too."""
        return self

    @functools.cached_property
    def seen(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """The whole scene, 210 MB, and physics to draw. As in LIBERO, solid geoms and marks are hidden."""
        model = mujoco.MjModel.from_xml_string(self.xml)
        model.geom_group[model.geom_group == SOLID] = HIDDEN
        model.site_group[:] = HIDDEN
        return model, mujoco.MjData(model)

    @property
    def camera(self) -> dict[str, Any]:
        """A view from the side opposite to the robot, of a table or, for libero_object, of the floor."""
        lookat = np.array([-0.1, 0.0, self.rest.place[2] - BELOW_HAND])
        return {"distance": 1.6, "azimuth": 180.0, "elevation": -35.0, "lookat": lookat}


@functools.cache
def scene_of(xml: str) -> Scene:
    """Compile a scene in MJCF, once per process."""
    model = mujoco.MjModel.from_xml_string(_without_looks(xml))
    # LIBERO reads no sensor, and the physics does not depend on them
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
    data = mujoco.MjData(model)
    data.qpos[:JOINTS] = REST
    mujoco.mj_forward(model, data)
    rest = Sensed(*(part.copy() for part in Arm(model, data).sense(model)))
    return Scene(xml, model, _copies(model), (model.body_pos.copy(), model.body_quat.copy()), rest)


@functools.cache
def heavier(scene: Scene, mass: float) -> Scene:
    """Return a scene in which all objects are `mass` times as heavy; all its episodes share the copy."""
    model = copy.copy(scene.model)
    model.body_pos[:], model.body_quat[:] = scene.places  # episodes move the fixtures
    free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    model = with_mass(model, model.jnt_bodyid[free].tolist(), mass)
    return replace(scene, model=model, models=_copies(model))


def _copies(model: mujoco.MjModel) -> Copies[mujoco.MjModel]:
    """Return the model with its copies, of 3 MB each."""
    return Copies(model, lambda: copy.copy(model))


def _without_looks(xml: str) -> str:
    """Return a scene that is compiled without geoms that collide with nothing, their meshes and textures.

    The physics has the same bits, and actions take less time: MuJoCo places all geoms in each of its steps.
    """
    root = ElementTree.fromstring(xml)
    for compiler in root.iter("compiler"):
        compiler.set("discardvisual", "true")
    return ElementTree.tostring(root, encoding="unicode")
