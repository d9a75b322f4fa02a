"""The commands about what runs start from: `clbench demonstrations`, `pretrain` and `experts measure`."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import CycloptsError, Parameter
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from clbench.base.entry_points import unknown
from clbench.base.errors import InputError
from clbench.base.text import counted, print_plain
from clbench.cli.arguments import (
    PolicyName,
    ScenarioId,
    Seed,
    add_cwd_to_path,
    checked_input,
    chosen_pictures,
    whole_number,
)
from clbench.jobs.folders import check_folders
from clbench.spec.identifiers import scenario_ids
from clbench.spec.policies import DEFAULT_POLICY, kind_of
from clbench.spec.registry import load_scenario

if TYPE_CHECKING:
    from clbench.data.expert_rates import Measurement
    from clbench.jobs.plan import Plan
    from clbench.spec.scenario import Scenario
    from clbench.spec.task import Task

# PyTorch and the simulators are imported where they are needed: `--help` does not wait for them.


DEMONSTRATIONS = {
    "export": "clbench.cli.data:export",
    "import": "clbench.cli.data:import_",
}
"""Entry points of the commands of `clbench demonstrations`, which itself collects and lists them."""


def _no_command(_: object, name: str) -> None:
    """Refuse a word that cannot be a scenario, and so is a command with a typing error."""
    if not {"/", ":"} & set(name):
        raise CycloptsError(msg=str(unknown("command or scenario", name, [*DEMONSTRATIONS, *scenario_ids()])))


def demonstrations(
    scenario: Annotated[ScenarioId, Parameter(validator=_no_command)],
    /,
    *,
    workers: Annotated[int | None, whole_number(1)] = None,
) -> None:
    """Collect the expert demonstrations of SCENARIO as Minari datasets, and list the datasets.

    Args:
        scenario: Gymnasium id of the scenario.
        workers: Number of tasks to collect at once (default: all cores).
    """
    from clbench.data.demonstrations import dataset_folder, dataset_id, read_dataset

    add_cwd_to_path()
    with checked_input():
        loaded = load_scenario(scenario)
        check_folders({})
    tasks = loaded.tasks + loaded.background
    _collect(scenario, loaded, tasks, workers)
    console = Console()
    for task in tasks:
        episodes = read_dataset(dataset_folder(task, loaded.budget))
        count = len(episodes)
        facts = (
            loaded.group(task.name).replace("_", " "),
            counted(count, "episode"),
            f"{sum(bool(episode.noisy.any()) for episode in episodes)} noisy",
            f"success {sum(episode.success for episode in episodes) / count:.2f}",
            f"mean length {sum(len(episode.executed) for episode in episodes) / count:.1f}",
        )
        console.print(Text.assemble((task.name, "bold"), f": {', '.join(facts)}"))
        print_plain(console, f"    {dataset_id(task, loaded.budget)}")


def export(
    scenario: ScenarioId,
    /,
    *tasks: str,
    format: Literal["lerobot", "hdf5"],  # noqa: A002 - the word that everyone uses
    output: Path,
    noisy: Annotated[bool, Parameter(negative="--no-noisy")] = True,
    pictures: str | None = None,
    picture_size: Annotated[int | None, whole_number(1)] = None,
    workers: Annotated[int | None, whole_number(1)] = None,
) -> None:
    """Export the demonstrations of SCENARIO, or of TASKS alone, for other libraries.

    The command first collects missing demonstrations. In both formats, the actions are the expert's. Where
    noise replaced an action, `noisy` is true and `executed` holds the action that led to the next state.

    Args:
        scenario: Gymnasium id of the scenario.
        tasks: Names of tasks (default: the retained skills and the targets).
        format: lerobot for one LeRobotDataset v3, with the instructions as its tasks, or hdf5 for a file
            TASK_demo.hdf5 for each task, in the layout of robomimic and LIBERO.
        output: New folder.
        noisy: Whether to export the episodes with action noise, too: --no-noisy leaves them out.
        pictures: Cameras of the simulator whose pictures to add, separated by commas, for example
            agentview,robot0_eye_in_hand: what `clbench score --pictures` shows a policy. Drawing them can
            take hours.
        picture_size: Height and width of these pictures in pixels (default: 224).
        workers: Number of tasks to collect at once (default: all cores).
    """
    from clbench.exchange.demonstrations import check_output, chosen_tasks, export_demonstrations
    from clbench.jobs.bars import Bars

    add_cwd_to_path()
    drawn = chosen_pictures(pictures, picture_size)
    with checked_input():
        loaded, chosen = chosen_tasks(scenario, tasks)
        check_output(output, format, chosen, **drawn)
        check_folders({"--output": output})
    _collect(scenario, loaded, chosen, workers)
    with checked_input(), Bars(1.0) as bars:
        bars.start("export", 1.0)
        folder = export_demonstrations(
            loaded,
            output,
            format=format,
            tasks=[task.name for task in chosen],
            noisy=noisy,
            **drawn,
            progress=lambda share: bars.advance("export", share),
        )
        bars.finish("export", "done")
    text = f"{counted(len(chosen), 'task')} of {loaded.id} in {folder}"
    print_plain(Console(), text)


def import_(
    scenario: ScenarioId,
    task: str,
    path: Path,
    /,
    *,
    state: Annotated[tuple[str, ...], Parameter(consume_multiple=True)] = ("states",),
) -> None:
    """Import recorded demonstrations from the HDF5 file PATH for TASK of your own SCENARIO.

    The file has the layout of robomimic and LIBERO: one group data/demo_i for each demonstration, with
    actions, states, rewards, dones and obs. It must fit the world, the horizon and the instructions of the
    task, and have as many demonstrations as the budget requires. The task must name the demonstrations
    instead of an expert. If it does not, the command checks the file and prints the name to write.

    Args:
        scenario: Gymnasium id of the scenario, as module:id.
        task: Name of the task.
        path: The HDF5 file.
        state: Datasets of each demonstration to concatenate into the state of the world, for example
            obs/ee_states obs/gripper_states.
    """
    from clbench.exchange.demonstrations import import_demonstrations

    add_cwd_to_path()
    with checked_input():
        check_folders({})
        name = import_demonstrations(scenario, task, path, state=state)
    print_plain(Console(), name)


def _collect(name: str, scenario: Scenario, tasks: Sequence[Task], workers: int | None) -> None:
    """Collect the demonstrations of tasks that are missing; end with exit code 1 if an expert fails."""
    from clbench.jobs.plan import Plan

    plan = Plan()
    with checked_input():  # a recording may be missing
        plan.add_demonstrations(name, scenario, tasks)
    _do(plan, workers)


def _do(plan: Plan, workers: int | None) -> None:
    """Do the jobs of a plan; end with exit code 1 if one fails."""
    from clbench.jobs.processes import Processes
    from clbench.jobs.scheduler import run_with_bars

    if run_with_bars(plan.jobs, Processes(workers)):
        sys.exit(1)


def pretrain(
    scenario: ScenarioId,
    /,
    *,
    policy: PolicyName = DEFAULT_POLICY,
    seed: Seed = 0,
    workers: Annotated[int | None, whole_number(1)] = None,
    ship: bool = False,
) -> None:
    """Pretrain the policy from which every method on SCENARIO starts, unless it is in the cache.

    The command first collects missing demonstrations. `clbench run` does the same where a pretrained policy
    is missing.

    Args:
        scenario: Gymnasium id of the scenario.
        policy: flow or discrete_diffusion; a larger size, for example flow-base (5 million parameters) or
            flow-large (40 million); or a class of your own, as module:Class.
        seed: Seed of the policy.
        workers: Number of tasks whose demonstrations are collected at once (default: all cores).
        ship: Copy the policy to clbench/pretrained/, so that it ships with the package. Needs a checkout.
    """
    from clbench.jobs.plan import Plan
    from clbench.learning.pretraining import SHIPPED, pretrained_folder, shipped_folder
    from clbench.policy.kinds import policy_class

    add_cwd_to_path()
    plan = Plan()
    with checked_input():
        loaded = load_scenario(scenario).with_policy(policy)
        if ship and not (SHIPPED.parents[1] / "pyproject.toml").is_file():
            raise InputError("--ship needs a checkout of clbench: it does not change an installed package.")
        policy_class(kind_of(loaded.policy))
        check_folders({})
        plan.add_pretraining(scenario, loaded, seed)
    if plan.jobs:
        _do(plan, workers)
    folder, shipped = pretrained_folder(loaded, seed), shipped_folder(loaded, seed)
    if ship and folder != shipped:
        shutil.rmtree(shipped, ignore_errors=True)
        folder = shutil.copytree(folder, shipped)
    print_plain(Console(stderr=True), f"{loaded.id} pretraining seed {seed}: in {folder}")


def measure(scenario: ScenarioId, /, *tasks: str, episodes: Annotated[int, whole_number(1)] = 100) -> None:
    """Measure the experts of SCENARIO, or of TASKS alone: their success rates and returns.

    Args:
        scenario: Gymnasium id of the scenario.
        tasks: Names of tasks (default: all tasks of the scenario that have an expert).
        episodes: Number of episodes of each task.
    """
    from clbench.data import expert_rates
    from clbench.evaluation.definition import recording_of
    from clbench.exchange.recorded import no_expert
    from clbench.jobs.bars import Bars

    add_cwd_to_path()
    with checked_input():
        loaded = load_scenario(scenario)
        named = [loaded.task(name) for name in tasks]
        chosen = named or [task for task in loaded.tasks if recording_of(task) is None]
        for task in named:
            if (recording := recording_of(task)) is not None:
                raise InputError(f"{no_expert(task.name, recording)}.")
        if not chosen:
            raise InputError(f"No task of {loaded.id} has an expert: all of them use recordings.")
    with Bars(len(chosen) * episodes) as bars:
        bars.start(loaded.id, len(chosen) * episodes)
        with checked_input():  # an expert may refuse its task
            rows = expert_rates.measure(loaded, chosen, episodes, lambda done: bars.advance(loaded.id, done))
    Console().print(_table(loaded, rows, episodes))
    found = [expert_rates.complaint(task, row) for task, row in zip(chosen, rows, strict=True)]
    complaints = [text for text in found if text is not None]
    for text in complaints:
        print_plain(Console(stderr=True), text, "bold red")
    if complaints:
        sys.exit(1)


def _table(scenario: Scenario, rows: Sequence[Measurement], episodes: int) -> Table:
    """Return measurements of experts as a table for the terminal."""
    table = Table(
        box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        title=f"Experts of {scenario.id}, {counted(episodes, 'episode')} each",
    )
    columns = ("task", "group", "success", "mean return", "lowest return", "mean steps")
    for number, column in enumerate(columns):
        table.add_column(column, no_wrap=number < 2, justify="left" if number < 2 else "right")
    for row in rows:
        table.add_row(
            row.task,
            row.group.replace("_", " "),
            f"{row.success:.2f}",
            f"{row.mean_return:.2f}",
            f"{row.lowest_return:.2f}",
            f"{row.mean_steps:.1f}",
        )
    return table
