"""The scenarios clbench/MetaWorld-v1, with six skills to keep, and clbench/MetaWorldCW-v0, with none."""

from __future__ import annotations

import dataclasses

from clbench.spec.budget import Budget
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task


def _task(name: str, horizon: int, *instructions: str) -> Task:
    return Task(
        name=name,
        suite="metaworld",
        instructions=instructions,
        horizon=horizon,
        world="clbench.envs.metaworld.world:MetaWorldWorld",
        expert="clbench.envs.metaworld.experts:expert",
        packages=("metaworld",),
    )


_FAUCET_CLOSE = _task(
    "faucet_close",
    100,
    "close the faucet",
    "turn the faucet off",
    "rotate the handle of the faucet to the left",
    "turn the knob of the faucet until it is closed",
)

_WINDOW_CLOSE = _task(
    "window_close",
    120,
    "close the window",
    "slide the window closed",
    "push the handle of the window to the left",
    "move the window to the left until it is closed",
)

_HANDLE_PRESS_SIDE = _task(
    "handle_press_side",
    80,
    "press the handle down from the side",
    "push the handle on the side downward",
    "press down on the handle at the side",
    "push the lever at the side down",
)

_SKILLS = (
    _task(
        "door_close",
        110,
        "close the door",
        "push the door closed",
        "swing the door until it is closed",
        "push the handle of the door back",
    ),
    _task(
        "drawer_open",
        120,
        "open the drawer",
        "pull the drawer open",
        "pull the handle of the drawer toward the robot",
        "slide the drawer out until it is open",
    ),
    _task(
        "window_open",
        120,
        "open the window",
        "slide the window open",
        "push the handle of the window to the right",
        "move the window to the right until it is open",
    ),
    _task(
        "faucet_open",
        100,
        "open the faucet",
        "turn the faucet on",
        "rotate the handle of the faucet to the right",
        "turn the knob of the faucet until it is open",
    ),
    _task(
        "handle_press",
        80,
        "press the handle down",
        "push the handle downward",
        "press down on the handle",
        "push the lever down with the gripper",
    ),
    _task(
        "button_press_topdown",
        110,
        "press the button from above",
        "push the button down from the top",
        "press down on the button",
        "come from above and press the button",
    ),
    _task(
        "door_unlock",
        80,
        "unlock the door",
        "turn the bolt and unlock the door",
        "rotate the lock of the door until it is open",
        "push the lock to the right and unlock the door",
    ),
    _task(
        "plate_slide",
        90,
        "slide the plate into the goal",
        "push the plate away from the robot into the goal",
        "slide the plate forward until it is in the goal",
        "shove the plate into the goal",
    ),
)

SCENARIO = Scenario(
    id="clbench/MetaWorld-v1",
    description="Meta-World's arm learns to close and press objects, after six other skills.",
    retained=_SKILLS[:6],
    target=(
        _FAUCET_CLOSE,
        _task(
            "button_press",
            100,
            "press the button from the front",
            "push the button away from the robot",
            "press the button forward",
            "come from the front and press the button",
        ),
        _task(
            "drawer_close",
            120,
            "close the drawer",
            "push the drawer closed",
            "push the handle of the drawer away from the robot",
            "slide the drawer in until it is closed",
        ),
        _WINDOW_CLOSE,
    ),
    held_out=(
        _HANDLE_PRESS_SIDE,
        _task(
            "button_press_topdown_wall",
            100,
            "press the button behind the wall from above",
            "push the button down over the wall",
            "come over the wall and press down on the button",
            "reach over the wall and press the button",
        ),
    ),
    questions="clbench.envs.metaworld.questions:QUESTIONS",
    background=_SKILLS[6:],
    scenes=_SKILLS,
    balanced=True,
    budget=Budget(demonstrations=100, criterion=0.9, adaptation_steps=1000, validation_episodes=20),
)
"""Six skills to keep, four targets with objects of these skills, and two held-out variants.

Two more skills are pretrained and not scored. With all eight, a policy that never changes has a final average
of .67, and tuned plain fine-tuning .66 and .71 on two seeds: there would be no room between them.
"""

_CW10 = (
    _task(
        "hammer",
        110,
        "hit the nail with the hammer",
        "take the hammer and drop it on the nail",
        "pick up the hammer and hit the nail",
        "grasp the hammer and strike the nail with it",
    ),
    _task(
        "push_wall",
        130,
        "push the block around the wall to the target",
        "slide the block along the wall to the target",
        "take the block behind the wall to the target",
        "move the block around the wall until it is at the target",
    ),
    _FAUCET_CLOSE,
    _task(
        "push_back",
        130,
        "push the block back to the target",
        "pull the block toward the robot to the target",
        "drag the block back to the target",
        "move the block back until it is at the target",
    ),
    _task(
        "stick_pull",
        150,
        "pull the container with the stick",
        "take the stick and pull the container to the target",
        "drag the container to the target with the stick",
        "put the stick in the handle and pull the container",
    ),
    _HANDLE_PRESS_SIDE,
    _task(
        "push",
        110,
        "push the block to the target",
        "slide the block over the table to the target",
        "shove the block forward to the target",
        "move the block along the table onto the target",
    ),
    _task(
        "shelf_place",
        140,
        "place the block on the shelf",
        "put the block on the shelf",
        "pick up the block and place it on the shelf",
        "carry the block to the shelf and put it there",
    ),
    _WINDOW_CLOSE,
    _task(
        "peg_unplug_side",
        150,
        "unplug the peg",
        "pull the peg out of the hole",
        "pull the peg out to the side",
        "take the peg and pull it out of the box",
    ),
)

CONTINUAL_WORLD = Scenario(
    id="clbench/MetaWorldCW-v0",
    description="The ten tasks of Continual World in their order, from Meta-World v3: not comparable to v1.",
    retained=(),
    target=tuple(dataclasses.replace(task, suite="metaworld_cw", seed_name="metaworld-cw") for task in _CW10),
    held_out=(),
    questions="clbench.envs.metaworld.questions:QUESTIONS",
    scenes=(
        *_SKILLS,
        _task("reach", 80, "move the gripper to the target"),
        _task("pick_place", 120, "pick up the block and place it at the target"),
        _task("stick_push", 120, "push the container with the stick"),
    ),
    budget=Budget(
        demonstrations=100,
        noisy_demonstrations=0.25,
        pretraining_steps=1500,
        adaptation_steps=700,
        learning_rate=2e-3,
        policy_width=64,
        policy_layers=2,
        evaluation_points=2,
        test_episodes=10,
    ),
)
"""The ten tasks of CW10 in their order, without retained skills: Wolczyk et al. 2021 (arXiv 2105.10919)."""
