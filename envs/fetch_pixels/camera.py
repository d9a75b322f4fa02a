"""The camera of the pixel scenario: the numbers and the picture that a policy gets from a state.

The scene is the Fetch world's, edited with MjSpec: two coloured things are on the table. They exist in
pictures only, and nothing touches them, so experts and physics equal the Fetch world's bit for bit.
"""

from __future__ import annotations

from typing import ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from clbench.worlds.camera import Views

from ..fetch.scene import scene_file
from ..fetch.state import (
    BLOCK,
    FINGERS,
    FINGERS_VELOCITY,
    GRIPPER,
    GRIPPER_VELOCITY,
    REST_HEIGHT,
    SIZE,
    TARGET,
    State,
)

JOINTS = slice(SIZE, SIZE + 22)
"""Positions of all joints, including the block's: with target and things they define the whole picture."""
THINGS = slice(JOINTS.stop, JOINTS.stop + 6)
"""For each of two things: its place x and y in metres, and the number of its colour."""
PIXEL_SIZE = THINGS.stop
"""Length of a state: the Fetch world's state, then `JOINTS` and `THINGS`. No policy sees it."""

COLOURS = {
    "green": (0.05, 0.60, 0.10),
    "blue": (0.05, 0.15, 0.90),
    "yellow": (0.95, 0.85, 0.05),
    "purple": (0.60, 0.10, 0.75),
}
"""Possible colours of a thing as red, green and blue; the target is red, the block black, the arm grey."""

PROPRIOCEPTION = np.r_[GRIPPER, FINGERS, GRIPPER_VELOCITY, FINGERS_VELOCITY]
"""Indices of the numbers that a policy gets: measurements of the robot itself."""

LOOK_AT = (1.34, 0.75, 0.42)
VIEW = {"azimuth": 180.0, "elevation": -65.0, "distance": 0.60}
"""A high view from the front: the table fills the width of the picture, and a pixel is a centimetre."""

PERTURBATION = {"azimuth": 5.0, "elevation": 5.0, "distance": 0.04}
"""Largest displacement of a perturbed view in degrees and metres, as after a touch of the camera: objects on
the table move by up to 3 of the 64 pixels, or 3 cm."""
LIGHT = 0.4
"""Largest share by which a perturbed scene is lighter or darker."""

ARM = (0.75, 0.75, 0.75, 1.0)
"""Colour of the fingers, the only drawn part of the arm: the rest would hide the table."""


class FetchCamera:
    """Draws states of the pixel scenario; a picture does not depend on earlier ones.

    A policy gets the picture and ten measurements of the robot: the position of the gripper, the opening of
    each finger, the velocity of the gripper and that of each finger, in metres and metres per step.

    Args:
        size: Width and height of a picture in pixels.
        scale: Number of drawn pixels per pixel of the picture along each side; averaging smooths edges.
            MuJoCo's own antialiasing is ten times slower without a graphics card.
    """

    image_size: ClassVar[int] = 64
    state_size: ClassVar[int] = len(PROPRIOCEPTION)

    def __init__(self, size: int = image_size, scale: int = 2) -> None:
        self._size, self._scale = size, scale
        self._model = _model(size * scale)
        self._data = mujoco.MjData(self._model)
        self._target = self._model.site("target0").id
        self._things = [self._model.geom(f"thing{number}").id for number in range(2)]
        self._renderer = mujoco.Renderer(self._model, size * scale, size * scale)
        for flag in ("SHADOW", "REFLECTION", "SKYBOX"):
            self._renderer.scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = False
        self._view = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(self._model, self._view)
        self._view.lookat[:] = LOOK_AT
        head = self._model.vis.headlight
        self._lights = [self._model.light_ambient, self._model.light_diffuse, head.ambient, head.diffuse]
        self._plain_lights = [light.copy() for light in self._lights]

    @staticmethod
    def proprioception(states: State) -> State:
        """Return the numbers (N, 10) of the states (N, 56) that a policy gets."""
        return states[:, PROPRIOCEPTION]

    @staticmethod
    def pictured(states: State) -> State:
        """Return the places of block, target, right and left thing, (N, 9), in metres."""
        things = states[:, THINGS].reshape(-1, 2, 3)[:, :, :2]
        from_the_right = np.take_along_axis(things, things[:, :, 1:].argsort(axis=1), axis=1)
        places = [states[:, BLOCK], states[:, TARGET][:, :2], from_the_right.reshape(-1, 4)]
        return np.concatenate(places, axis=1)

    def draw(self, states: State, views: Views) -> NDArray[np.uint8]:
        """Return pictures (N, size, size, 3) of the states (N, 56), perturbed by `views` (N, 4)."""
        pictures = np.empty((len(states), self._size, self._size, 3), np.uint8)
        for picture, state, view in zip(pictures, states, views, strict=True):
            self._perturb(view)
            picture[:] = self._draw(state)
        return pictures

    def _perturb(self, view: Views) -> None:
        """Set the camera and the light, changed by the shares of a view (4,)."""
        for (name, value), share in zip(VIEW.items(), view, strict=False):
            setattr(self._view, name, value + PERTURBATION[name] * float(share))
        for light, plain in zip(self._lights, self._plain_lights, strict=True):
            light[:] = plain * (1.0 + LIGHT * float(view[-1]))

    def _draw(self, state: State) -> NDArray[np.uint8]:
        model, data = self._model, self._data
        data.qpos[:] = state[JOINTS]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        data.site_xpos[self._target] = state[TARGET]
        for geom, (x, y, colour) in zip(self._things, state[THINGS].reshape(2, 3), strict=True):
            data.geom_xpos[geom] = x, y, REST_HEIGHT
            model.geom_rgba[geom, :3] = list(COLOURS.values())[int(colour)]
        self._renderer.update_scene(data, self._view)
        fine, scale = self._renderer.render(), self._scale
        total = np.zeros((self._size, self._size, 3), np.uint16)
        for row in range(scale):
            for column in range(scale):
                total += fine[row::scale, column::scale]
        return ((total + scale**2 // 2) // scale**2).astype(np.uint8)

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()


def _model(pixels: int) -> mujoco.MjModel:
    """Return the scene with two added things and only the fingers of the robot."""
    spec = mujoco.MjSpec.from_file(str(scene_file()))
    spec.visual.global_.offwidth = spec.visual.global_.offheight = pixels
    spec.visual.quality.offsamples = 0
    for number in range(2):
        spec.worldbody.add_geom(
            name=f"thing{number}",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[0.024, 0.02, 0.0],
            rgba=[0.0, 0.0, 0.0, 1.0],
            contype=0,
            conaffinity=0,
        )
    model = spec.compile()
    for geom in range(model.ngeom):
        body = model.body(model.geom_bodyid[geom]).name
        if "finger" in body:
            model.geom_rgba[geom] = ARM
        elif body.startswith("robot0:") or model.geom(geom).name == "floor0":
            model.geom_rgba[geom, 3] = 0.0
    return model
