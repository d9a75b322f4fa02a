"""The command `clbench experts train`."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from clbench.base.dependencies import require
from clbench.base.entry_points import unknown
from clbench.cli.arguments import at_least, checked_input
from clbench.jobs.bars import Bars

from .expert import FOLDER
from .rules import HORIZON, RULES


def train(
    task: str, /, *, seed: int = 0, steps: int | None = None, output: Path = FOLDER, log: Path | None = None
) -> None:
    """Train the expert of TASK, a task of clbench/DMControl-v0, with the SAC of stable-baselines3.

    Writes TASK.safetensors and TASK.json, which says what the weights follow from and how they did in 100
    episodes. A training that was stopped goes on from its last checkpoint, and a longer one from a shorter.

    Args:
        task: Name of the task, as cartpole_left.
        seed: Of every draw.
        steps: Decisions to train for; if not given, as many as the expert that comes with clbench had.
        output: Folder of the expert; if not given, that of clbench itself, where the task's world looks.
        log: File to which each segment of the training adds a line.
    """
    with checked_input():
        require("stable_baselines3", "online", "Training an expert")
        at_least(0, "--seed", seed)
        if task not in RULES:
            raise unknown("task of the dm_control world", task, RULES)
        from . import training

        settings = training.Settings(task, seed, training.steps_of(task) if steps is None else steps)
        console = Console(stderr=True)
        with Bars(settings.steps, console) as bars:
            bars.start(task, settings.steps)

            def tell(done: float, line: str) -> None:
                bars.advance(task, done)
                bars.say(f"{task}: {line}")
                if log is not None:
                    with log.open("a", encoding="utf-8") as file:
                        file.write(f"{task}: {line}\n")

            card = training.train(settings, output, tell)
            bars.finish(
                task,
                f"{output / task}.safetensors, return {card['return']:.1f} of {HORIZON}, "
                f"success {card['success']:.2f} in {card['episodes']} episodes",
            )
