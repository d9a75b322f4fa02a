"""Pictures of running episodes from a simulator's own cameras, for a policy that sees what a robot sees.

They are for policies of other programs. Policies of clbench see the pictures of a task's `Camera`, which are
drawn from the state alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import closing
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clbench.base.entry_points import unknown
from clbench.base.errors import InputError
from clbench.spec.fields import whole_number
from clbench.spec.task import Task
from clbench.worlds.gl_backend import RenderingError, draw_without_display
from clbench.worlds.lanes import Lanes
from clbench.worlds.world import Drawable

if TYPE_CHECKING:
    import mujoco

SIZE = 224
"""Usual height and width of a picture, which OpenVLA and openpi read."""


class SimulatorCameras:
    """Cameras of simulators, and the size of their pictures.

    A renderer belongs to one compiled scene and takes seconds to make, so it serves all episodes of a scene.

    Args:
        names: Names of cameras that the scenes of all tasks have.
        size: Height and width N of a picture in pixels.

    Raises:
        InputError: A name occurs twice or is not a text, or the size is not a whole number of at least 1.
    """

    def __init__(self, names: Sequence[str], size: int = SIZE) -> None:
        if len({*names}) < len(names) or not all(isinstance(name, str) for name in names):
            raise InputError(f"Pictures are of different cameras, each named once, not {names!r}.")
        self.names, self.size = tuple(names), whole_number("picture_size", size, 1)
        self._renderers: dict[int, tuple[mujoco.MjModel, mujoco.Renderer]] = {}

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that the record of a run keeps; empty without a camera."""
        return {"pictures": list(self.names), "picture_size": self.size} if self.names else {}

    def check(self, tasks: Iterable[Task]) -> None:
        """Refuse cameras that the scene of one of the tasks does not have, before any episode is played.

        Raises:
            UnknownNameError: A scene has no such camera.
            InputError: A world has no scene to draw, the scenes have no camera in common, or one cannot draw
                pictures of this size.
        """
        names, sizes = [], []
        with closing(Lanes(1)) as lanes:
            for task in dict.fromkeys(tasks):
                lanes.reset([0], [0], [task])
                model = _drawable(lanes, 0, task).model
                names.append({model.camera(number).name for number in range(model.ncam)})
                sizes.append(min(model.vis.global_.offwidth, model.vis.global_.offheight))
        common = set.intersection(*names) - {""}
        for name in self.names:
            if not common:
                raise InputError(f"There is no camera {name!r}: the scenes of the tasks share no camera.")
            if name not in common:
                raise unknown("camera in the scenes of all tasks", name, common)
        if self.size > min(sizes):
            raise InputError(f"The scenes draw pictures of at most {min(sizes)} pixels, not {self.size}.")

    def draw(self, lanes: Lanes, lane: int, task: Task) -> dict[str, NDArray[np.uint8]]:
        """Return the pictures (N, N, 3) of one lane, upright, by camera.

        Raises:
            RenderingError: This machine cannot draw.
        """
        model, data, _ = _drawable(lanes, lane, task)
        renderer, pictures = self._renderer(model), {}
        for name in self.names:
            renderer.update_scene(data, camera=name)
            pictures[name] = renderer.render().copy()
        return pictures

    def _renderer(self, model: mujoco.MjModel) -> mujoco.Renderer:
        """Return the renderer of a scene, which is made on first use."""
        if id(model) not in self._renderers:
            draw_without_display()
            import mujoco

            try:
                renderer = mujoco.Renderer(model, self.size, self.size)
            except Exception as error:  # a back end raises errors of its own
                raise RenderingError(
                    f"This machine cannot draw ({error}): `clbench doctor` says what is missing."
                ) from error
            self._renderers[id(model)] = model, renderer  # while the scene is kept, its id is not reused
        return self._renderers[id(model)][1]

    def close(self) -> None:
        """Free all renderers."""
        for _, renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()


def _drawable(lanes: Lanes, lane: int, task: Task) -> Drawable:
    """Return what the pictures of a lane are drawn from."""
    drawable = getattr(lanes.world(task), "drawable", None)
    if drawable is None:
        raise InputError(
            f"The task {task.name!r} has no pictures: the vector world of {task.world} has no drawable()."
        )
    found: Drawable = drawable(lane)
    return found
