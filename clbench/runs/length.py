"""Length of a run in optimiser steps, from which a progress bar estimates the time left."""

from __future__ import annotations

from clbench.spec.protocol import EPISODE_WEIGHT, Point, Protocol
from clbench.spec.scenario import Scenario


def run_length(scenario: Scenario, protocol: Protocol) -> float:
    """Return the length of a whole run.

    Args:
        scenario: Scenario with the targets that are learned.
        protocol: Evaluation protocol of the run.
    """
    points = (point for stage in protocol.stages for point in protocol.points(stage))
    return training_length(scenario) + sum(point_length(protocol, point) for point in points)


def training_length(scenario: Scenario) -> float:
    """Return the length of a run without its evaluation."""
    return float(len(scenario.target) * scenario.budget.adaptation_steps)


def point_length(protocol: Protocol, point: Point) -> float:
    """Return the length of the evaluation at one point."""
    return EPISODE_WEIGHT * len(protocol.episodes(point))
