import dataclasses
import re
from collections.abc import Callable
from typing import Any, Self

import pytest
from torch import Tensor

from clbench.learning.hooks import HOOKS, place_of
from clbench.learning.method import Method
from clbench.learning.registry import load_method
from clbench.policy.policy import Policy

Stranger = Callable[[type[Method]], str]


@dataclasses.dataclass
class Misspelt(Method):
    """Would run as plain fine-tuning."""

    def gradient(self, policy: Policy, loss: Tensor) -> None:
        raise AssertionError("nothing calls this function")


@dataclasses.dataclass
class Deep(Misspelt):
    """Inherits the misspelt hook."""


@dataclasses.dataclass
class Foreign(Method):
    """Has a hook of another library."""

    def on_train_start(self) -> None:
        raise AssertionError("nothing calls this function")


@dataclasses.dataclass
class Short(Method):
    """Takes too few arguments."""

    def loss(self, policy: Policy, batch: Any) -> Any:  # type: ignore[override]
        return policy.action_loss(batch).mean()


@dataclasses.dataclass
class Kept(Method):
    """Has a hyper-parameter of a hook's name."""

    state: float = 0.5  # type: ignore[assignment]


@dataclasses.dataclass
class Needy(Method):
    """Needs an ability, and no tuple of abilities."""

    needs = "answers"  # type: ignore[assignment]


@dataclasses.dataclass
class Undeclared(Method):
    """Declares its data by a word."""

    uses = "prepare"  # type: ignore[assignment]


@dataclasses.dataclass
class Helpful(Method):
    """Has a public helper, which a hook calls, and a private one, which nothing calls."""

    def end_task(self, policy: Policy, stage: Any) -> None:
        self.losses(policy)

    def losses(self, policy: Policy) -> None:
        """Do nothing."""

    @property
    def strength(self) -> float:
        """Is what a helper of a property returns."""
        return self.scale()

    def scale(self) -> float:
        """Return a number."""
        return 0.5

    def _plot(self) -> None:
        """Do nothing."""


@dataclasses.dataclass
class Wrapped(Method):
    """Passes all arguments on."""

    def loss(self, *arguments: Any, **named: Any) -> Tensor:
        return super().loss(*arguments, **named)


def test_the_hooks_are_all_public_functions_of_the_class() -> None:
    public = {name for name, value in vars(Method).items() if callable(value) and not name.startswith("_")}
    assert set(HOOKS) == public


@pytest.mark.parametrize(
    ("cls", "message"),
    [
        (Misspelt, "nothing calls gradient(). Did you mean 'gradients()'? Names of helpers begin with _."),
        (Deep, "nothing calls gradient(). Did you mean 'gradients()'? Names of helpers begin with _."),
        (Foreign, "nothing calls on_train_start()."),
        (Short, "loss() must take (self, policy, batch, progress), not (self, policy, batch)."),
        (Kept, "state() must take (self), not the value 0.5."),
        (Needy, "needs must be a tuple of abilities of a policy, not 'answers'."),
        (Undeclared, "uses must be a Uses, not 'prepare'."),
    ],
)
def test_a_hook_or_a_declaration_that_the_loop_cannot_use_is_refused_before_the_run(
    cls: type[Method], message: str, stranger: Stranger
) -> None:
    with pytest.raises(TypeError, match=re.escape(message)):
        load_method(stranger(cls))


@pytest.mark.parametrize("cls", [Helpful, Wrapped])
def test_a_method_with_helpers_or_a_hook_of_any_arguments_loads(
    cls: type[Method], stranger: Stranger
) -> None:
    assert load_method(stranger(cls)) is cls


class Failing(Method):
    """Fails in a helper of a hook."""

    def end_task(self, policy: Any, stage: Any) -> None:
        self._merge()

    def _merge(self) -> None:
        raise RuntimeError("cannot merge")

    def prepare(self, policy: Any, prior: Any) -> int:
        return self.batch(policy, prior)  # type: ignore[no-any-return]

    def batch(self, target: Any, prior: Any) -> Any:
        raise RuntimeError("no batch")


class Unrelated:
    """Has a function with the name of a hook."""

    def loss(self) -> Self:
        raise RuntimeError("no loss")


@pytest.mark.parametrize(
    ("call", "place", "expected"),
    [
        (lambda: Failing().end_task(None, None), "stage 1 (push)", "end_task() of stage 1 (push)"),
        (lambda: Failing().prepare(None, None), "prepare", "prepare"),
        (lambda: Failing().batch(None, None), "stage 1 (batch)", "batch() of stage 1 (batch)"),
        (
            lambda: Failing().load_state(None, {"a": 1}),  # type: ignore[arg-type]
            "load_state() after stage 0",
            "load_state() after stage 0",
        ),
        (lambda: Unrelated().loss(), "stage 2 (reach)", "stage 2 (reach)"),
    ],
)
def test_the_place_of_an_error_names_the_hook_that_the_loop_called(
    call: Callable[[], object], place: str, expected: str
) -> None:
    with pytest.raises((RuntimeError, TypeError)) as raised:
        call()
    assert place_of(raised.value, place) == expected
