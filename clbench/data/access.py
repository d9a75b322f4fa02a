"""Leaks: what the hooks of a stage must not know. Every run is held to it.

While a method's hooks run, they may touch what the runner hands to them and nothing that is later than their
stage: demonstrations and validation episodes of tasks up to this one, and no report at all. After each of them
the policy must still have the normalisation of the retained skills, its vocabulary and its sizes.

This finds mistakes. A method that goes around the functions of clbench is not held by it: `docs/guide/security.md`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING

import torch

from clbench.base.errors import ClbenchError

if TYPE_CHECKING:
    from clbench.policy.policy import Policy
    from clbench.spec.protocol import Split

_known: ContextVar[frozenset[str] | None] = ContextVar("known", default=None)
"""Names of the tasks that the hooks under way may know; None outside of them."""

NORMALISATION = ("state_mean", "state_std", "action_mean", "action_std")
"""Buffers of a policy that come from the demonstrations of the retained skills alone."""


class LeakError(ClbenchError, RuntimeError):
    """A method touched what its stage must not know."""


@contextmanager
def hooks(known: Iterable[str]) -> Iterator[None]:
    """Hold the code inside to what the tasks called `known` may tell it."""
    token = _known.set(frozenset(known))
    try:
        yield
    finally:
        _known.reset(token)


@contextmanager
def outside() -> Iterator[None]:
    """Let the runner's own code, called from within a hook, touch everything."""
    token = _known.set(None)
    try:
        yield
    finally:
        _known.reset(token)


def check_demonstrations(task: str) -> None:
    """Refuse the demonstrations of a task that is later than the hooks under way.

    Raises:
        LeakError: It is.
    """
    known = _known.get()
    if known is not None and task not in known:
        raise LeakError(f"The method reads demonstrations of {task}, which its stage must not know yet.")


def check_episodes(episodes: Iterable[tuple[str, Split]]) -> None:
    """Refuse all but validation episodes, and those of a later task, to the hooks under way.

    Args:
        episodes: Task and split of each.

    Raises:
        LeakError: One of them is refused.
    """
    known = _known.get()
    if known is None:
        return
    for task, split in episodes:
        if split != "validation":
            raise LeakError(f"The method runs {split} episodes of {task}: nothing may be chosen on them.")
        if task not in known:
            raise LeakError(f"The method runs episodes of {task}, which its stage must not know yet.")


def check_questions() -> None:
    """Refuse the questions, those of the report among them, to the hooks under way.

    Raises:
        LeakError: Hooks are under way.
    """
    if _known.get() is not None:
        raise LeakError("The method loads questions by itself, those of the report too: `prior` has its own.")


def check_policy(policy: Policy, pretrained: Policy) -> None:
    """Check that a policy sees states and words as it was pretrained to.

    Args:
        policy: As a hook left it.
        pretrained: As pretraining left it, on the retained skills alone; on the same device.

    Raises:
        LeakError: Its normalisation, its vocabulary or another of its sizes has changed.
    """
    if policy.config != pretrained.config:
        raise LeakError("The method changes the vocabulary or a size of the policy: all stages share them.")
    for name in NORMALISATION:
        if not torch.equal(getattr(policy, name), getattr(pretrained, name)):
            raise LeakError(
                f"The method changes {name}: the normalisation comes from the retained skills alone."
            )
