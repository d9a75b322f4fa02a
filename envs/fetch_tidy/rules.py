"""The tasks of the tidy Fetch world, with what lies in front of the gripper at their start.

What a task does not need lies in a corner of the table. A policy can therefore see something of the task in
the state, as in most real scenes, where the plain Fetch world leaves everything to the words.
"""

from __future__ import annotations

from dataclasses import replace

from ..fetch.rules import CLOSED, OPEN, RULES, Layout, Numbers, Rule, opening
from ..fetch.state import BLOCK, GRIPPER, REST_HEIGHT

CLEARANCE = 0.06
"""Height in metres of the gripper above a block that was put down, at which it has let go."""
RAISED = 0.08
"""Metres by which a held block is raised."""


def _put_down() -> Rule:
    def success(state: Numbers, _: Numbers) -> bool:
        on_table = abs(state[BLOCK][2] - REST_HEIGHT) < 0.01
        return on_table and opening(state) > OPEN and state[GRIPPER][2] - state[BLOCK][2] > CLEARANCE

    def distance(state: Numbers, _: Numbers) -> float:
        return max(0.0, state[BLOCK][2] - REST_HEIGHT) + max(0.0, 0.1 - opening(state))

    return Rule(success, distance)


def _raise_block() -> Rule:
    def height(state: Numbers, start: Numbers) -> float:
        return state[BLOCK][2] - start[BLOCK][2]

    def success(state: Numbers, start: Numbers) -> bool:
        return height(state, start) > RAISED and CLOSED < opening(state) < OPEN

    return Rule(success, lambda state, start: max(0.0, RAISED - height(state, start)))


_LAYOUTS = {
    Layout(block_aside=True): ("reach", "hover_target"),
    Layout(target_aside=True): (
        "hover",
        "push_left",
        "push_away",
        "push_right",
        "press",
        "push_left_away",
    ),
    Layout(target_aside=True, block_held=True): ("put_down", "raise_block"),
    Layout(): ("pick_and_place", "push"),
}
"""Tasks by what is in front of the gripper: the target, the block, the block between the fingers, or both."""

_OWN = {"put_down": _put_down(), "raise_block": _raise_block()}
"""Tasks that the plain Fetch world does not have."""

TIDY_RULES: dict[str, Rule] = {
    name: replace(_OWN.get(name) or RULES[name], layout=layout)
    for layout, names in _LAYOUTS.items()
    for name in names
}
"""The rule of each task, by name."""
