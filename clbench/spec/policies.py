"""The kinds of policies, by name."""

from __future__ import annotations

from clbench.base.entry_points import unknown

POLICIES = {
    "flow": "flow matching: noise flows to a chunk of actions (pi0)",
    "discrete_diffusion": "masked action tokens are filled in, the surest first (Discrete Diffusion VLA)",
}
"""The action head of each kind."""

DEFAULT_POLICY = "flow"


def check_policy(name: str) -> None:
    """Refuse a kind of policy that does not exist.

    Raises:
        UnknownNameError: The message has the nearest name.
    """
    if name not in POLICIES:
        raise unknown("policy", name, POLICIES)
