"""Step time: how long an optimiser step of the method takes, relative to plain fine-tuning.

At the end of a run the method and plain fine-tuning take turns, in blocks of a few steps, in one process and
on the same data: other work on the machine affects both alike. They train copies, so that the run itself does
not change.
"""

from __future__ import annotations

import functools
import logging
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch

from clbench.learning.adaptation import Step
from clbench.learning.method import Method
from clbench.learning.optimise import steps_counted
from clbench.learning.registry import load_method
from clbench.learning.trainer import Trainer
from clbench.spec.references import BASELINE

LOG = logging.getLogger("clbench")

ROUNDS = 5
"""Pairs of blocks; the first one warms up."""
STEPS = 4
"""Timed steps in a block."""


def step_ratio(trainer: Trainer, stage: Path) -> float | None:
    """Return the time of a step divided by plain fine-tuning's, the median over the pairs of blocks.

    Args:
        trainer: Trainer of the run after its last stage; it does not change.
        stage: Folder with the files of the last stage.

    Returns:
        The ratio; None if the method takes no steps, the stage is too short, or the method fails here.
    """
    number = len(trainer.scenario.target)
    plain: Callable[[], Method] = functools.partial(load_method(BASELINE), step_factor=1.0)
    try:
        own, usual = _copy(trainer, trainer.new_method), _copy(trainer, plain)
        own.load(stage, number)
        pairs = [(_seconds(own, number), _seconds(usual, number)) for _ in range(ROUNDS)]
    except Exception as error:  # the run itself went well
        LOG.warning("The time of a step could not be measured: %s: %s", type(error).__name__, error)
        return None
    ratios = [mine / usual for mine, usual in pairs[1:] if mine is not None and usual]
    return round(statistics.median(ratios), 3) if ratios else None


def _copy(trainer: Trainer, new_method: Callable[[], Method]) -> Trainer:
    return Trainer(trainer.scenario, trainer.data, trainer.pretrained, new_method, trainer.seed)


def _seconds(trainer: Trainer, number: int) -> float | None:
    """Return the seconds of an optimiser step in a block, without the first step, which makes the optimiser.

    If the method has an optimiser of its own, several optimisers share the time of a step of the loop: the
    costs count the steps of all.
    """
    marks: list[tuple[float, int]] = []

    def after(step: Step) -> bool:
        if step.loss is not None:
            if trainer.device.type == "cuda":
                torch.cuda.synchronize(trainer.device)
            marks.append((time.perf_counter(), taken()))
        return len(marks) > STEPS

    with steps_counted() as taken:
        trainer.learn(number, after)
    if len(marks) <= STEPS:
        return None
    seconds, steps = (last - first for first, last in zip(marks[0], marks[-1], strict=True))
    return seconds / steps
