"""Sources of data: a twin draws what comes next, and closes with its source."""

from typing import Any

import pytest
import torch

from clbench.base.errors import InputError
from clbench.learning.prior import Prior, Source, UndeclaredAccessError, Uses, begin_step, twin_of


class Numbers:
    """Data whose samples are random numbers."""

    bytes = 8

    def __len__(self) -> int:
        return 1

    def sample(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """Return `count` numbers."""
        return torch.rand(count, generator=generator)


def numbers() -> Any:
    """Return the data, which are no batches."""
    return Numbers()


def test_a_twin_draws_what_its_source_would_draw_next_and_leaves_it_alone() -> None:
    source = Source(numbers(), torch.Generator().manual_seed(1), 4)
    source.sample(3)
    twin = twin_of(source)
    assert twin.sample(5).equal(source.sample(5))


def test_a_twin_closes_with_its_source() -> None:
    source = Source(numbers(), torch.Generator(), 4)
    twin = twin_of(source)
    source.close()
    with pytest.raises(UndeclaredAccessError, match="after the hooks that received it"):
        twin.sample(1)


def test_prior_data_close_together() -> None:
    sources = {name: Source(numbers(), torch.Generator(), 4) for name in ("demonstrations", "questions")}
    Prior(sources).close()
    for source in sources.values():
        with pytest.raises(UndeclaredAccessError, match="after the hooks that received it"):
            source.sample(1)


def test_what_a_step_leaves_is_not_carried_over_to_the_next_one() -> None:
    source = Source(numbers(), torch.Generator(), 4)
    for count in (3, 4, 1):
        begin_step(source)
        source.sample(count)
    with pytest.raises(UndeclaredAccessError, match="draws 5 samples of the target in a step"):
        source.sample(4)


def test_a_negative_number_of_samples_is_refused_and_buys_no_others() -> None:
    source = Source(numbers(), torch.Generator(), 4)
    with pytest.raises(InputError, match="number of samples must be at least 0, not -100"):
        source.sample(-100)


@pytest.mark.parametrize("name", ["demonstrations", "questions"])
def test_another_access_than_the_three_is_refused(name: str) -> None:
    with pytest.raises(InputError, match=f"Uses.{name} must be one of 'never', 'prepare', .*, not 'always'"):
        Uses(**{name: "always"})  # type: ignore[arg-type]
