"""Meta-World's rewards in tasks with a grasp, for many episodes at once: part of `rules`."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from clbench.base.errors import InputError

from .batch import Group, Part, Rule, Verdict
from .rewards import Floats, Mixed, Vector, between, hamacher, near, norm


def _caging(
    group: Group,
    thing: Vector,
    radius: float,
    pads_apart: float,
    close: float,
    effort: float = 1.0,
    dense: bool = True,
) -> Mixed:
    """Return how well the fingers surround and grip objects: the caging reward of sawyer_xyz_env.py.

    Args:
        group: Episodes with the objects.
        thing: Positions of the objects (N, 3).
        radius: Radius of a ball around an object (`obj_radius`).
        pads_apart: Distance of a finger pad along y that is near enough (`pad_success_thresh`).
        close: Distance in the plane of x and z that is near enough (`xz_thresh`).
        effort: Sufficient action of the fingers (`desired_gripper_effort`).
        dense: Whether there is a reward before the fingers close (`high_density`).
    """
    first, tcp_first = group.start("obj_init_pos"), group.start("init_tcp")
    margins = np.abs(np.abs(group.pads - first[:, 1]) - pads_apart)
    beside = between(np.abs(group.pads - thing[:, 1]), radius, pads_apart, margins)
    above_margin = _checked(norm(first[:, ::2] - tcp_first[:, ::2]) - close)
    above = near(norm(group.tcp[:, ::2] - thing[:, ::2]), close, above_margin)
    caging = hamacher(hamacher(beside[0], beside[1]), above)
    gripping = group.closed(effort, caging > 0.97)
    return gripping.into(_dense if dense else hamacher, caging)


def _dense(gripping: Floats, caging: Floats) -> Floats:
    return (hamacher(caging, gripping) + caging) / 2


def _straddling(group: Group, radius: float, close: float) -> tuple[Vector, Vector, Vector]:
    """Return how well the fingers surround the objects, in the variant of push_back and pick_place.

    These tasks use the current positions of the pads as their initial ones.

    Returns:
        The caging (N,), the distances of the objects from the right and the left pad along y (2, N), and the
        margins of these distances (2, N).
    """
    (right, left), y = group.pads, group.thing[:, 1]
    aside = np.stack([y - right, left - y])
    margins = np.abs(np.abs(aside) - 0.05)
    plane = np.array([1.0, 0.0, 1.0])
    above_margin = _checked(norm((group.start("obj_init_pos") - group.start("init_tcp")) * plane) - close)
    above = near(norm((group.tcp - group.thing) * plane), close, above_margin)
    beside = between(aside, radius, 0.05, margins)
    return hamacher(hamacher(beside[0], beside[1]), above), aside, margins


def _checked(margin: Vector) -> Vector:
    """Return a margin (N,) unless it is negative somewhere.

    Raises:
        InputError: A margin is negative, which Meta-World's reward does not allow.
    """
    if (margin < 0).any():
        raise InputError("The hand starts too near to an object: Meta-World has no reward for reaching it.")
    return margin


def _push(group: Group) -> Verdict:
    """Reward of sawyer_push_v3.py."""
    to_goal = norm(group.thing - group.goal)
    in_place = near(to_goal, 0.05, norm(group.start("obj_init_pos") - group.goal))
    held = (norm(group.thing - group.tcp) < 0.02) & (group.opening > 0)

    def total(grasped: Floats, placed: Floats) -> Floats:
        reward = 2 * grasped
        return np.where(held, reward + (1.0 + reward + placed), reward)

    reward = _caging(group, group.thing, 0.015, 0.05, 0.005).into(total, 5.0 * in_place)
    return np.where(to_goal < 0.05, 10.0, reward.numbers), to_goal <= 0.05


def _push_wall(group: Group) -> Verdict:
    """Reward of sawyer_push_wall_v3.py: first for the midpoint of the way round the wall, then the goal."""
    thing, first = group.thing, group.start("obj_init_pos")
    middle, scale = np.full_like(thing, (-0.05, 0.77, 0.0)), np.array([3.0, 1.0, 1.0])
    middle[:, 2] = thing[:, 2]
    half_way = near(norm((thing - middle) * scale), 0.05, norm((first - middle) * scale))
    to_goal = norm(thing - group.goal)
    in_place = near(to_goal, 0.05, norm(first - group.goal))
    held = (norm(thing - group.tcp) < 0.02) & (group.opening > 0)
    past = held & (thing[:, 1] > 0.75)

    def total(grasped: Floats, half_way: Floats, placed: Floats) -> Floats:
        reward = 2 * grasped
        later = np.where(past, reward + 1.0 + 4.0 + placed, reward + 1.0 + half_way)
        return np.where(held, later, reward)

    caging = _caging(group, thing, 0.015, 0.05, 0.005)
    reward = caging.into(total, 4.0 * half_way, 3.0 * in_place)
    return np.where(to_goal < 0.05, 10.0, reward.numbers), to_goal <= 0.07


def _push_back(group: Group) -> Verdict:
    """Reward of sawyer_push_back_v3.py."""
    thing, first = group.thing, group.start("obj_init_pos")
    to_goal, to_goal_first = norm(thing - group.goal), norm(first - group.goal)
    in_place = near(to_goal, 0.05, to_goal_first)
    caging, aside, margins = _straddling(group, 0.007, 0.01)
    on = between(aside, 0.007, 0.007 + 0.003, margins)
    grasped = (caging + np.where(caging > 0.95, hamacher(on[0], on[1]), 0.0)) / 2
    reward = hamacher(grasped, in_place)
    held = (norm(thing - group.tcp) < 0.01) & (group.opening > 0) & (group.opening < 0.55)
    held &= to_goal_first - to_goal > 0.01
    reward = np.where(held, reward + (1.0 + 5.0 * in_place), reward)
    return np.where(to_goal < 0.05, 10.0, reward), to_goal <= 0.07


def _pick_place(group: Group) -> Verdict:
    """Reward of sawyer_pick_place_v3.py."""
    thing, first = group.thing, group.start("obj_init_pos")
    to_goal = norm(thing - group.goal)
    in_place = near(to_goal, 0.05, norm(first - group.goal))
    caging, _, _ = _straddling(group, 0.015, 0.005)
    grasped = group.closed(counts=caging > 0.97).into(_dense, caging)
    held = (norm(thing - group.tcp) < 0.02) & (group.opening > 0) & (thing[:, 2] - 0.01 > first[:, 2])

    def total(grasped: Floats, in_place: Floats, placed: Floats) -> Floats:
        reward = hamacher(grasped, in_place)
        return np.where(held, reward + placed, reward)

    reward = grasped.into(total, in_place, 1.0 + 5.0 * in_place)
    return np.where(to_goal < 0.05, 10.0, reward.numbers), to_goal <= 0.07


def _shelf_place(group: Group) -> Verdict:
    """Reward of sawyer_shelf_place_v3.py: lower where a straight way would end below the shelf."""
    thing, goal, first = group.thing, group.goal, group.start("obj_init_pos")
    to_goal = norm(thing - goal)
    in_place = near(to_goal, 0.05, norm(first - goal))
    reward = _caging(group, thing, 0.02, 0.05, 0.01, dense=False).into(hamacher, in_place)
    x, y, z = thing.T
    low = (z > 0.0) & (z < 0.24) & (goal[:, 0] - 0.15 < x) & (x < goal[:, 0] + 0.15)
    before = low & (goal[:, 1] - 3 * 0.05 < y) & (y < goal[:, 1])
    depth, height = (y - (goal[:, 1] - 3 * 0.05)) / (3 * 0.05), (0.24 - z) / 0.24
    loss = hamacher(np.where(before, depth, 0.0), np.where(before, height, 0.0))
    in_place = np.where(before, np.clip(in_place - loss, 0.0, 1.0), in_place)
    in_place = np.where(low & (y > goal[:, 1]), 0.0, in_place)
    held = (norm(thing - group.tcp) < 0.025) & (group.opening > 0) & (z - 0.01 > first[:, 2])
    # subtracting a loss yields a number of NumPy, not of Python, which turns single precision into double
    lifted = Mixed(reward.numbers, reward.single & ~before).into(np.add, 1.0 + 5.0 * in_place)
    return np.where(to_goal < 0.05, 10.0, np.where(held, lifted.numbers, reward.numbers)), to_goal <= 0.07


def _peg_unplug_side(group: Group) -> Verdict:
    """Reward of sawyer_peg_unplug_side_v3.py."""
    thing, first = group.thing, group.start("obj_init_pos")
    to_goal = norm(thing - group.goal)
    in_place = near(to_goal, 0.05, norm(first - group.goal))
    held = (group.opening > 0.5) & (thing[:, 0] - first[:, 0] > 0.015) & (norm(thing - group.tcp) < 0.035)

    def total(grasped: Floats, placed: Floats) -> Floats:
        return np.where(held, 1 + 2 * grasped + placed, 2 * grasped)

    caging = _caging(group, thing, 0.025, 0.05, 0.005, effort=0.8)
    reward = caging.into(total, 5 * in_place)
    return np.where(to_goal <= 0.05, 10.0, reward.numbers), to_goal <= 0.07


def _hammer(group: Group) -> Verdict:
    """Reward of sawyer_hammer_v3.py."""
    hammer, grip = group.thing, group.thing.copy()
    beside = np.abs(hammer[:, 0] - group.hand[:, 0]) < 0.14 / 2.0
    grip[beside, 0] = group.hand[beside, 0]
    head = hammer + np.array([0.16, 0.06, 0.0])
    level = np.maximum(1.0 - norm(group.observation[:, 7:11] - np.array([1.0, 0.0, 0.0, 0.0])) / 0.4, 0.0)
    in_place = 0.1 * (head[:, 2] > 0.02) + 0.9 * near(norm(group.goal - head), 0.02, 0.2)

    def total(grasped: Floats, placed: Floats, level: Floats) -> Floats:
        return (2.0 * grasped + placed) * level

    reward = _caging(group, grip, 0.015, 0.02, 0.01).into(total, 6.0 * in_place, level).numbers
    success = group.look(("joint", "NailSlideJoint", "qpos"))[:, 0] > 0.09
    return np.where(success & (reward > 5.0), 10.0, reward), success


def _stick_pull(group: Group) -> Verdict:
    """Reward of sawyer_stick_pull_v3.py: grasp the stick, put it in the container's handle, and pull."""
    stick, handle, goal = group.thing, group.observation[:, 11:14], group.goal
    stick_first, container_first = group.start("stick_init_pos"), group.start("obj_init_pos")
    ahead, scale = np.array([0.05, 0.0, 0.0]), np.array([1.0, 1.0, 2.0])
    container = handle + ahead
    margin = norm((stick_first - (container_first + ahead)) * scale)
    at_container = near(norm((stick - container) * scale), 0.05, margin)
    stick_in_place = near(norm(stick - goal), 0.05, norm(stick_first - goal))
    container_in_place = near(norm(container - goal), 0.05, norm(container_first - goal))
    held = (norm(stick - group.tcp) < 0.02) & (group.opening > 0) & (stick[:, 2] - 0.01 > stick_first[:, 2])
    end = group.look(("site", "stick_end", "xpos"))
    apart = np.abs(end - handle)
    inserted = (end[:, 0] >= handle[:, 0]) & (apart[:, 1] <= 0.04) & (apart[:, 2] <= 0.06)
    there = norm(handle - goal) <= 0.12

    grasping = _caging(group, stick, 0.014, 0.05, 0.01).into(hamacher, at_container).numbers
    grasped = hamacher(np.ones_like(at_container), at_container)
    pulling = 1.0 + grasped + 5.0 + 2.0 * stick_in_place + 1.0 * container_in_place
    reward = np.where(inserted, np.where(there, 10.0, pulling), 1.0 + grasped + 5.0 * at_container)
    return np.where(held, reward, grasping), there & inserted


GRIPPING_RULES: Mapping[str, Rule] = {
    "hammer": Rule(
        _hammer,
        (
            Part(("body", "hammer", "xpos"), rotation=("body", "hammer", "xquat")),
            Part(("body", "nail_link", "xpos"), rotation=("body", "nail_link", "xquat")),
        ),
    ),
    "peg_unplug_side": Rule(
        _peg_unplug_side, (Part(("site", "pegEnd", "xpos"), rotation=("body", "plug1", "xquat")),)
    ),
    "pick_place": Rule(_pick_place, (Part(("body", "obj", "xpos"), rotation=("geom", "objGeom", "xmat")),)),
    "push": Rule(_push, (Part(("body", "obj", "xpos"), rotation=("geom", "objGeom", "xmat")),)),
    "push_back": Rule(_push_back, (Part(("geom", "objGeom", "xpos"), rotation=("geom", "objGeom", "xmat")),)),
    "push_wall": Rule(_push_wall, (Part(("geom", "objGeom", "xpos"), rotation=("geom", "objGeom", "xmat")),)),
    "shelf_place": Rule(_shelf_place, (Part(("body", "obj", "xpos"), rotation=("geom", "objGeom", "xmat")),)),
    "stick_pull": Rule(
        _stick_pull,
        (
            Part(("body", "stick", "xpos"), rotation=("body", "stick", "xmat")),
            Part(("site", "insertion", "xpos")),
        ),
    ),
}
"""Rule of each task with a grasp."""
