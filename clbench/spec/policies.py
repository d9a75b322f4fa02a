"""Names of policies: kinds and sizes.

A name is a built-in kind, such as "flow". A size other than the smallest follows after a dash, such as
"flow-base". A class of your own has the name "module:Class".
"""

from __future__ import annotations

from clbench.base.entry_points import class_hint, is_entry_point, unknown
from clbench.base.errors import InputError, UnknownNameError, WrongTypeError
from clbench.base.source import package_of, source_hash
from clbench.base.text import did_you_mean
from clbench.spec.fields import LONGEST

POLICIES = {
    "flow": "flow matching: noise flows to a chunk of actions (pi0)",
    "discrete_diffusion": "masked action tokens are filled in, the surest first (Discrete Diffusion VLA)",
}
"""The action head of each built-in kind."""

DEFAULT_POLICY = "flow"

SIZES: dict[str, tuple[int, int] | None] = {"small": None, "base": (256, 4), "large": (512, 9)}
"""Channels of a token, and layers of backbone and head, by size. The small policy takes both from the budget.
On Fetch-v1 it has 0.7 million parameters, base has 5 million and large 40 million."""

SMALL = "small"


def policy_names() -> list[str]:
    """Return the names of all built-in policies."""
    return [policy_name(kind, size) for kind in POLICIES for size in SIZES]


def policy_name(kind: str, size: str = SMALL) -> str:
    """Return the name of a policy of some kind and size, for example "flow-base".

    Raises:
        UnknownNameError: There is no such size; the message has the nearest one.
        InputError: The kind has no sizes.
    """
    if size not in SIZES:
        raise unknown("size of a policy", size, SIZES)
    if size != SMALL and kind not in POLICIES:
        raise InputError(f"Only {' and '.join(POLICIES)} have sizes; {kind} cannot have the size {size}.")
    return kind if size == SMALL else f"{kind}-{size}"


def kind_of(policy: str) -> str:
    """Return the kind of a policy: a key of `POLICIES`, or "module:Class"."""
    return policy if ":" in policy else policy.partition("-")[0]


def size_of(policy: str) -> tuple[int, int] | None:
    """Return the channels and layers of a policy, None if the budget gives them."""
    return None if ":" in policy else SIZES[policy.partition("-")[2] or SMALL]


def is_built_in(policy: str) -> bool:
    """Return whether a policy is one of ours."""
    return kind_of(policy) in POLICIES


def check_policy_name(name: str) -> None:
    """Refuse a text that is neither the name of a built-in policy nor of the form "module:Class".

    Raises:
        WrongTypeError: The name is not a text but, for example, the class itself.
        UnknownNameError: No policy has this name; the message has the nearest one.
    """
    if not isinstance(name, str):
        raise WrongTypeError(f"A policy is given by a name, such as 'module:Class', not by {name!r}.")
    is_class = len(name) <= LONGEST and name.isascii() and is_entry_point(name)
    if name not in policy_names() and not is_class:
        raise _unknown_policy(name)


def _unknown_policy(name: str) -> UnknownNameError:
    """Return the error for a name that no policy has, with what was probably meant."""
    known = policy_names()
    if "://" in name:
        hint = " `clbench score` plays a policy behind a server: docs/guide/external.md."
    else:
        hint = did_you_mean(name, known) or class_hint(name)
    return unknown("policy", name, [*known, "module:Class"], hint)


def policy_packages(policy: str) -> list[str]:
    """Return the package, or module, of a policy in a list, which is empty if the policy is built in."""
    return [] if is_built_in(policy) else [package_of(policy)]


def policy_source(policy: str) -> str | None:
    """Return the hash of the code of a policy's package, or module; None if the policy is built in."""
    packages = policy_packages(policy)
    return source_hash(*packages) if packages else None
