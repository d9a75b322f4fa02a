"""The kinds of policies: from a name to a class."""

from __future__ import annotations

from collections.abc import Iterable

from clbench.base.entry_points import resolve, unknown
from clbench.base.errors import InputError, WrongTypeError
from clbench.policy.policy import ABILITIES, Policy, PolicyConfig
from clbench.policy.transformer import TransformerPolicy
from clbench.spec.policies import POLICIES, check_policy_name


def policy_class(kind: str) -> type[Policy]:
    """Return the class of a kind of policy: a built-in name, or "module:Class", which is imported.

    Raises:
        UnknownNameError: There is no such kind.
        WrongTypeError: The object of this name is not a policy.
    """
    if kind in POLICIES:
        return TransformerPolicy
    check_policy_name(kind)
    cls = resolve(kind)
    if not (isinstance(cls, type) and issubclass(cls, Policy)):
        raise WrongTypeError(f"{kind!r} is not a subclass of clbench.Policy.")
    return cls


def new_policy(config: PolicyConfig, seed: int = 0) -> Policy:
    """Return a policy of the configured kind, with initial weights that depend on the seed alone."""
    return policy_class(config.kind)(config, seed)


def check_abilities(kind: str, needs: Iterable[str], method: str) -> None:
    """Refuse a policy that lacks what a method needs.

    Args:
        kind: Kind of the policy.
        needs: Abilities that the method needs.
        method: Name of the method, for the message.

    Raises:
        UnknownNameError: The method needs an ability that does not exist, or the policy declares one.
        WrongTypeError: The abilities of the policy are not a set.
        InputError: The policy lacks some of the abilities.
    """
    offered = policy_class(kind).abilities
    if not isinstance(offered, frozenset | set):
        raise WrongTypeError(f"{kind}: abilities must be a set of texts, not {offered!r}.")
    for ability in (*needs, *offered):
        if ability not in ABILITIES:
            raise unknown("ability of a policy", ability, ABILITIES)
    missing = sorted(set(needs) - offered)
    if missing:
        raise InputError(
            f"{method} needs a policy with the abilities {', '.join(sorted(needs))}; {kind} lacks "
            f"{', '.join(missing)}. Built-in policies have all abilities; a class declares its own as "
            "`abilities`: docs/guide/your_policy.md#abilities."
        )
