"""The command `clbench experts train`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from rich.console import Console

from clbench.base.dependencies import require
from clbench.base.entry_points import unknown
from clbench.cli.arguments import checked_input, whole_number
from clbench.jobs.bars import Bars

from ..experts import FOLDER
from ..rules import HORIZON, RULES


def train(
    task: str,
    /,
    *,
    seed: Annotated[int, whole_number(0)] = 0,
    steps: Annotated[int | None, whole_number(1)] = None,
    output: Path = FOLDER,
    log: Path | None = None,
) -> None:
    """Train the expert of TASK, a task of clbench/DMControl-v0, with the SAC of stable-baselines3.

    Writes TASK.safetensors and TASK.json, which records the settings and the results of 100 episodes. A
    stopped training continues from its last checkpoint, and a longer training continues a shorter one.

    Args:
        task: Name of the task, such as cartpole_left.
        seed: Seed of all random draws.
        steps: Number of decisions to train for (default: as many as the included expert).
        output: Folder of the expert; the task reads the default, a folder inside clbench.
        log: File that receives one line for each segment of the training.
    """
    with checked_input():
        require("stable_baselines3", "online", "Training an expert")
        if task not in RULES:
            raise unknown("task of the dm_control world", task, RULES)
        from . import train as training

        settings = training.Settings(task, seed, training.steps_of(task) if steps is None else steps)
        console = Console(stderr=True)
        with Bars(settings.steps, console) as bars:
            bars.start(task, settings.steps)

            def report(done: float, line: str) -> None:
                bars.advance(task, done)
                bars.say(f"{task}: {line}")
                if log is not None:
                    with log.open("a", encoding="utf-8") as file:
                        file.write(f"{task}: {line}\n")

            card = training.train(settings, output, report)
            bars.finish(
                task,
                f"{output / task}.safetensors, return {card['return']:.1f} of {HORIZON}, "
                f"success {card['success']:.2f} in {card['episodes']} episodes",
            )
