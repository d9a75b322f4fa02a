"""The scenario clbench/DMControl-v0: three bodies in padded spaces, with several tasks for each."""

from __future__ import annotations

from clbench.spec.budget import Budget
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task

from .rules import HORIZON


def _task(name: str, *instructions: str) -> Task:
    return Task(
        name=name,
        suite="dm_control",
        instructions=instructions,
        horizon=HORIZON,
        world="clbench.envs.dm_control.world:DMControlWorld",
        expert="clbench.envs.dm_control.experts:expert",
        # three bursts in 100 steps: with ten, few episodes reach the return required for success
        action_noise=0.03,
        packages=("dm-control",),
    )


SCENARIO = Scenario(
    id="clbench/DMControl-v0",
    description="Three bodies of dm_control learn variants of their skills, at other places or mirrored.",
    retained=(
        _task(
            "point_mass_easy",
            "move the point to the centre",
            "bring the point to the middle",
            "hold the point in the centre",
            "send the point to the middle and stop there",
        ),
        _task(
            "point_mass_left",
            "move the point to the left",
            "bring the point to the left side",
            "hold the point on the left",
            "send the point left and stop there",
        ),
        _task(
            "cartpole_balance",
            "balance the pole on the cart",
            "keep the pole upright in the middle",
            "hold the pole up with the cart in the centre",
            "stay in the centre with the pole balanced",
        ),
        _task(
            "cartpole_swingup",
            "swing the pole up and balance it",
            "raise the pole from below and keep it upright",
            "swing the pole upwards and hold it there",
            "bring the pole up and keep it balanced",
        ),
        _task(
            "ball_in_cup_catch",
            "catch the ball in the cup",
            "swing the ball into the cup",
            "get the ball into the cup and keep it there",
            "toss the ball up and catch it with the cup",
        ),
    ),
    target=(
        _task(
            "point_mass_right",
            "move the point to the right",
            "bring the point to the right side",
            "hold the point on the right",
            "send the point right and stop there",
        ),
        _task(
            "cartpole_left",
            "balance the pole on the left side",
            "move the cart left and keep the pole upright",
            "hold the pole up with the cart on the left",
            "go left with the pole balanced",
        ),
        _task(
            "ball_in_cup_right",
            "hold the cup on the right",
            "move the cup to the right",
            "pull the cup right and keep it there",
            "bring the cup with the ball to the right side",
        ),
        _task(
            "cartpole_right",
            "balance the pole on the right side",
            "move the cart right and keep the pole upright",
            "hold the pole up with the cart on the right",
            "go right with the pole balanced",
        ),
    ),
    held_out=(
        _task(
            "ball_in_cup_left",
            "hold the cup on the left",
            "move the cup to the left",
            "pull the cup left and keep it there",
            "bring the cup with the ball to the left side",
        ),
    ),
    questions="clbench.envs.dm_control.questions:QUESTIONS",
    budget=Budget(),
)
"""Five skills to keep, four variants of them to learn in order, and one held-out mirror image."""
