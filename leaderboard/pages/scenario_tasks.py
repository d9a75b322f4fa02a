"""The tasks on a scenario's card: success rates of the experts and pictures.

Both are made once and kept in the folder of the card until the version of a task changes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from clbench.base.dependencies import require
from clbench.base.errors import ClbenchError
from clbench.base.leftovers import replacing
from clbench.base.progress import ProgressCallback
from clbench.base.seeding import derive_seed
from clbench.base.text import counted
from clbench.data.demonstrations import demonstrate
from clbench.data.expert_rates import measure
from clbench.evaluation.definition import recording_of
from clbench.jobs.bars import Bars
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task
from clbench.worlds.gl_backend import choose_back_end
from clbench.worlds.world import opened_worlds

from ..views.files import write_all

EXPERTS = "experts.json"
"""File with the measurements of the experts, in the folder of the card."""

WIDTH = 240
"""Width of a picture in pixels."""

QUALITY = 80
"""WebP quality of a picture; a picture of Fetch takes 6 kB."""


@dataclass(frozen=True)
class Experts:
    """Measured success of the experts."""

    episodes: int
    """Number of episodes of each task."""
    successes: Mapping[str, int]
    """Number of successes by task; a task that learns from a recording has no expert."""


def picture_path(folder: Path, task: Task) -> Path:
    """Return the path of the picture of a task."""
    return folder / f"{task.name}.webp"


def undrawn(scenario: Scenario, folder: Path) -> list[Task]:
    """Return the tasks with an expert, but without a picture of their present version in the folder."""
    kept = _read(folder)
    return [
        task
        for task in _with_expert(scenario)
        if not picture_path(folder, task).is_file()
        or kept.get(task.name, {}).get("version", task.version) != task.version
    ]


def _with_expert(scenario: Scenario) -> list[Task]:
    return [task for task in scenario.tasks if recording_of(task) is None]


def choose_renderer(tasks: Sequence[Task]) -> str | None:
    """Choose the renderer of `tasks`; return why none works, or None. MuJoCo must not be imported before."""
    try:
        if tasks:
            require("PIL", "film", "A picture")
            choose_back_end(task.world for task in tasks)
    except ClbenchError as error:
        return str(error.args[0])
    return None


def make_missing(
    scenario: Scenario, folder: Path, episodes: int, *, drawing: bool, console: Console
) -> Experts:
    """Measure the experts and draw the pictures that are missing from the folder of the card.

    Pictures of tasks that the scenario no longer has are deleted, and so are pictures of former versions that
    cannot be drawn again.

    Args:
        scenario: Scenario with the tasks.
        folder: Folder of the card.
        episodes: Number of episodes of each task. The episodes are the same each time and have no other use.
        drawing: Whether pictures can be drawn.
        console: Console that shows the progress.
    """
    kept, missing, tasks = _read(folder), undrawn(scenario, folder), _with_expert(scenario)
    bare = missing if drawing else []
    asked = {task.name: {"version": task.version, "episodes": episodes} for task in tasks}
    stale = [task for task in tasks if not asked[task.name].items() <= kept.get(task.name, {}).items()]
    folder.mkdir(parents=True, exist_ok=True)
    with Bars(len(stale) * episodes + len(bare), console) as bars:
        bars.start(scenario.id, len(stale) * episodes + len(bare))
        _draw(bare, folder, lambda done: bars.advance(scenario.id, done))
        for row in measure(scenario, stale, episodes, lambda done: bars.advance(scenario.id, done)):
            kept[row.task] = {**asked[row.task], "successes": round(row.success * episodes)}
        bars.finish(
            scenario.id, f"{counted(len(stale), 'expert')} measured, {counted(len(bare), 'picture')} drawn"
        )
    # A picture of a former version would count as one of the version that the file names from now on.
    current = {picture_path(folder, task) for task in tasks if task in bare or task not in missing}
    for path in {*folder.glob("*.webp")} - current:
        path.unlink()
    found = {task.name: kept[task.name] for task in tasks}
    lines = (f"{json.dumps(name)}: {json.dumps(entry)}" for name, entry in found.items())
    write_all({folder / EXPERTS: "{\n" + ",\n".join(lines) + "\n}\n"})
    return Experts(episodes, {name: entry["successes"] for name, entry in found.items()})


def _draw(tasks: Sequence[Task], folder: Path, progress: ProgressCallback) -> None:
    """Draw each task with its expert halfway through an episode that is the same each time."""
    if not tasks:
        return
    from clbench.runs.film import picture  # Pillow is an extra

    with opened_worlds(render_mode="rgb_array") as world:
        for task in tasks:
            seed = derive_seed("picture", task.seed_suite, task.name)
            actions = demonstrate(world(task), task, seed, noisy=False).executed
            world(task).reset(seed=seed, options={"task": task.name})
            for action in actions[: len(actions) // 2]:
                world(task).step(action)
            with replacing(picture_path(folder, task)) as partial:  # half a picture would count as drawn
                picture(world(task), WIDTH).save(partial, "WEBP", quality=QUALITY, method=6)
            progress(1)


def _read(folder: Path) -> dict[str, dict[str, int]]:
    """Return the kept measurements, none if the file is missing or torn: they are made again."""
    try:
        values = json.loads((folder / EXPERTS).read_text(encoding="utf-8"))
        return {name: {**entry} for name, entry in values.items()}
    except (OSError, ValueError, AttributeError, TypeError):
        return {}
