"""Whether episodes of LIBERO's tasks repeat themselves in our world, and in LIBERO's own environment.

Episodes of each task begin from initial states 0, 1, 2, ... one after the other. Then other episodes come
first: the states begin with the second one in another world, and with the third one in a fresh process. An
episode repeats itself if it ends each time with all bodies in the same places and all joints at the same
speeds, to the last bit. LIBERO's environment is seeded once, as in its evaluation, or before each reset.

    python benchmarks/libero_resets.py
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from result_files import write_results
from rich.progress import track

from clbench.base.entry_points import resolve

ORIGINAL = "clbench.envs.libero.original"
Trails: TypeAlias = dict[int, bytes]
"""Places of all bodies and speeds of all joints after an episode, by the number of its initial state."""


def actions_of(steps: int, seed: int) -> NDArray[np.float32]:
    """Return random actions (steps, 7)."""
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (steps, 7)).astype(np.float32)


def libero(task: str, **options: Any) -> Any:
    """Return LIBERO's environment of a task, without pictures."""
    file = str(resolve(f"{ORIGINAL}:problem_file")(task))  # before LIBERO, whose notices it silences
    from libero.libero.envs.env_wrapper import ControlEnv

    with contextlib.redirect_stdout(io.StringIO()):
        return ControlEnv(
            file, has_offscreen_renderer=False, use_camera_obs=False, ignore_done=True, **options
        )


def our_trails(task: str, states: Sequence[int], steps: int) -> Trails:
    """Run our episodes from initial states in one world, one after the other."""
    problem = resolve("clbench.envs.libero.problem:problem_of")(task)
    episode, found = resolve("clbench.envs.libero.episode:Episode")(problem), {}
    for state in states:
        episode.begin(problem, state)
        for episode.action in actions_of(steps, state):
            episode.move()
        found[state] = episode.data.xpos.tobytes() + episode.data.qvel.tobytes()
    return found


def their_trails(task: str, states: Sequence[int], steps: int, *, seeded: bool) -> Trails:
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


KINDS: dict[str, Callable[[str, Sequence[int], int], Trails]] = {
    "clbench": our_trails,
    "LIBERO, seeded once": functools.partial(their_trails, seeded=False),
    "LIBERO, seeded before each reset": functools.partial(their_trails, seeded=True),
}


def different(kind: str, task: str, states: int, steps: int) -> int:
    """Return how many episodes of a task end differently in one of the three orders."""
    first, second, third = ([*np.roll(range(states), -shift).tolist()] for shift in range(3))
    trails = KINDS[kind]
    found = [trails(task, first, steps), trails(task, second, steps)]
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as fresh:
        found.append(fresh.submit(trails, task, third, steps).result())
    return sum(len({one[state] for one in found}) > 1 for state in first)


def main() -> None:
    """Measure, print and write results/libero_resets.json."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--tasks", type=int, default=20, help="tasks, spread evenly over the 30")
    parser.add_argument("--libero-tasks", type=int, default=8, help="the same for LIBERO, 10 times as slow")
    parser.add_argument("--states", type=int, default=5, help="initial states of each task, at least 3")
    parser.add_argument("--steps", type=int, default=20, help="steps of an episode")
    arguments = parser.parse_args()
    tasks, found = list(resolve(f"{ORIGINAL}:TASKS")), {}
    for kind in KINDS:
        count = arguments.tasks if kind == "clbench" else arguments.libero_tasks
        chosen = [tasks[number * len(tasks) // count] for number in range(count)]
        counts = [different(kind, task, arguments.states, arguments.steps) for task in track(chosen, kind)]
        found[kind] = {"episodes": count * arguments.states, "different": sum(counts)}
        print(f"{kind}: {found[kind]}")
    write_results("libero_resets", {**vars(arguments), "kinds": found})


if __name__ == "__main__":
    main()
