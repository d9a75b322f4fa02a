"""What clauses of both contracts share: their error, and checks of a policy by its actions."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from clbench.base.seeding import draws_restored
from clbench.base.text import counted
from clbench.policy.batch import Batch
from clbench.policy.policy import Policy
from clbench.testing.global_state import same

PAGE = "docs/guide/contract.md"
"""Page that describes the contract of a method, with a heading for each clause."""

ROUNDING = 1e-4
"""Greatest change of an action, from -1 to 1, that rounding may cause, as when adapters are merged."""

SHIFT = 0.1
"""Number that is added to all weights of a policy whose copy must not notice it."""


class ContractError(AssertionError):
    """A method, or a policy, breaks its public contract.

    Args:
        clause: Name of the clause, for example "same numbers": a heading of the page.
        expected: Expected behaviour.
        found: Actual behaviour.
        look: Place in the class to look at, for example "loss()".
        subject: What breaks it: "method" or "policy".
        page: Page that describes the contract.
    """

    def __init__(
        self, clause: str, expected: str, found: str, look: str, subject: str = "method", page: str = PAGE
    ) -> None:
        super().__init__(clause, expected, found, look, subject, page)
        self.clause, self.expected, self.found, self.look = clause, expected, found, look
        self.subject, self.page = subject, page

    def __str__(self) -> str:
        return (
            f"The {self.subject} breaks the contract: {self.clause}.\n"
            f"  expected: {self.expected}\n"
            f"  found:    {self.found}\n"
            f"  look at:  {self.look}; {self.page}#{self.clause.replace(' ', '-')}"
        )


@dataclass(frozen=True, eq=False)
class Check:
    """One clause of a contract for one subject; call it to check."""

    clause: Callable[[Any], None]
    """Clause, one of the contract's `CLAUSES`."""
    subject: Any
    """Method or policy to check."""

    def __call__(self) -> None:
        """Check the clause.

        Raises:
            ContractError: The subject breaks the clause.
        """
        self.clause(self.subject)

    def __str__(self) -> str:
        return self.clause.__name__


# ---- actions of a policy -----------------------------------------------------------------------------------


def actions_of(policy: Policy, batch: Batch) -> Tensor:
    """Return the actions (B, H, A) of a policy, asked as every run asks for them."""
    with draws_restored():
        return policy.act(batch.state, batch.words, batch.noise, batch.image)


def moved(before: Tensor, after: Tensor) -> bool:
    """Return whether actions differ. Actions that are not finite do not count: another check names them."""
    finite = bool(torch.isfinite(after).all())
    return finite and not torch.allclose(before, after, rtol=0.0, atol=ROUNDING)


def check_ends(merges: bool, whole_stages: bool) -> None:
    """Check that a stage leaves the policy that its checks play.

    Args:
        merges: Whether `end_task` changed the actions of the policy.
        whole_stages: What the class declares.

    Raises:
        ContractError: The checks play the policy as it is before `end_task`, and the stage leaves another.
    """
    if merges and not whole_stages:
        expected = (
            "`whole_stages = True` in a class whose end_task() changes the actions of the policy: without "
            "it, a criterion is checked on the policy before end_task(), which is not the one that is scored"
        )
        found = "whole_stages is False, and end_task() changes the actions"
        raise ContractError("criterion", expected, found, "whole_stages and end_task()")


def check_steps_at_end(steps: int) -> None:
    """Check that no policy is trained in `end_task` where a criterion ends the stage.

    Args:
        steps: Optimiser steps in a call of `end_task` that changed the actions of the policy.

    Raises:
        ContractError: There were steps.
    """
    if steps:
        expected = (
            "end_task() to change the policy without training where a criterion ends the stage: each check "
            "plays the policy that end_task() would leave, and its steps do not count as steps to the "
            "criterion. Train in the steps of the loop"
        )
        found = f"end_task() changes the actions, with {counted(steps, 'optimiser step')}"
        raise ContractError("criterion", expected, found, "end_task()")


def check_copy(policy: Policy, batch: Batch) -> None:
    """Check that a deep copy of a policy acts with its own weights.

    Args:
        policy: Policy after a stage. Its weights change, and are as before when this returns.
        batch: Samples to act on.

    Raises:
        ContractError: The policy cannot be copied, or its copy acts with the weights of the original.
    """
    try:
        twin = copy.deepcopy(policy)
    except Exception as error:
        expected = "a policy that copy.deepcopy() can copy: detach the tensors that it keeps"
        found = f"{type(error).__name__}: {error}"
        raise ContractError("sound hooks", expected, found, "prepare() and load_state()") from error
    before = actions_of(twin, batch)
    with _shifted(policy):
        follows = moved(before, actions_of(twin, batch))
    if follows:
        expected = (
            "a deep copy of the policy to act with its own weights: functions that are added to the policy "
            "must take it, or the layer, from their arguments"
        )
        found = "its actions change with the weights of the original, as in a function that closes over it"
        raise ContractError("sound hooks", expected, found, "prepare() and load_state()")


def check_step_factor(first: Mapping[str, Tensor], slower: Mapping[str, Tensor], factor: float) -> None:
    """Check that tuning can choose the learning rate.

    Args:
        first: Weights after a stage.
        slower: The same weights after the same stage with `factor` times the step_factor.
        factor: The factor.

    Raises:
        ContractError: All weights are equal.
    """
    if first.keys() == slower.keys() and all(same(value, slower[name]) for name, value in first.items()):
        expected = (
            "other weights with a smaller step_factor, which tuning tries for every method: multiply the "
            "learning rate of your own steps by self.step_factor, or take the one that learning_rate() gets"
        )
        found = f"the same weights with {factor} times the step_factor"
        raise ContractError("learning", expected, found, "learning_rate(), and steps of your own")


@contextmanager
def _shifted(policy: Policy) -> Iterator[None]:
    """Add `SHIFT` to all weights of a policy in the block."""
    weights = [one for one in policy.state_dict().values() if one.is_floating_point()]
    kept = [one.clone() for one in weights]
    for one in weights:
        one.add_(SHIFT)
    try:
        yield
    finally:
        for one, value in zip(weights, kept, strict=True):
            one.copy_(value)
