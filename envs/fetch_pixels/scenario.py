"""The scenario clbench/FetchPixels-v0: all tasks share one scene, seen in camera pictures."""

from __future__ import annotations

from clbench.spec.budget import Budget
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task


def _task(name: str, *instructions: str) -> Task:
    return Task(
        name=name,
        suite="fetch_pixels",
        seed_name="fetch-pixels",
        instructions=instructions,
        horizon=60,
        world="clbench.envs.fetch_pixels.world:FetchPixelsWorld",
        expert="clbench.envs.fetch.experts:expert",
        camera="clbench.envs.fetch_pixels.camera:FetchCamera",
        packages=("gymnasium-robotics",),
    )


SCENARIO = Scenario(
    id="clbench/FetchPixels-v0",
    description="A robot arm and a block, seen by a camera: a policy gets numbers about the arm itself only.",
    retained=(
        _task(
            "reach",
            "move the gripper to the target",
            "reach the target with the closed gripper",
            "bring the closed gripper to the target",
            "go to the target and leave the block alone",
        ),
        _task(
            "hover",
            "hold the open gripper above the block",
            "hover over the block with open fingers",
            "open the gripper and stay above the block",
            "wait above the block with the gripper open",
        ),
        _task(
            "pick_and_place",
            "pick up the block and carry it to the target",
            "grasp the block and bring it to the target",
            "take the block and hold it at the target",
            "carry the block to the target in the gripper",
        ),
        _task(
            "push",
            "push the block to the target",
            "slide the block over the table to the target",
            "shove the block until it is at the target",
            "push the block along the table onto the target",
        ),
        _task(
            "push_left",
            "push the block to the left",
            "slide the block left",
            "shove the block toward the left side of the table",
            "move the block left with the closed gripper",
        ),
        _task(
            "push_away",
            "push the block away from the robot",
            "slide the block away",
            "shove the block farther from the robot",
            "move the block away with the closed gripper",
        ),
    ),
    target=(
        _task(
            "lift",
            "lift the block straight up",
            "raise the block high above the table",
            "grasp the block and lift it up",
            "take the block and hold it high in the air",
        ),
        _task(
            "push_right",
            "push the block to the right",
            "slide the block right",
            "shove the block toward the right side of the table",
            "move the block right with the closed gripper",
        ),
        _task(
            "pull",
            "pull the block toward the robot",
            "drag the block back",
            "bring the block nearer to the robot",
            "move the block back with the closed gripper",
        ),
        _task(
            "press",
            "press on the block from above",
            "touch the top of the block",
            "press the closed gripper down on the block",
            "put the closed fingers on top of the block",
        ),
    ),
    held_out=(
        _task(
            "hover_target",
            "hold the open gripper above the target",
            "hover over the target with open fingers",
            "open the gripper and stay above the target",
            "wait above the target with the gripper open",
        ),
        _task(
            "push_left_away",
            "push the block to the left and away",
            "slide the block left and away from the robot",
            "shove the block away and to the left",
            "move the block left and away with the closed gripper",
        ),
    ),
    questions="clbench.envs.fetch_pixels.questions:PIXEL_QUESTIONS",
    budget=Budget(demonstrations=500, question_episodes=1200, pretraining_steps=4000),
)
"""Six skills to keep, four tasks to learn in order, and two held-out combinations of learned skills.

Only the picture shows a policy where the block and the target are.
"""
