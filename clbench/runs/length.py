"""Length of a run in optimiser steps, from which a progress bar estimates the time left."""

from __future__ import annotations

from typing import TYPE_CHECKING

from clbench.spec.protocol import EPISODE_WEIGHT, Point, Protocol
from clbench.spec.scenario import Scenario

if TYPE_CHECKING:
    from clbench.learning.method import Method


def run_length(scenario: Scenario, protocol: Protocol) -> float:
    """Return the length of a whole run.

    Args:
        scenario: Scenario with the targets that are learned.
        protocol: Evaluation protocol of the run.
    """
    points = (point for stage in protocol.stages for point in protocol.points(stage))
    evaluation = sum(point_length(protocol, point) for point in points)
    return training_length(scenario) + evaluation + relearning_length(protocol)


def pretraining_length(scenario: Scenario) -> float:
    """Return the length of pretraining a policy; if it sees pictures, its vision is pretrained before it."""
    from clbench.learning.pretraining import vision_steps

    return float(scenario.budget.pretraining_steps + vision_steps(scenario))


def watching_length(method: type[Method], scenario: Scenario) -> float:
    """Return the length of the pretraining repeated for a method that watches it, 0 for other methods."""
    from clbench.learning.watching import watches

    return float(scenario.budget.pretraining_steps) if watches(method) else 0.0


def training_length(scenario: Scenario) -> float:
    """Return the length of a run without its evaluation."""
    return float(len(scenario.target) * scenario.budget.adaptation_steps)


def point_length(protocol: Protocol, point: Point) -> float:
    """Return the length of the evaluation at one point."""
    captured = protocol.captured_episodes if point.stage and protocol.is_end(point) else 0
    return EPISODE_WEIGHT * (len(protocol.episodes(point)) + captured)


def relearns(protocol: Protocol) -> bool:
    """Return whether a run ends with relearning, see `clbench.runs.relearning`.

    Tuning runs skip it, because no choice depends on it.
    """
    if protocol.criterion is None or protocol.split != "test":
        return False
    return bool(protocol.retained and protocol.target)


def relearning_length(protocol: Protocol) -> float:
    """Return the length of relearning, 0 if the run skips it."""
    if not relearns(protocol):
        return 0.0
    return protocol.steps[-1] + EPISODE_WEIGHT * len(protocol.retained) * protocol.validation_episodes
