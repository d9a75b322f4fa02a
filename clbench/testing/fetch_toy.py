"""A Fetch scenario that takes a minute: real worlds, experts and runs with a budget too small to learn.

It covers the whole path from a method class to a table row; its scores mean nothing. Its name in a command is
"clbench.testing.fetch_toy:clbench/FetchToy-v0".
"""

import dataclasses

from clbench.spec.budget import Budget
from clbench.spec.registry import load_scenario, register
from clbench.spec.task import Task

_FETCH = load_scenario("clbench/Fetch-v1")


def _apart(tasks: tuple[Task, ...]) -> tuple[Task, ...]:
    """Return the tasks under another suite: their few demonstrations must not replace the full ones."""
    return tuple(dataclasses.replace(task, suite="fetch-toy", seed_name=None) for task in tasks)


FETCH_TOY = dataclasses.replace(
    _FETCH,
    id="clbench/FetchToy-v0",
    description="Fetch with one target and a budget of seconds; for tests and for a first try.",
    retained=_apart(_FETCH.retained),
    target=_apart(_FETCH.target[:1]),
    held_out=_apart(_FETCH.held_out[:1]),
    background=(),
    balanced=False,
    budget=Budget(
        demonstrations=4,
        question_episodes=36,
        test_questions=60,
        pretraining_steps=40,
        adaptation_steps=16,
        batch_size=16,
        policy_width=32,
        policy_layers=2,
        evaluation_points=2,
        validation_episodes=2,
        test_episodes=3,
        curve_episodes=2,
    ),
)

register(FETCH_TOY.id, "clbench.testing.fetch_toy:FETCH_TOY")
