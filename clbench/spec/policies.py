"""The kinds of policies, by name."""

from __future__ import annotations

import re

from clbench.base.entry_points import unknown
from clbench.base.source import package_of

POLICIES = {
    "flow": "flow matching: noise flows to a chunk of actions (pi0)",
    "discrete_diffusion": "masked action tokens are filled in, the surest first (Discrete Diffusion VLA)",
}
"""The action head of each built-in kind."""

DEFAULT_POLICY = "flow"

_CLASS = re.compile(r"(?:[A-Za-z_]\w*\.)*[A-Za-z_]\w*:[A-Za-z_]\w*", re.ASCII)
_LONGEST = 100


def check_policy(name: str) -> None:
    """Refuse a text that is neither a built-in kind of policy nor of the form "module:Class".

    Raises:
        UnknownNameError: The message has the nearest name.
    """
    if name not in POLICIES and not (len(name) <= _LONGEST and _CLASS.fullmatch(name)):
        raise unknown("policy", name, [*POLICIES, "module:Class"])


def policy_packages(kind: str) -> list[str]:
    """Return the package, or module, of a policy that is not built in."""
    return [] if kind in POLICIES else [package_of(kind)]
