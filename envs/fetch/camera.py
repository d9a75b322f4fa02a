"""The camera of the pixel scenario: what a policy is shown of a state, and how that is drawn.

The scene is that of the Fetch world, edited with MjSpec: two coloured things lie on the table. They are drawn
and no more, nothing touches them: experts and physics are those of the Fetch world, bit for bit.
"""

from __future__ import annotations

from typing import ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from clbench.worlds.camera import Views

from .scene import scene_file
from .state import (
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
"""Positions of all joints, the block's too: with the target and the things they are the whole picture."""
THINGS = slice(JOINTS.stop, JOINTS.stop + 6)
"""Place x, y and number of the colour of each of two things, in metres."""
PIXEL_SIZE = THINGS.stop
"""Length of a state: that of the Fetch world, then `JOINTS` and `THINGS`. No policy is shown it."""

COLOURS = {
    "green": (0.05, 0.60, 0.10),
    "blue": (0.05, 0.15, 0.90),
    "yellow": (0.95, 0.85, 0.05),
    "purple": (0.60, 0.10, 0.75),
}
"""Red, green and blue of what a thing may have; the target is red, the block black, the arm grey."""

PROPRIOCEPTION = np.r_[GRIPPER, FINGERS, GRIPPER_VELOCITY, FINGERS_VELOCITY]
"""What a policy is shown of the state as numbers: what a robot knows of itself."""

LOOK_AT = (1.34, 0.75, 0.42)
VIEW = {"azimuth": 180.0, "elevation": -65.0, "distance": 0.60}
"""From the front, high up: the width of the table is that of the picture, and a pixel is a centimetre."""

PERTURBATION = {"azimuth": 5.0, "elevation": 5.0, "distance": 0.04}
"""How far a perturbed view is displaced at most, in degrees and metres, as after a touch of the camera: what
lies on the table moves by up to 3 of the 64 pixels, which are centimetres there."""
LIGHT = 0.4
"""By what share a perturbed scene is lighter or darker at most."""

ARM = (0.75, 0.75, 0.75, 1.0)
"""Colour of the fingers. They are all of the arm that is drawn: the rest would hide the table."""


class FetchCamera:
    """Draws states of the pixel scenario, each by itself: no picture depends on those before.

    Args:
        size: Width and height of a picture.
        scale: Pixels that are drawn for each that is kept, along each side; their mean smooths edges.
            MuJoCo's own way to do so is ten times slower where there is no graphics card.
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
        """Return the part of the states (N, 56) that a policy is shown as numbers, (N, 10)."""
        return states[:, PROPRIOCEPTION]

    @staticmethod
    def pictured(states: State) -> State:
        """Return where block, target, and the right and the left thing are, (N, 9), in metres."""
        things = states[:, THINGS].reshape(-1, 2, 3)[:, :, :2]
        from_the_right = np.take_along_axis(things, things[:, :, 1:].argsort(axis=1), axis=1)
        places = [states[:, BLOCK], states[:, TARGET][:, :2], from_the_right.reshape(-1, 4)]
        return np.concatenate(places, axis=1)

    def draw(self, states: State, views: Views) -> NDArray[np.uint8]:
        """Return pictures of the states (N, 56), as `views` (N, 4) disturb them, (N, size, size, 3)."""
        pictures = np.empty((len(states), self._size, self._size, 3), np.uint8)
        for picture, state, view in zip(pictures, states, views, strict=True):
            self._disturb(view)
            picture[:] = self._draw(state)
        return pictures

    def _disturb(self, view: Views) -> None:
        """Put the camera in its place and light the scene, both displaced by the shares of a view (4,)."""
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
        """Free what draws."""
        self._renderer.close()


def _model(pixels: int) -> mujoco.MjModel:
    """Return the scene with two things more, and with no more of the robot than its fingers."""
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
