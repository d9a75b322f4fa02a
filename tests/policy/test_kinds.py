"""Kinds of policies: what a method needs, and what a policy offers."""

from typing import Any, ClassVar

import pytest

from clbench.base.errors import ClbenchError, InputError, UnknownNameError, WrongTypeError
from clbench.policy.kinds import check_abilities
from clbench.policy.transformer import TransformerPolicy


class Mute(TransformerPolicy):
    """Has no ability."""

    abilities = frozenset()


class Listing(TransformerPolicy):
    """Lists its abilities, which are to be a set."""

    abilities: ClassVar[Any] = ("answers",)


class Misspelt(TransformerPolicy):
    """Declares an ability that does not exist."""

    abilities = frozenset({"hidden_state"})


@pytest.mark.parametrize(
    ("kind", "needs", "error", "message"),
    [
        (
            f"{__name__}:Mute",
            ("answers",),
            InputError,
            "mine needs .* answers; .*:Mute lacks answers",
        ),
        (f"{__name__}:Listing", ("answers",), WrongTypeError, r"must be a set of texts, not \('answers',\)"),
        (f"{__name__}:Misspelt", (), UnknownNameError, "'hidden_state'. Did you mean 'hidden_states'"),
        ("flow", ("answer",), UnknownNameError, "No ability of a policy .* 'answer'. Did you mean 'answers'"),
    ],
)
def test_a_policy_without_what_a_method_needs_is_refused(
    kind: str, needs: tuple[str, ...], error: type[ClbenchError], message: str
) -> None:
    with pytest.raises(error, match=message):
        check_abilities(kind, needs, "mine")


def test_a_built_in_policy_has_what_any_method_may_need() -> None:
    check_abilities("discrete_diffusion", ("answers", "hidden_states"), "mine")
