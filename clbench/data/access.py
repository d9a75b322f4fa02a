"""Access rules: the data that the hooks of a stage must not see. Every run checks them.

The hooks of a method may use the objects that the runner passes to them, and no data of a later stage. They
may read the demonstrations of their own target, and of earlier tasks if `uses` declares it. They may run the
validation episodes of the same tasks: a policy that still knows a task can make demonstrations by playing it.
They may run no test episode and ask no test question. After `prepare`, each stage and `load_state`, the
policy must still have the normalisation of the retained skills, its vocabulary and its sizes.

These checks find mistakes. They do not stop a method that avoids the functions of clbench, see
`docs/guide/security.md`.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, NamedTuple

import torch

from clbench.base.errors import ClbenchError

if TYPE_CHECKING:
    from clbench.policy.policy import Policy
    from clbench.spec.protocol import Split


class _Rights(NamedTuple):
    """Tasks whose data the running hooks may use."""

    known: frozenset[str]
    """Names of the tasks that the hooks may know."""
    readable: frozenset[str]
    """Names of the tasks whose demonstrations the hooks may read and whose episodes they may run."""


_rights: ContextVar[_Rights | None] = ContextVar("rights", default=None)
"""Rights of the running hooks; None outside of hooks."""

_ours: ContextVar[BaseException | None] = ContextVar("ours", default=None)
"""Exception that leaves the runner's own code inside a hook."""

NORMALISATION = ("state_mean", "state_std", "action_mean", "action_std")
"""Buffers of a policy that hold the normalisation, which the demonstrations of pretraining determine."""


class LeakError(ClbenchError, RuntimeError):
    """A method used data that its stage must not know."""


class HookExitError(ClbenchError, RuntimeError):
    """A hook tried to end the process, which no method may do."""


@contextmanager
def hooks(known: Iterable[str], readable: Iterable[str]) -> Iterator[None]:
    """Restrict the code inside the block to the data of some tasks.

    Args:
        known: Names of the tasks that the code may know.
        readable: Names of the tasks whose demonstrations it may read and whose episodes it may run.

    Raises:
        HookExitError: The code raises something that is not an `Exception`, such as `SystemExit`, or raises
            `KeyboardInterrupt` where no Ctrl-C can have come.
    """
    token = _rights.set(_Rights(frozenset(known), frozenset(readable)))
    try:
        yield
    except Exception:
        raise
    except BaseException as error:
        if error is _ours.get() or (isinstance(error, KeyboardInterrupt) and _ctrl_c_comes_here()):
            raise
        raise HookExitError(f"The hook raised {type(error).__name__}({error}).") from error
    finally:
        _rights.reset(token)


def _ctrl_c_comes_here() -> bool:
    """Return whether a KeyboardInterrupt may be the user's: workers ignore Ctrl-C, threads never get it."""
    is_main = threading.current_thread() is threading.main_thread()
    return is_main and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN


@contextmanager
def outside() -> Iterator[None]:
    """Lift the restriction for the runner's own code that a hook calls."""
    token = _rights.set(None)
    try:
        yield
    except BaseException as error:
        _ours.set(error)
        raise
    finally:
        _rights.reset(token)


def check_demonstrations(task: str) -> None:
    """Refuse the demonstrations of a task that the running hooks must not read.

    Raises:
        LeakError: The task comes after their stage, or `uses` of the method does not declare its data.
    """
    _check_task(task, "reads demonstrations")


def check_episodes(episodes: Iterable[tuple[str, Split]]) -> None:
    """Refuse all episodes to the running hooks, except validation episodes of tasks that they may read.

    Args:
        episodes: Task and split of each episode.

    Raises:
        LeakError: An episode is refused.
    """
    if _rights.get() is None:
        return
    for task, split in episodes:
        if split != "validation":
            raise LeakError(f"The method runs {split} episodes of {task}: no choice may depend on them.")
        _check_task(task, "runs episodes")


def _check_task(task: str, does: str) -> None:
    rights = _rights.get()
    if rights is None or task in rights.readable:
        return
    why = "its `uses` does not declare" if task in rights.known else "its stage must not know yet"
    raise LeakError(f"The method {does} of {task}, which {why}.")


def check_questions() -> None:
    """Refuse all questions, training and test, to the running hooks.

    Raises:
        LeakError: Hooks are running.
    """
    if _rights.get() is not None:
        raise LeakError(
            "The method loads the questions itself, the test questions too: use `prior.questions`."
        )


def check_policy(policy: Policy, pretrained: Policy) -> None:
    """Check that a policy still reads states and words as it did in pretraining.

    Args:
        policy: Policy after a hook.
        pretrained: Policy after pretraining, on the same device.

    Raises:
        LeakError: The normalisation, the vocabulary or another size of the policy has changed.
    """
    if policy.config != pretrained.config:
        raise LeakError("The method changes the vocabulary or a size of the policy: all stages share them.")
    for name in NORMALISATION:
        if not torch.equal(getattr(policy, name), getattr(pretrained, name)):
            raise LeakError(f"The method changes {name}: the normalisation is fixed in pretraining.")
