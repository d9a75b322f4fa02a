"""LIBERO's tasks in our world and in LIBERO's own environment: speed on one core, and whether resets repeat.

Speed: blocks of random actions take turns, and the clock counts this process's time on the processor. A ratio
compares two blocks of one round; results are the median over rounds and its 95 % bootstrap interval.

Resets: episodes of each task begin from initial states 0, 1, 2, ... and, in another world, from the same ones
with the last one first. An episode repeats itself if both end with all bodies in the same places and all
joints at the same speeds, to the last bit. LIBERO's environment is seeded once, as in its evaluation, or
before each reset.

    python benchmarks/libero_world.py
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import statistics
import time
from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from ratios import median_ratio
from result_files import write_results
from rich.progress import track

from clbench.base.entry_points import resolve

WORLD = resolve("clbench.envs.libero.physics:LiberoVectorWorld")
ORIGINAL = "clbench.envs.libero.original"
TASKS = list(resolve(f"{ORIGINAL}:TASKS"))
Trails: TypeAlias = dict[int, bytes]
"""Places of all bodies and speeds of all joints after an episode, by the number of its initial state."""


def actions_of(steps: int, seed: int) -> NDArray[np.float32]:
    """Return random actions (steps, 7)."""
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, 7)).astype(np.float32)


def libero(task: str) -> Any:
    """Return LIBERO's environment of a task, without pictures."""
    from libero.libero.envs.env_wrapper import ControlEnv

    file = str(resolve(f"{ORIGINAL}:problem_file")(task))
    with contextlib.redirect_stdout(io.StringIO()):
        return ControlEnv(file, has_offscreen_renderer=False, use_camera_obs=False, ignore_done=True)


# ---- speed -----------------------------------------------------------------------------------------------


def speed(task: str, lanes: int, rounds: int, steps: int) -> dict[str, Any]:
    """Return control steps per second of the processor."""
    world, one, theirs = WORLD(lanes), WORLD(1), libero(task)
    for ours, count in ((world, lanes), (one, 1)):
        ours.reset(range(count), range(count), [task] * count)
    theirs.seed(0)
    theirs.reset()
    theirs.set_init_state(resolve(f"{ORIGINAL}:initial_states")(task)[0])
    generator, taken = np.random.default_rng(0), []
    for number in track(range(rounds + 1), task):
        actions = actions_of(steps, number)
        blocks = {
            "clbench": lambda a=actions: [world.step(range(lanes), np.tile(row, (lanes, 1))) for row in a],
            "clbench, one episode": lambda a=actions: [one.step([0], row[None]) for row in a],
            "LIBERO": lambda a=actions: [theirs.step(row) for row in a],
        }
        rates = {}
        for name in generator.permutation(list(blocks)).tolist():
            begin = time.process_time()
            blocks[name]()
            episodes = lanes if name == "clbench" else 1
            rates[name] = steps * episodes / (time.process_time() - begin)
        if number:  # the first round warms up
            taken.append(rates)
    world.close()
    theirs.close()
    others = [name for name in taken[0] if name != "clbench"]
    return {
        "task": task,
        "lanes": lanes,
        "rounds": rounds,
        "steps_per_core_second": {
            name: round(statistics.median(r[name] for r in taken)) for name in taken[0]
        },
        "ratios_of_clbench_to": {
            name: median_ratio([r["clbench"] / r[name] for r in taken], generator) for name in others
        },
    }


# ---- resets ----------------------------------------------------------------------------------------------


def our_trails(task: str, states: Iterable[int], steps: int) -> Trails:
    """Run our episodes from initial states in one world, one after the other."""
    problem = resolve("clbench.envs.libero.problem:problem_of")(task)
    episode, found = resolve("clbench.envs.libero.episode:Episode")(problem), {}
    for state in states:
        episode.begin(problem, state)
        for episode.action in actions_of(steps, state):
            episode.move()
        found[state] = episode.data.xpos.tobytes() + episode.data.qvel.tobytes()
    return found


def their_trails(task: str, states: Iterable[int], steps: int, seeded: bool) -> Trails:
    """Run LIBERO's episodes from initial states in one environment, one after the other.

    Args:
        task: Name of the task.
        states: Numbers of the initial states, in the order of the episodes.
        steps: Steps of each episode.
        seeded: Whether the environment is seeded before each reset, and not only once.
    """
    env, starts, found = libero(task), resolve(f"{ORIGINAL}:initial_states")(task), {}
    env.seed(0)
    for state in states:
        if seeded:
            env.seed(0)
        env.reset()
        env.set_init_state(starts[state])
        for action in actions_of(steps, state):
            env.step(action)
        found[state] = env.sim.data.xpos.tobytes() + env.sim.data.qvel.tobytes()
    env.close()
    return found


def resets(tasks: int, states: int, steps: int) -> dict[str, Any]:
    """Return how many episodes differ when the same initial states come in another order."""
    kinds: dict[str, Callable[[str, Iterable[int], int], Trails]] = {
        "clbench": our_trails,
        "LIBERO, seeded once": functools.partial(their_trails, seeded=False),
        "LIBERO, seeded before each reset": functools.partial(their_trails, seeded=True),
    }
    different = dict.fromkeys(kinds, 0)
    for task in track(TASKS[:: len(TASKS) // tasks][:tasks], "resets"):
        for name, trails in kinds.items():
            first, second = (trails(task, np.roll(range(states), shift), steps) for shift in (0, 1))
            different[name] += sum(first[state] != second[state] for state in first)
    return {"tasks": tasks, "states": states, "steps": steps, "different": different}


def main() -> None:
    """Measure, print and write results/libero_world.json."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--lanes", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument(
        "--steps", type=int, default=40, help="steps of a block, or of an episode of the resets"
    )
    parser.add_argument("--tasks", type=int, default=20, help="tasks whose resets are tested")
    parser.add_argument("--states", type=int, default=5, help="initial states of each of these tasks")
    arguments = parser.parse_args()
    speeds = []
    for task in TASKS[::10]:
        speeds.append(speed(task, arguments.lanes, arguments.rounds, arguments.steps))
        print(speeds[-1]["steps_per_core_second"], speeds[-1]["ratios_of_clbench_to"])
    found = resets(arguments.tasks, arguments.states, arguments.steps)
    print(f"episodes that differ, of {arguments.tasks * arguments.states}: {found['different']}")
    write_results("libero_world", "clbench/Fetch-v1", {"speed": speeds, "resets": found})


if __name__ == "__main__":
    main()
