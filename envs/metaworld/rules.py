"""Meta-World's observations and rewards in the tasks of our scenarios, computed for many episodes at once.

Numbers and formulas come from `compute_reward` in `metaworld/envs/sawyer_<task>_v3.py`, in the same order of
operations. Tasks without an entry in `RULES` work too, with Meta-World's own code.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from .batch import Group, Part, Rule, Verdict
from .gripping import GRIPPING_RULES
from .rewards import Vector, gaussian, hamacher, long_tail, magnitude, near, norm


def _reach(group: Group) -> Verdict:
    """Reward of sawyer_reach_v3.py."""
    to_goal = norm(group.tcp - group.goal)
    return 10 * near(to_goal, 0.05, norm(group.start("hand_init_pos") - group.goal)), to_goal <= 0.05


def _door_close(group: Group) -> Verdict:
    """Reward of sawyer_door_close_v3.py."""
    to_goal = norm(group.thing - group.goal)
    in_place = near(to_goal, 0.05, norm(group.start("obj_init_pos") - group.goal), gaussian)
    hand_margin = norm(group.start("hand_init_pos") - group.thing) + 0.1
    hand_in_place = near(norm(group.tcp - group.goal), 0.25 * 0.05, hand_margin, gaussian)
    reward = 3 * hand_in_place + 6 * in_place
    return np.where(to_goal < 0.05, 10.0, reward), to_goal <= 0.08


def _door_unlock(group: Group) -> Verdict:
    """Reward of sawyer_door_unlock_v3.py, which uses the lock's current place as its initial one."""
    shoulder, scale = np.array([0.0, 0.055, 0.07]), np.array([0.25, 1.0, 0.5])
    to_lock = norm((group.hand + shoulder - group.thing) * scale)
    to_lock_first = norm(
        (group.start("init_tcp") + shoulder - group.look(("body", "lock_link", "xpos"))) * scale
    )
    ready = near(to_lock, 0.02, to_lock_first)
    to_goal = np.abs(group.goal[:, 0] - group.thing[:, 0])
    pushed = near(to_goal, 0.005, 0.1)
    return 2 * ready + 8 * pushed, to_goal <= 0.02


def _drawer_open(group: Group) -> Verdict:
    """Reward of sawyer_drawer_open_v3.py."""
    to_goal = norm(group.thing - group.goal)
    opening = near(to_goal, 0.02, 0.2)
    scale = np.array([3.0, 3.0, 1.0])
    handle_first = group.goal + np.array([0.0, 0.2, 0.0])
    margin = norm((handle_first - group.start("init_tcp")) * scale)
    caging = near(norm((group.thing - group.hand) * scale), 0.01, margin)
    return (caging + opening) * 5.0, to_goal <= 0.03


def _drawer_close(group: Group) -> Verdict:
    """Reward of sawyer_drawer_close_v3.py."""
    first = group.start("obj_init_pos")
    to_goal = norm(group.thing - group.goal)
    in_place = near(to_goal, 0.05, np.abs(norm(first - group.goal) - 0.05))
    reach_margin = np.abs(norm(first - group.start("init_tcp")) - 0.005)
    reach = near(norm(group.thing - group.tcp), 0.005, reach_margin, gaussian)
    reward = group.closed().into(
        lambda closed, reach, in_place: hamacher(hamacher(reach, closed), in_place) * 10, reach, in_place
    )
    success = to_goal <= 0.05 + 0.015
    return np.where(success, 10.0, reward.numbers), success


def _faucet(offset: tuple[float, float, float] | None = None) -> Callable[[Group], Verdict]:
    """Return the reward of sawyer_faucet_close_v3.py, or, with an offset, of sawyer_faucet_open_v3.py."""

    def judge(group: Group) -> Verdict:
        first = group.start("obj_init_pos")
        thing = group.thing if offset is None else group.thing + np.array(offset)
        to_goal = norm(thing - group.goal)
        in_place = near(to_goal, 0.07, np.abs(norm(first - group.goal) - 0.07))
        reach_margin = np.abs(norm(first - group.start("init_tcp")) - 0.01)
        reach = near(norm(thing - group.tcp), 0.01, reach_margin, gaussian)
        success = to_goal <= 0.07
        return np.where(success, 10.0, (2 * reach + 3 * in_place) * 2), success

    return judge


def _window(first_place: str, sigmoid: Callable[[Vector], Vector]) -> Callable[[Group], Verdict]:
    """Return the reward of sawyer_window_open_v3.py or sawyer_window_close_v3.py.

    Args:
        first_place: Name of the place from which the way along x is measured.
        sigmoid: Sigmoid of the reward for reaching.
    """

    def judge(group: Group) -> Verdict:
        goal = group.goal[:, 0]
        to_goal = magnitude(group.thing[:, 0] - goal)
        in_place = near(to_goal, 0.05, np.abs(magnitude(group.start(first_place)[:, 0] - goal) - 0.05))
        handle_first = group.start("window_handle_pos_init")
        reach_margin = np.abs(norm(handle_first - group.start("init_tcp")) - 0.02)
        reach = near(norm(group.thing - group.tcp), 0.02, reach_margin, sigmoid)
        return 10 * hamacher(reach, in_place), to_goal <= 0.05

    return judge


def _handle_press(group: Group) -> Verdict:
    """Reward of sawyer_handle_press_v3.py and sawyer_handle_press_side_v3.py."""
    first, goal = group.start("_handle_init_pos"), group.goal[:, 2]
    to_goal = magnitude(group.thing[:, 2] - goal)
    in_place = near(to_goal, 0.02, np.abs(magnitude(first[:, 2] - goal) - 0.02))
    reach_margin = np.abs(norm(first - group.start("init_tcp")) - 0.02)
    reach = near(norm(group.thing - group.tcp), 0.02, reach_margin)
    success = to_goal <= 0.02
    return np.where(success, 1.0, hamacher(reach, in_place)) * 10, success


def _button_press(group: Group) -> Verdict:
    """Reward of sawyer_button_press_v3.py."""
    to_button = norm(group.thing - group.tcp)
    to_goal = np.abs(group.goal[:, 1] - group.thing[:, 1])
    near_button = near(to_button, 0.05, norm(group.thing - group.start("init_tcp")))
    pressed = near(to_goal, 0.005, group.start("_obj_to_target_init"))
    reward = 2 * hamacher(group.opening, near_button)
    return np.where(to_button <= 0.05, reward + 8 * pressed, reward), to_goal <= 0.02


def _button_press_topdown(group: Group) -> Verdict:
    """Reward of sawyer_button_press_topdown_v3.py and sawyer_button_press_topdown_wall_v3.py."""
    to_button = norm(group.thing - group.tcp)
    to_goal = np.abs(group.goal[:, 2] - group.thing[:, 2])
    near_button = near(to_button, 0.01, norm(group.thing - group.start("init_tcp")))
    pressed = near(to_goal, 0.005, group.start("_obj_to_target_init"))
    reward = 5 * hamacher(1 - group.opening, near_button)
    return np.where(to_button <= 0.03, reward + 5 * pressed, reward), to_goal <= 0.024


def _plate_slide(group: Group) -> Verdict:
    """Reward of sawyer_plate_slide_v3.py."""
    first = group.start("obj_init_pos")
    to_goal = norm(group.thing - group.goal)
    in_place = near(to_goal, 0.05, norm(first - group.goal))
    grasped = near(norm(group.tcp - group.thing), 0.05, norm(group.start("init_tcp") - first))
    return np.where(to_goal < 0.05, 10.0, 8 * hamacher(grasped, in_place)), to_goal <= 0.07


RULES: Mapping[str, Rule] = {
    "button_press": Rule(
        _button_press,
        (Part(("body", "button", "xpos"), (0.0, -0.193, 0.0), rotation=("body", "button", "xquat")),),
    ),
    "button_press_topdown": Rule(
        _button_press_topdown,
        (Part(("body", "button", "xpos"), (0.0, 0.0, 0.193), rotation=("body", "button", "xquat")),),
    ),
    "button_press_topdown_wall": Rule(
        _button_press_topdown,
        (Part(("body", "button", "xpos"), (0.0, 0.0, 0.193), rotation=("body", "button", "xquat")),),
    ),
    "door_close": Rule(_door_close, (Part(("geom", "handle", "xpos"), rotation=("geom", "handle", "xmat")),)),
    "door_unlock": Rule(
        _door_unlock, (Part(("site", "lockStartUnlock", "xpos"), rotation=("body", "door_link", "xquat")),)
    ),
    "drawer_close": Rule(_drawer_close, (Part(("body", "drawer_link", "xpos"), (0.0, -0.16, 0.05)),)),
    "drawer_open": Rule(
        _drawer_open,
        (
            Part(
                ("body", "drawer_link", "xpos"), (0.0, -0.16, 0.0), rotation=("body", "drawer_link", "xquat")
            ),
        ),
    ),
    "faucet_close": Rule(
        _faucet(),
        (
            Part(
                ("site", "handleStartClose", "xpos"),
                (0.0, 0.0, -0.01),
                rotation=("body", "faucetBase", "xquat"),
            ),
        ),
    ),
    "faucet_open": Rule(
        _faucet((-0.04, 0.0, 0.03)),
        (
            Part(
                ("site", "handleStartOpen", "xpos"),
                (0.0, 0.0, -0.01),
                rotation=("body", "faucetBase", "xquat"),
            ),
        ),
    ),
    "handle_press": Rule(_handle_press, (Part(("site", "handleStart", "xpos")),)),
    "handle_press_side": Rule(_handle_press, (Part(("site", "handleStart", "xpos")),)),
    "plate_slide": Rule(_plate_slide, (Part(("geom", "puck", "xpos"), rotation=("geom", "puck", "xmat")),)),
    "reach": Rule(_reach, (Part(("body", "obj", "xpos"), rotation=("geom", "objGeom", "xmat")),)),
    "window_close": Rule(
        _window("window_handle_pos_init", gaussian), (Part(("site", "handleCloseStart", "xpos")),)
    ),
    "window_open": Rule(_window("obj_init_pos", long_tail), (Part(("site", "handleOpenStart", "xpos")),)),
    **GRIPPING_RULES,
}
"""Rule of each task."""
