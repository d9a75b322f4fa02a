"""Prior data: what a method may touch of the tasks learned before, and when."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic, Literal, NoReturn, Protocol, TypeVar

import torch

from clbench.base.errors import ClbenchError
from clbench.policy.batch import Batch, QuestionBatch

Access = Literal["never", "prepare", "throughout"]
Rows = TypeVar("Rows", Batch, QuestionBatch)
Drawn = TypeVar("Drawn", Batch, QuestionBatch, covariant=True)


@dataclass(frozen=True)
class Uses:
    """Which prior data a method may touch, and when. The runner hands over nothing else."""

    demonstrations: Access = "never"
    """Of the retained skills and of the targets learned before; where there are none, the source is empty."""
    questions: Access = "never"
    """The training questions."""
    reference: bool = False
    """Whether this is no competitor but a guide: an upper or a lower bound, a baseline of transfer."""


class UndeclaredAccessError(ClbenchError, RuntimeError):
    """A method touched prior data that its `uses` does not declare."""


class Samples(Protocol[Drawn]):
    """Data that can be drawn from."""

    def __len__(self) -> int:
        """Return how many different moments or scenes there are."""

    def sample(self, count: int, generator: torch.Generator) -> Drawn:
        """Return `count` samples."""

    @property
    def bytes(self) -> int:
        """Memory that the data takes."""


class MissingDataError(ClbenchError, RuntimeError):
    """A method draws from data that is not there."""


class Nothing:
    """The demonstrations of no task: what was learned before the first target where nothing is retained."""

    bytes = 0

    def __len__(self) -> int:
        return 0

    def sample(self, count: int, generator: torch.Generator) -> NoReturn:
        """Refuse to draw.

        Raises:
            MissingDataError: Always.
        """
        raise MissingDataError(
            "The method draws from prior demonstrations, but there are none: the scenario retains no tasks, "
            "and this is before its second target. Where len(prior.demonstrations) is 0, it must do without."
        )


class Source(Generic[Rows]):
    """Data with the random stream that draws from it, open as long as the hooks it was handed to.

    Args:
        data: What is drawn from.
        generator: Of the draws.
        batch_size: How many samples the budget gives each step.
        device: Where the samples go.
    """

    def __init__(
        self,
        data: Samples[Rows],
        generator: torch.Generator,
        batch_size: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self.batch_size = batch_size
        self._data: Samples[Rows] | None = data
        self._generator = generator
        self._device = device

    def __len__(self) -> int:
        return len(self._open)

    @property
    def bytes(self) -> int:
        """Memory that the data takes."""
        return self._open.bytes

    def sample(self, count: int) -> Rows:
        """Return `count` samples.

        Raises:
            UndeclaredAccessError: The hooks that it was handed to are over.
        """
        rows: Rows = self._open.sample(count, self._generator).to(self._device)
        return rows

    def close(self) -> None:
        """End the access."""
        self._data = None

    @property
    def _open(self) -> Samples[Rows]:
        if self._data is None:
            raise UndeclaredAccessError(
                "The method draws from data after the hooks that it was handed to. What it needs later it "
                'must keep in `state()`, or declare with "throughout" in its `uses`.'
            )
        return self._data


@dataclass(frozen=True)
class Prior:
    """What was learned before: the data that a method's `uses` declares, and nothing else."""

    sources: Mapping[str, Source[Any]]
    """The declared sources, by the name of the field of `Uses`."""

    @property
    def demonstrations(self) -> Source[Batch]:
        """Demonstrations of the retained skills and of the targets learned before."""
        return self._source("demonstrations")

    @property
    def questions(self) -> Source[QuestionBatch]:
        """The training questions."""
        return self._source("questions")

    def _source(self, name: str) -> Source[Any]:
        if name not in self.sources:
            raise UndeclaredAccessError(
                f"The method touches prior {name} that it does not declare for this hook: "
                f'set `uses = Uses({name}="prepare")` or "throughout".'
            )
        return self.sources[name]

    def close(self) -> None:
        """End the access."""
        for source in self.sources.values():
            source.close()

    @property
    def bytes(self) -> int:
        """Memory that the declared data takes."""
        return sum(source.bytes for source in self.sources.values())
