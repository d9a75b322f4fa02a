"""Descriptions of methods from their code."""

import dataclasses

from clbench.base.entry_points import resolve
from clbench.learning.method import Method

describe = resolve("clbench.leaderboard.views.descriptions:describe")


@dataclasses.dataclass
class Layered(Method):
    """Has hyper-parameters of every form."""

    layers: list[int] = dataclasses.field(default_factory=lambda: [1, 2])
    """Layers that it trains."""
    rank: int = dataclasses.field(kw_only=True)
    """Rank of each change."""
    share: float = 0.5
    """Share of the old samples."""


def test_hyper_parameters_with_a_factory_and_without_a_default_are_listed_too() -> None:
    found = describe("layered", Layered).hyper_parameters
    assert [dataclasses.astuple(one) for one in found] == [
        ("layers", "[1, 2]", "Layers that it trains."),
        ("rank", "must be given", "Rank of each change."),
        ("share", "0.5", "Share of the old samples."),
    ]
