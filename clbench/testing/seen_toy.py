"""The toy as a camera sees it: how high the point is, and where the marker lies, only the picture shows.

Ask for it as "clbench.testing.seen_toy:clbench/SeenToy-v0".
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
