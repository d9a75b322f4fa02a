"""Checks of a stage's criterion: whether the policy has learned a task."""

from __future__ import annotations

from clbench.evaluation.episodes import Episode, Trial
from clbench.evaluation.rollouts import Evaluator
from clbench.policy.policy import Policy
from clbench.records.record import CheckRow
from clbench.spec.protocol import Point, Protocol
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task


class Checker:
    """Checks on validation episodes, during the stages of a run, whether their targets are learned.

    Args:
        scenario: Scenario with the targets that are learned.
        protocol: Evaluation protocol of the run, with or without a criterion.
        seed: Seed of the run: it chooses the initial states, the same at every check and for all methods.
    """

    def __init__(self, scenario: Scenario, protocol: Protocol, seed: int) -> None:
        self._protocol = protocol
        self._steps = frozenset(scenario.budget.check_steps)
        # most checks fail, and a failed one ends with this many failures: 3 with a goal of 18 out of 20
        failures = 1 if protocol.criterion is None else protocol.validation_episodes - protocol.goal + 1
        self._evaluator = Evaluator(scenario, seed, lanes=failures)

    def close(self) -> None:
        """Close all worlds."""
        self._evaluator.close()

    def is_due(self, point: Point) -> bool:
        """Return whether the criterion is checked at `point`."""
        return point.step in self._steps

    def check(self, policy: Policy, task: Task, point: Point) -> CheckRow:
        """Play a task's validation episodes until it is certain whether `policy` meets the criterion."""
        count, goal = self._protocol.validation_episodes, self._protocol.goal
        successes = failures = 0

        def certain(episode: Episode) -> bool:
            nonlocal successes, failures
            successes, failures = successes + episode.success, failures + (not episode.success)
            return successes >= goal or failures > count - goal

        episodes = self._evaluator.play(
            policy, [Trial(task, "validation", number) for number in range(count)], enough=certain
        )
        return CheckRow(*point, len(episodes), successes)

    def is_learned(self, row: CheckRow) -> bool:
        """Return whether a check met the criterion."""
        return self._protocol.is_learned(row.successes)
