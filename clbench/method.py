"""The method: seams around a loop that is ours. A method file holds only what differs from fine-tuning."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import importlib
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import (
    Any,
    Generic,
    Literal,
    NoReturn,
    Protocol,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import torch
from torch import Tensor, nn

from clbench.cache import package_of, source_hash
from clbench.names import built_in_methods, installed_methods
from clbench.policy import Batch, Policy, QuestionBatch
from clbench.task import Task

Access = Literal["never", "prepare", "throughout"]
State = dict[str, Tensor | str | float | int | bool | None]
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


_TEXTS = {
    "authors": (r"(?=\S).{1,200}", "printable text of at most 200 characters"),
    "link": (
        r"https?://[A-Za-z0-9][A-Za-z0-9.-]*(:\d{1,5})?(/[A-Za-z0-9._~:/?#@!$&()*+,;=%-]{0,300})?",
        "a web address that begins with http:// or https://",
    ),
    "licence": (r"[A-Za-z0-9][A-Za-z0-9 .()+-]{0,99}", 'an SPDX expression, as "MIT" or "Apache-2.0"'),
    "version": (r"[A-Za-z0-9][A-Za-z0-9.+!_-]{0,49}", 'a version, as "1.0"'),
}
"""What the texts of `Metadata` must match, and the same in words."""


@dataclass(frozen=True)
class Metadata:
    """Who made a method, and on what terms; None is not said.

    Raises:
        ValueError: A text is not of its kind: all of them are shown on a page that strangers read.
    """

    authors: str | None = None
    """Names of who made it."""
    link: str | None = None
    """Of the paper, or of the code."""
    licence: str | None = None
    """Of the code, as an SPDX expression."""
    version: str | None = None
    """Of the code."""

    def __post_init__(self) -> None:
        for name, (pattern, words) in _TEXTS.items():
            text = getattr(self, name)
            if text is None:
                continue
            if not (isinstance(text, str) and text.isprintable() and re.fullmatch(pattern, text)):
                raise ValueError(f"{name} in the metadata must be {words}, not {text!r}.")


class UndeclaredAccessError(RuntimeError):
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


class MissingDataError(RuntimeError):
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
    """Data with the random stream that draws from it, open as long as the seams it was handed to.

    Args:
        data: What is drawn from.
        generator: Of the draws.
        batch_size: How many samples the budget gives each step.
        device: Where the samples go.
    """

    def __init__(
        self, data: Samples[Rows], generator: torch.Generator, batch_size: int, device: str = "cpu"
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
            UndeclaredAccessError: The seams that it was handed to are over.
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
                "The method draws from data after the seams that it was handed to. What it needs later it "
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
                f"The method touches prior {name} that it does not declare for this seam: "
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


@dataclass(frozen=True)
class Stage:
    """One target task of the sequence, as a method meets it."""

    number: int
    """1 for the first target."""
    task: Task
    """What is learned."""
    seed: int
    """For the method's own random draws in this stage."""
    steps: int
    """Optimiser steps of the budget."""
    target: Source[Batch]
    """The task's demonstrations."""
    prior: Prior
    """What may be touched of what was learned before."""


@dataclass(frozen=True)
class Progress:
    """How far the adaptation to a target has come."""

    step: int
    """Optimiser steps done in this stage."""
    steps: int
    """Optimiser steps of the whole stage."""


class Method:
    """A rule for fine-tuning: a dataclass whose fields are its hyper-parameters.

    The constructor only stores, and `__post_init__` refuses what is out of range; what a method learns is set
    by the seams. Override what differs from plain fine-tuning, and declare in `uses` the prior data it needs.
    """

    uses: Uses = Uses()
    metadata: Metadata = Metadata()
    whole_stages: bool = False
    """Whether the policy is what the method means it to be at the end of a stage only, as one that `end_task`
    merges: it is then not evaluated on the way."""

    def prepare(self, policy: Policy, prior: Prior) -> int | None:
        """Prepare for the sequence, once, before stage 1: anchors, vectors, adapters, frozen copies.

        Returns:
            The optimiser steps that it took, or that what it found in a cache once took; none if None.
        """

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter] | list[dict[str, Any]]:
        """Return the parameters to train on this target, or optimiser groups of them."""
        return policy.parameters()

    def batch(self, target: Source[Batch], prior: Prior) -> Any:
        """Return what to train on at this step; it goes to `loss` as it is."""
        return target.sample(target.batch_size)

    def loss(self, policy: Policy, batch: Any, progress: Progress) -> Tensor:
        """Return the scalar to descend."""
        return policy.action_loss(batch).mean()

    def gradients(self, policy: Policy, loss: Tensor) -> None:
        """Set the gradients of the trained parameters."""
        loss.backward()  # type: ignore[no-untyped-call]

    def learning_rate(self, scheduled: float, progress: Progress) -> float:
        """Return the step size of this step, asked for after `loss` and `gradients`, for each group."""
        return scheduled

    def end_task(self, policy: Policy, stage: Stage) -> None:
        """Merge or consolidate after a target."""

    def state(self) -> State:
        """Return all that later seams need, tensors and plain values by name; its bytes count as kept.

        Every stage begins with a new object of the method that has this state and nothing else, whether the
        run was interrupted or not.
        """
        return {}

    def load_state(self, policy: Policy, state: State) -> None:
        """Take back what `state` returned, and add to a plain policy what `prepare` added, as adapters."""
        if state:
            raise TypeError(f"{type(self).__name__} returns a state() but has no load_state().")

    def diagnostics(self) -> dict[str, Any]:
        """Return what the method tells about the stage that ends, or about `prepare`, as JSON."""
        return {}


def method_names() -> list[str]:
    """Return the names of the installed methods, sorted; nothing is imported."""
    return sorted(installed_methods())


def load_method(spec: str) -> type[Method]:
    """Return the method class that `spec` names: an installed name, or "module:Class".

    Raises:
        LookupError: Nothing is installed or can be imported under this name; the nearest one is named.
        TypeError: What is found is no method.
    """
    if ":" in spec:
        cls = _import_method(spec)
    elif spec in (installed := built_in_methods()) or spec in (installed := installed_methods()):
        cls = _guarded(spec, installed[spec].load)
    else:
        near = difflib.get_close_matches(spec, installed, n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        names = ", ".join(sorted(installed)) or "none; run `pip install -e .` in the checkout"
        raise LookupError(f"No method is called {spec!r}.{hint} Installed: {names}. Or give module:Class.")
    if not (isinstance(cls, type) and issubclass(cls, Method)):
        raise TypeError(f"{spec!r} is not a subclass of clbench.Method.")
    if not dataclasses.is_dataclass(cls):
        raise TypeError(f"{spec!r} is not a dataclass: decorate it with @dataclasses.dataclass.")
    return cls


def describe_method(cls: type[Method]) -> dict[str, Any]:
    """Return a method's metadata, and as `source` the hash of the package or the module that it lies in."""
    return {**dataclasses.asdict(cls.metadata), "source": source_hash(package_of(cls.__module__))}


def _guarded(spec: str, load: Callable[[], Any]) -> Any:
    """Return what `load` returns; whatever goes wrong in a stranger's module is told in one line."""
    try:
        return load()
    except ModuleNotFoundError as error:
        raise LookupError(f"No module {error.name!r} can be imported for the method {spec!r}.") from error
    except Exception as error:
        raise LookupError(f"{spec!r} cannot be imported: {type(error).__name__}: {error}") from error


def _import_method(spec: str) -> Any:
    name, _, attribute = spec.partition(":")
    module = _guarded(spec, lambda: importlib.import_module(name))
    if not hasattr(module, attribute):
        near = difflib.get_close_matches(attribute, dir(module), n=1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise LookupError(f"Module {name!r} has no {attribute!r}.{hint}")
    return getattr(module, attribute)


def build_method(spec: str, changes: Mapping[str, Any]) -> Method:
    """Return the method that `spec` names, with `changes` to its hyper-parameters.

    Args:
        spec: As for `load_method`.
        changes: Values by field name; strings, as the command line gives them, become the field's own type.

    Raises:
        LookupError: The method has no such hyper-parameter; the nearest one is named.
        ValueError: A value cannot be read as the field's type, or the method refuses it.
    """
    cls = load_method(spec)
    hints = get_type_hints(cls)
    fields = [field.name for field in dataclasses.fields(cls)]  # type: ignore[arg-type]
    values = {}
    for name, value in changes.items():
        if name not in fields:
            near = difflib.get_close_matches(name, fields, n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise LookupError(
                f"{spec} has no hyper-parameter {name!r}.{hint} It has: {', '.join(fields) or 'none'}."
            )
        values[name] = _read(name, value, hints[name]) if isinstance(value, str) else value
    try:
        return cls(**values)
    except Exception as error:
        raise ValueError(f"{spec} refuses its hyper-parameters: {error}") from error


def _read(name: str, text: str, hint: Any) -> Any:
    """Return `text` as a value of the type `hint`: str, int, float, bool, or one of these or None."""
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    if text.lower() == "none" and NoneType in kinds:
        return None
    for kind in (bool, int, float, str):
        if kind not in kinds:
            continue
        if kind is bool and text.lower() in ("true", "false"):
            return text.lower() == "true"
        if kind is not bool:
            with contextlib.suppress(ValueError):
                return kind(text)
    words = " or ".join(getattr(kind, "__name__", str(kind)).replace("NoneType", "none") for kind in kinds)
    raise ValueError(f"{name} must be {words.replace('bool', 'true or false')}, not {text!r}.")
