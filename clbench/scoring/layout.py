"""The layout of score arrays: the meaning of their axes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clbench.spec.scenario import Group

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Layout:
    """Meaning of the axes of a run's scores. Runs with equal layouts can be combined."""

    retained: tuple[str, ...]
    """Names of the skills that are pretrained and never trained again."""
    target: tuple[str, ...] = field(compare=False)
    """Names of the tasks that are learned, in order. Runs with other orders of the same tasks combine: the
    axis means "learned first", "learned second" and so on."""
    held_out: tuple[str, ...]
    """Names of the tasks that are never trained."""
    episodes: tuple[int, ...]
    """Numbers of the scored episodes at the end of a stage, rising."""
    curve_episodes: tuple[int, ...]
    """Numbers of the scored episodes that are also run before the end of a stage, rising."""
    validation_episodes: tuple[int, ...]
    """Numbers of the validation episodes on a stage's target, rising. No metric reads them; runs with
    other validation episodes do not combine."""
    steps: tuple[int, ...]
    """Steps of a stage after which the policy is evaluated, rising, above 0; the last one is the stage's
    end."""
    kinds: tuple[str, ...]
    """Kinds of questions, sorted."""
    to_criterion: bool = False
    """Whether a stage ends at its criterion, so that only its end is evaluated."""
    targets: frozenset[str] = field(init=False)
    """Names of the tasks that are learned."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "targets", frozenset(self.target))

    @property
    def tasks(self) -> tuple[str, ...]:
        """The columns of every score table: retained, then target, then held out."""
        return self.retained + self.target + self.held_out

    def columns(self, group: Group) -> slice:
        """Return the task columns of `group`."""
        before = {"retained": (), "target": self.retained, "held_out": self.retained + self.target}[group]
        return slice(len(before), len(before) + len(getattr(self, group)))


def average(values: Array) -> Array:
    """Return the mean along the last axis, NaN where there is nothing to average."""
    return values.mean(axis=-1) if values.shape[-1] else np.full(values.shape[:-1], np.nan)
