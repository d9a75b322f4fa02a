"""The toy seen by a camera: only the picture shows the height of the point and the place of the marker.

Its name in a command is "clbench.testing.seen_toy:clbench/SeenToy-v0".
"""

from __future__ import annotations

import dataclasses

from clbench.spec.registry import register
from clbench.spec.task import Task
from clbench.testing.toy import TOY


def _seen(tasks: tuple[Task, ...]) -> tuple[Task, ...]:
    camera = "clbench.testing.toy_camera:ToyCamera"
    return tuple(dataclasses.replace(task, suite="seen-toy", camera=camera) for task in tasks)


SEEN_TOY = dataclasses.replace(
    TOY,
    id="clbench/SeenToy-v0",
    description="A point on a plane, seen through a camera; for tests.",
    retained=_seen(TOY.retained),
    target=_seen(TOY.target),
    held_out=_seen(TOY.held_out),
)

register(SEEN_TOY.id, "clbench.testing.seen_toy:SEEN_TOY")
