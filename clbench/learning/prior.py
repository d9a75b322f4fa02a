"""Prior data: the data of earlier tasks that a method may use, and when."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic, Literal, NoReturn, Protocol, TypeVar, get_args

import torch

from clbench.base.errors import ClbenchError, InputError
from clbench.policy.batch import Batch, QuestionBatch

Access = Literal["never", "prepare", "throughout"]
Rows = TypeVar("Rows", Batch, QuestionBatch)
Drawn = TypeVar("Drawn", Batch, QuestionBatch, covariant=True)


@dataclass(frozen=True)
class Uses:
    """Prior data that a method may use, and when. The trainer provides nothing else."""

    demonstrations: Access = "never"
    """Access to demonstrations of the retained skills and, with "throughout", of earlier targets; the source
    may be empty."""
    questions: Access = "never"
    """Access to the training questions."""
    reference: bool = False
    """Whether the method is a reference, which does not compete, such as one that trains nothing."""

    def __post_init__(self) -> None:
        for name, value in (("demonstrations", self.demonstrations), ("questions", self.questions)):
            if value not in get_args(Access):
                wanted = ", ".join(map(repr, get_args(Access)))
                raise InputError(f"Uses.{name} must be one of {wanted}, not {value!r}.")


class UndeclaredAccessError(ClbenchError, RuntimeError):
    """A method used prior data that its `uses` does not declare."""


class Samples(Protocol[Drawn]):
    """Data to draw samples from."""

    def __len__(self) -> int:
        """Return the number of different moments or scenes."""

    def sample(self, count: int, generator: torch.Generator) -> Drawn:
        """Return `count` samples."""

    @property
    def bytes(self) -> int:
        """Memory that the data takes."""


class MissingDataError(ClbenchError, RuntimeError):
    """A method draws from data that does not exist."""


class Nothing:
    """Demonstrations of no task: the prior data of the first target if the scenario retains no tasks."""

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
            "and this is before its second target. Where len(prior.demonstrations) is 0, the method must not "
            "draw."
        )


class Source(Generic[Rows]):
    """Data to draw from with replacement, with its own random stream.

    Every draw first chooses a task, all equally likely, then one of its moments and one of its wordings. For
    questions it chooses a kind, one of its answers, and then a state with this answer.

    The source of `prepare` closes after `prepare`, the sources of a stage after `end_task`.

    Args:
        data: Data to draw from.
        generator: Random generator of the draws.
        batch_size: Number of samples of the target in a step.
        device: Device of the samples.
    """

    batch_size: int
    """Largest number of samples of the target in a step: the budget of all methods."""

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
        self._left: int | None = None
        """Samples that the running step may still draw, None outside of steps."""
        self._twins: list[Source[Rows]] = []

    def __len__(self) -> int:
        """Return the number of different moments, or of states for questions; 0 if there is no data."""
        return len(self._open)

    @property
    def bytes(self) -> int:
        """Memory that the data takes."""
        return self._open.bytes

    def sample(self, count: int) -> Rows:
        """Return `count` samples, each with new random draws for the loss.

        Args:
            count: Number of samples; it may exceed `len(source)`.

        Raises:
            MissingDataError: There is no data.
            InputError: The number of samples is negative.
            UndeclaredAccessError: The hooks that received the source have ended, or a step draws more samples
                of the target than `batch_size`.
        """
        if count < 0:  # it would raise what is left
            raise InputError(f"The number of samples must be at least 0, not {count}.")
        if self._left is not None:
            self._left -= count
            if self._left < 0:
                raise UndeclaredAccessError(
                    f"The method draws {self.batch_size - self._left} samples of the target in a step: "
                    f"the budget of every method is {self.batch_size}, the target's `batch_size`."
                )
        rows: Rows = self._open.sample(count, self._generator).to(self._device)
        return rows

    def close(self) -> None:
        """End the access."""
        self._data = None
        for twin in self._twins:
            twin.close()

    @property
    def _open(self) -> Samples[Rows]:
        if self._data is None:
            raise UndeclaredAccessError(
                "The method draws from data after the hooks that received it. Keep data that later hooks "
                'need in `state()`, or declare it with "throughout" in `uses`.'
            )
        return self._data


def begin_step(source: Source[Any]) -> None:
    """Let the step that begins draw at most `batch_size` samples."""
    source._left = source.batch_size


def end_steps(source: Source[Any]) -> None:
    """Let the hooks after the last step draw as many samples as they need."""
    source._left = None


def twin_of(source: Source[Rows]) -> Source[Rows]:
    """Return a source of the same data that continues with the next draws of `source`.

    It closes together with `source`.
    """
    generator = torch.Generator(source._generator.device)
    generator.set_state(source._generator.get_state())
    twin = Source(source._open, generator, source.batch_size, source._device)
    source._twins.append(twin)
    return twin


@dataclass(frozen=True)
class Prior:
    """Prior data: the sources that a method's `uses` declares, and no others."""

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
                f"The method uses prior {name} that it does not declare for this hook: "
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
