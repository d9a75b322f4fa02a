"""A Fetch scenario that takes half a minute: real worlds and experts, easy tasks and a small budget.

Plain fine-tuning learns its target and forgets its skills. Ten episodes of each task are too few to conclude
anything. Its name in a command is "clbench.testing.fetch_toy:clbench/FetchToy-v0".
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
    description="Fetch with two skills, one target and a budget of seconds; for a first try.",
    retained=_apart(_FETCH.retained[:2]),
    target=_apart(_FETCH.held_out[1:]),
    held_out=_apart(_FETCH.retained[2:]),
    background=(),
    scenes=_apart(_FETCH.retained + _FETCH.target[:1] + _FETCH.held_out),
    balanced=False,
    budget=Budget(
        demonstrations=80,
        question_episodes=150,
        test_questions=60,
        pretraining_steps=500,
        pretraining_learning_rate=3e-3,
        adaptation_steps=60,
        learning_rate=5e-4,
        batch_size=48,
        policy_width=48,
        policy_layers=2,
        evaluation_points=2,
        validation_episodes=5,
        test_episodes=10,
        curve_episodes=2,
    ),
)

register(FETCH_TOY.id, "clbench.testing.fetch_toy:FETCH_TOY")
