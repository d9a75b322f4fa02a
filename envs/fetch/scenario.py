"""The scenarios clbench/Fetch-v1, with targets of graded conflict, and clbench/FetchKnowledge-v1."""

from __future__ import annotations

import dataclasses

from clbench.spec.budget import Budget
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task


def _task(name: str, instructions: tuple[str, ...], test_instructions: tuple[str, ...]) -> Task:
    return Task(
        name=name,
        suite="fetch",
        seed_name="fetch_tidy",
        instructions=instructions,
        test_instructions=test_instructions,
        horizon=40,
        world="clbench.envs.fetch.world:FetchWorld",
        expert="clbench.envs.fetch.experts:expert",
        packages=("gymnasium-robotics",),
    )


_REACH = _task(
    "reach",
    (
        "move the gripper to the target",
        "reach the target with the closed gripper",
        "bring the closed gripper to the target",
        "go to the target with closed fingers",
        "touch the target with the fingers",
        "approach the target until the gripper is there",
    ),
    ("guide the closed gripper to the target", "reach for the target"),
)
_HOVER = _task(
    "hover",
    (
        "hold the open gripper above the block",
        "hover over the block with open fingers",
        "open the gripper and stay above the block",
        "wait above the block with the gripper open",
        "keep the open fingers over the block",
        "stop above the block and open the fingers",
    ),
    ("stay over the block with open fingers", "hold the open fingers above the block"),
)
_PICK_AND_PLACE = _task(
    "pick_and_place",
    (
        "pick up the block and carry it to the target",
        "grasp the block and bring it to the target",
        "take the block and hold it at the target",
        "carry the block to the target in the gripper",
        "pick the block and place it at the target",
        "grip the block and move it to the target",
    ),
    ("take the block to the target in the gripper", "grasp the block and hold it at the target"),
)
_PUSH = _task(
    "push",
    (
        "push the block to the target",
        "slide the block over the table to the target",
        "shove the block until it is at the target",
        "push the block along the table onto the target",
        "push the block until it is on the target",
        "sweep the block over the table onto the target",
    ),
    ("shove the block to the target", "slide the block onto the target"),
)
_PUSH_LEFT = _task(
    "push_left",
    (
        "push the block to the left",
        "slide the block left",
        "shove the block toward the left side of the table",
        "move the block left with the closed gripper",
        "push the block leftward",
        "sweep the block to the left side",
    ),
    ("shove the block left", "slide the block to the left side"),
)
_PUSH_AWAY = _task(
    "push_away",
    (
        "push the block away from the robot",
        "slide the block away",
        "shove the block farther from the robot",
        "move the block away with the closed gripper",
        "push the block forward",
        "sweep the block away from the robot",
    ),
    ("shove the block away", "slide the block farther away from the robot"),
)
_PUSH_RIGHT = _task(
    "push_right",
    (
        "push the block to the right",
        "slide the block right",
        "shove the block toward the right side of the table",
        "move the block right with the closed gripper",
        "push the block rightward",
        "sweep the block to the right side",
    ),
    ("shove the block right", "slide the block to the right side"),
)
_HOVER_TARGET = _task(
    "hover_target",
    (
        "hold the open gripper above the target",
        "hover over the target with open fingers",
        "open the gripper and stay above the target",
        "wait above the target with the gripper open",
        "keep the open fingers over the target",
        "stop above the target and open the fingers",
    ),
    ("stay over the target with open fingers", "hold the open fingers above the target"),
)
_PRESS = _task(
    "press",
    (
        "press on the block from above",
        "touch the top of the block",
        "press the closed gripper down on the block",
        "put the closed fingers on top of the block",
        "press the top of the block",
        "touch the block from above with closed fingers",
    ),
    ("press down on the block", "put the fingers on top of the block"),
)
_LIFT = _task(
    "lift",
    (
        "lift the block straight up",
        "raise the block high above the table",
        "grasp the block and lift it up",
        "take the block and hold it high in the air",
        "pick the block up from the table",
        "grip the block and raise it",
    ),
    ("pick up the block and hold it high", "lift the block high above the table"),
)
_CARRY_BACK = _task(
    "carry_back",
    (
        "carry the block back toward the robot",
        "move the held block closer to the robot",
        "take the block in the gripper toward the robot",
        "bring the held block back",
        "hold the block and go toward the robot",
        "carry what the gripper holds closer to the robot",
    ),
    ("carry the held block toward the robot", "take the held block back"),
)
_PUSH_LEFT_AWAY = _task(
    "push_left_away",
    (
        "push the block to the left and away",
        "slide the block left and away from the robot",
        "shove the block away and to the left",
        "move the block left and away with the closed gripper",
    ),
    ("sweep the block away and to the left",),
)

SCENARIO = Scenario(
    id="clbench/Fetch-v1",
    description="A robot arm learns to push right, press, lift and carry back, and keeps three skills.",
    retained=(_REACH, _HOVER, _PICK_AND_PLACE),
    target=(_PUSH_RIGHT, _PRESS, _LIFT, _CARRY_BACK),
    held_out=(_PUSH_LEFT_AWAY, _HOVER_TARGET),
    questions="clbench.envs.fetch.questions:QUESTIONS",
    background=(_PUSH, _PUSH_AWAY, _PUSH_LEFT),
    balanced=True,
    budget=Budget(criterion=0.9, adaptation_steps=1000, validation_episodes=20),
)
"""Three skills to keep, four targets of graded conflict, and two held-out combinations.

`push_right` shares scenes and most words with the pushes of the background. Those pushes are not skills,
because all methods without replay lose them alike. `press` shares scenes with `hover`. `lift` begins like
`pick_and_place`, with nothing to carry the block to. Only `carry_back` begins with a held block.
"""

KNOWLEDGE = dataclasses.replace(
    SCENARIO,
    id="clbench/FetchKnowledge-v1",
    description="A robot arm goes on pushing right long after it has learned to, and forgets what it knew.",
    target=(_PUSH_RIGHT,),
    balanced=False,
    budget=Budget(adaptation_steps=1280, evaluation_points=7, learning_rate=1e-3, validation_episodes=20),
)
"""The skills of `SCENARIO` and one long stage, in which plain fine-tuning loses answers to questions.

Tried with sft on seed 100: .02 of the answers are lost after 80 steps, .06 after 320 and .12 after 1280. With
a learning rate of 3e-4, .02 are lost after 1280 steps.
"""
