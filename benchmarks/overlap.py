"""What succeeds on a task besides its own expert: `python benchmarks/overlap.py [IDS]`.

Success rates of doing nothing, of random actions, and of the expert of every other task of the scenario. A
high rate means that success on the task says little about having learned or kept it. Also measured: in how
many episodes the first state alone tells the task, so that a policy need not read the words. The results go
to benchmarks/results/overlap.json, and docs/reference/overlap.md is made from them.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from result_files import read_results, write_row

import clbench
from clbench.base.entry_points import resolve
from clbench.base.seeding import derive_seed
from clbench.cli.arguments import checked_input
from clbench.learning.pretraining import policy_config
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task
from clbench.worlds.lanes import vector_world

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "overlap.md"
SCENARIOS = ("clbench/Fetch-v1", "clbench/MetaWorld-v1", "clbench/PointMaze-v1", "clbench/DMControl-v0")
EPISODES = 40
NEIGHBOURS = 5
"""Nearest first states of known episodes that vote on the task of another one."""
LEAST = 0.1
"""Lowest rate of another expert that the page shows."""

Act = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""Action (A,) from a state (S,)."""

INTRODUCTION = f"""\
# What else succeeds

A success rule judges the state that is reached, not the way there. For the scenarios below, this page
shows what succeeds on a task without having learned it: doing nothing, uniformly random actions, and the
experts of the scenario's other tasks, background included ({EPISODES} episodes each; experts below
{LEAST} are left out). Read `learned` and `kept` of a task beside these rates: where the expert of another
task succeeds, a policy that does the other task's motion also counts as knowing this one.

"Known from the first state" is the share of episodes whose task the first state alone tells, by a vote of the
{NEIGHBOURS} nearest of {EPISODES // 2} episodes of each task. Where it is high, a policy can do without the
words.

`python benchmarks/overlap.py` measures the rates and makes this page.
"""


def main() -> None:
    """Measure the named scenarios, or all if none is named, and write the results and the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ids", nargs="*", default=SCENARIOS, help="Gymnasium ids of scenarios")
    for name in parser.parse_args().ids:
        write_row("overlap", "scenarios", name, measured(clbench.load_scenario(name)))
        print(f"{name}: measured")
    PAGE.write_text(page(read_results("overlap")["scenarios"]), encoding="utf-8")


def measured(scenario: Scenario, episodes: int = EPISODES) -> dict[str, Any]:
    """Return the rates of a scenario, as JSON."""
    tasks = scenario.tasks + scenario.background
    rows = {}
    size = policy_config(scenario).action_size
    for task in scenario.tasks:
        others = {one.name: resolve(one.expert)(one.name) for one in tasks if one.world == task.world}
        others.pop(task.name)
        rows[task.name] = {
            "part": scenario.group(task.name),
            "nothing": rate(task, _doing_nothing(size), episodes),
            "random": rate(task, _at_random(size), episodes),
            "experts": {name: rate(task, expert, episodes) for name, expert in others.items()},
        }
    return {"tasks": rows, "known": known(scenario, episodes)}


def _doing_nothing(size: int) -> Act:
    return lambda _: np.zeros(size, np.float32)


def _at_random(size: int) -> Act:
    generator = np.random.default_rng(0)
    return lambda _: generator.uniform(-1.0, 1.0, size).astype(np.float32)


def _first_states(task: Task, episodes: int) -> tuple[Any, NDArray[np.float32]]:
    """Return a vector world with an episode of the task in each lane, and the first states (N, S)."""
    world = vector_world(task.world, episodes, 1)
    seeds = [derive_seed("overlap", task.seed_suite, task.name, number) for number in range(episodes)]
    return world, world.reset(range(episodes), seeds, [task.name] * episodes)


def rate(task: Task, act: Act, episodes: int) -> float:
    """Return the share of episodes of a task in which `act` succeeds within the horizon."""
    world, states = _first_states(task, episodes)
    running = list(range(episodes))
    for _ in range(task.horizon):
        actions = np.stack([act(state) for state in states]).astype(np.float32)
        states, _, successes = world.step(running, actions)
        running = [lane for lane, done in zip(running, successes, strict=True) if not done]
        states = states[~successes]
        if not running:
            break
    world.close()
    return round(1 - len(running) / episodes, 3)


def known(scenario: Scenario, episodes: int) -> dict[str, float]:
    """Return for each task the share of half of its episodes in which the first state tells the task."""
    states, labels = [], []
    for task in scenario.tasks:
        world, first = _first_states(task, episodes)
        world.close()
        states.append(first)
        labels += [task.name] * episodes
    rows, names = np.concatenate(states).astype(np.float64), np.array(labels)
    spread = rows.std(axis=0)
    rows = (rows - rows.mean(axis=0))[:, spread > 0] / spread[spread > 0]
    half = np.arange(len(rows)) % 2 == 0
    found: dict[str, list[bool]] = {task.name: [] for task in scenario.tasks}
    for row, name in zip(rows[half], names[half], strict=True):
        near = names[~half][np.argsort(((rows[~half] - row) ** 2).sum(axis=1))[:NEIGHBOURS]]
        values, counts = np.unique(near, return_counts=True)
        found[name].append(bool(values[counts.argmax()] == name))
    return {name: round(float(np.mean(told)), 3) for name, told in found.items()}


def page(results: dict[str, Any]) -> str:
    """Return the page as Markdown."""
    return INTRODUCTION + "".join("\n".join(_section(name, one)) for name, one in results.items())


def _section(name: str, result: dict[str, Any]) -> Iterator[str]:
    yield f"\n## {name}\n"
    yield "| task | part | nothing | random | experts of other tasks | known from the first state |"
    yield "| --- | --- | --: | --: | --- | --: |"
    for task, row in result["tasks"].items():
        best = sorted(row["experts"].items(), key=lambda item: -item[1])
        others = ", ".join(f"{other} {share:.2f}" for other, share in best if share >= LEAST) or "-"
        part = row["part"].replace("_", " ")
        numbers = f"{row['nothing']:.2f} | {row['random']:.2f} | {others} | {result['known'][task]:.2f}"
        yield f"| {task} | {part} | {numbers} |".replace("_", r"\_")
    yield ""


if __name__ == "__main__":
    with checked_input():
        main()
