"""Checks of a criterion: they play on until their outcome is certain, and no further."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from clbench.evaluation.checks import Checker
from clbench.policy.policy import Policy
from clbench.records.record import CheckRow
from clbench.runs.spec import describe_scenario
from clbench.spec.language import encode
from clbench.spec.protocol import Point
from clbench.testing import TOY
from clbench.testing.small import SMALL

FIVE = replace(TOY, budget=replace(TOY.budget, criterion=0.6, validation_episodes=5))
"""The toy with a criterion of three successes in five episodes. Two of an episode's wordings take turns."""


class Obeying(Policy):
    """A policy that does as it is told in some wordings, and otherwise stays where it is."""

    understood: tuple[str, ...] = ()

    def act(self, state: Tensor, words: Tensor, noise: Tensor, image: Tensor | None = None) -> Tensor:
        known = encode(self.understood or ("go nowhere",), words.shape[1])
        does = (torch.as_tensor(words)[:, None] == torch.as_tensor(known)[None]).all(dim=2).any(dim=1)
        left = torch.zeros_like(noise)
        left[does, :, 0] = -1.0
        return left

    def action_loss(self, *_: Any) -> Tensor:
        raise NotImplementedError

    predict = action_loss  # type: ignore[assignment]


@pytest.mark.parametrize(
    ("understood", "episodes", "successes"),
    [
        (("go left", "move to the left"), 3, 3),  # three successes meet the criterion
        (("go left",), 3, 3),  # episodes 0, 2 and 4 end in 4 steps, the others fail after 12
        (("move to the left",), 5, 2),  # after two failures the fifth episode decides
        ((), 3, 0),  # three failures leave two episodes, one too few
    ],
)
def test_a_check_ends_when_its_outcome_is_certain(
    understood: tuple[str, ...], episodes: int, successes: int
) -> None:
    checker, policy = Checker(FIVE, describe_scenario(FIVE).protocol(), seed=0), Obeying(SMALL)
    policy.understood = understood
    row = checker.check(policy, FIVE.task("left"), Point(1, 4))
    checker.close()
    assert row == CheckRow(1, 4, episodes, successes)
    assert checker.is_learned(row) == (successes >= 3)
