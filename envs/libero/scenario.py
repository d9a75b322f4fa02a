"""The scenarios of LIBERO: clbench/LiberoGoal-v0 and clbench/LiberoSpatial-v1."""

from __future__ import annotations

from clbench.spec.budget import Budget
from clbench.spec.scenario import Scenario

from . import tasks

GOAL = Scenario(
    id="clbench/LiberoGoal-v0",
    description="In one scene of LIBERO an arm learns to open, fill, turn and push, and keeps five skills.",
    retained=(
        tasks.BOWL_ON_STOVE,
        tasks.BOTTLE_ON_RACK,
        tasks.BOWL_ON_PLATE,
        tasks.BOTTLE_ON_CABINET,
        tasks.BOWL_ON_CABINET,
    ),
    target=(tasks.OPEN_DRAWER, tasks.CHEESE_IN_BOWL, tasks.TURN_ON_STOVE, tasks.PUSH_PLATE),
    held_out=(tasks.BOWL_IN_DRAWER,),
    questions="clbench.envs.libero.questions:QUESTIONS",
    balanced=True,
    budget=Budget(
        demonstrations=50,
        noisy_demonstrations=0.5,
        question_episodes=100,
        criterion=0.9,
        adaptation_steps=1000,
        validation_episodes=10,
        test_episodes=10,
    ),
)
"""The ten tasks of libero_goal: five skills to keep, four targets, and a held-out combination of two.

The skills carry the bowl or the bottle to five places. Each target has a motion of its own: pull, carry
another thing, turn and push. Evaluations are half as many as in Fetch-v1, and demonstrations a quarter: a
step costs seven times as much.
"""

SPATIAL = Scenario(
    id="clbench/LiberoSpatial-v1",
    description="An arm learns four places of LIBERO's bowl, and keeps skills of two other suites.",
    retained=(
        tasks.pick("milk"),
        tasks.pick("butter"),
        tasks.TURN_ON_STOVE,
        tasks.BOTTLE_ON_CABINET,
    ),
    target=(
        tasks.bowl("between_the_plate_and_the_ramekin"),
        tasks.bowl("on_the_cookie_box"),
        tasks.bowl("on_the_ramekin"),
        tasks.bowl("next_to_the_plate"),
    ),
    held_out=(tasks.bowl("on_the_wooden_cabinet", "on the cabinet", 150),),
    questions="clbench.envs.libero.questions:QUESTIONS",
    background=(
        *map(
            tasks.pick,
            (
                "alphabet_soup",
                "bbq_sauce",
                "chocolate_pudding",
                "cream_cheese",
                "ketchup",
                "orange_juice",
                "salad_dressing",
                "tomato_sauce",
            ),
        ),
        tasks.BOTTLE_ON_RACK,
        tasks.BOWL_ON_CABINET,
        tasks.BOWL_ON_PLATE,
        tasks.BOWL_ON_STOVE,
        tasks.CHEESE_IN_BOWL,
        tasks.OPEN_DRAWER,
        tasks.PUSH_PLATE,
        *map(tasks.bowl, ("from_table_center", "next_to_the_cookie_box", "next_to_the_ramekin")),
    ),
    scenes=(tasks.BOWL_ON_PLATE, tasks.BOTTLE_ON_CABINET),
    balanced=True,
    budget=Budget(
        demonstrations=60,
        noisy_demonstrations=0.5,
        question_episodes=40,
        pretraining_steps=12000,
        criterion=0.9,
        adaptation_steps=1000,
        validation_episodes=10,
        test_episodes=10,
    ),
)
"""ConSFT's setting: targets of libero_spatial; skills of libero_object and libero_goal to keep.

Only a broad pretraining makes forgetting gradual: with five to seven tasks in it, a target or two erased all
skills (docs/guide/libero.md). It therefore has 18 tasks that no score counts, and 12,000 steps.
"""
