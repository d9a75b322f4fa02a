"""Prior data ends with the hooks that a method declared it for."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest
from tiny import TINY

from clbench.learning.method import Method
from clbench.learning.prior import Prior, Uses
from clbench.policy.policy import Policy
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec


@dataclasses.dataclass
class Keeps(Method):
    """Keeps from prepare() what it declared for prepare() alone."""

    uses = Uses(demonstrations="prepare")
    kept: ClassVar[list[Any]] = []

    def prepare(self, policy: Policy, prior: Prior) -> None:
        self.kept.append(prior.demonstrations)

    def batch(self, target: Any, prior: Prior) -> Any:
        return self.kept[0].sample(4)


@dataclasses.dataclass
class KeepsStage(Method):
    """Keeps the prior data of the first stage for the second."""

    uses = Uses(demonstrations="throughout")
    kept: ClassVar[list[Any]] = []

    def batch(self, target: Any, prior: Prior) -> Any:
        self.kept.append(prior.demonstrations)
        return self.kept[0].sample(4)


@pytest.mark.parametrize(
    ("cls", "where"), [(Keeps, "batch() of stage 1 (right)"), (KeepsStage, "batch() of stage 2 (down)")]
)
def test_prior_data_cannot_be_kept_beyond_its_hooks(
    cls: Any, where: str, stranger: Callable[[type[Method]], str], tmp_path: Path
) -> None:
    cls.kept.clear()
    record = execute(RunSpec(TINY.id, stranger(cls), 0), tmp_path)
    assert record.error is not None
    assert record.error["where"] == where
    assert "draws from data after the hooks that received it" in record.error["message"]
