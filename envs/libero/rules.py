"""The success conditions of LIBERO's tasks, as their BDDL files state them.

A goal is a list of predicates, such as `(On bowl_1 plate_1)`, that must hold together at the end of a step.
They follow `object_states/base_object_states.py` of LIBERO, and call LIBERO's own tests of boxes and joints.
Names are looked up once, and all contacts are tested together.

As in LIBERO, a predicate sees positions and contacts at the start of the last physics step, which takes 2 ms,
and joints at its end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeAlias

import mujoco
import numpy as np
from numpy.typing import NDArray

from clbench.base.entry_points import unknown

Predicate: TypeAlias = Callable[[mujoco.MjData], bool]

LEVEL = 0.03
"""Largest horizontal distance in metres between the centres of an object and the object that it is on."""


def goal_of(env: Any, model: mujoco.MjModel) -> list[Predicate]:
    """Return the predicates of the goal of LIBERO's environment.

    Args:
        env: LIBERO's environment of a task.
        model: Compiled scene.

    Raises:
        UnknownNameError: The goal has a predicate that LIBERO's three suites do not use.
    """
    predicates = []
    for name, *things in env.parsed_problem["goal_state"]:
        if name not in PREDICATES:
            raise unknown("predicate of the LIBERO world", name, PREDICATES)
        predicates.append(PREDICATES[name](env, model, *things))
    return predicates


def _on(env: Any, model: mujoco.MjModel, thing: str, support: str) -> Predicate:
    """Return the predicate that a thing lies on an object, or on a region of the table or of an object."""
    body = _body(env, model, thing)
    if support not in env.object_sites_dict:
        below, touching = _body(env, model, support), _touching(env, model, thing, support)

        def on_object(data: mujoco.MjData) -> bool:
            place, other = data.xpos[below], data.xpos[body]
            level = np.linalg.norm(place[:2] - other[:2]) < LEVEL
            return bool(place[2] <= other[2] and level and touching(data))

        return on_object

    region, site = env.object_sites_dict[support], int(model.site(support).id)
    owner = region.parent_name  # None if the region belongs to the table
    touches_owner = _touching(env, model, thing, owner) if owner is not None else lambda _: True

    def on_region(data: mujoco.MjData) -> bool:
        axes = data.site_xmat[site].reshape(3, 3)
        return bool(region.under(data.site_xpos[site], axes, data.xpos[body]) and touches_owner(data))

    return on_region


def _in(env: Any, model: mujoco.MjModel, thing: str, container: str) -> Predicate:
    """Return the predicate that the centre of a thing is inside the box of a region."""
    body, region, site = (
        _body(env, model, thing),
        env.object_sites_dict[container],
        int(model.site(container).id),
    )

    def in_region(data: mujoco.MjData) -> bool:
        axes = data.site_xmat[site].reshape(3, 3)
        return bool(region.in_box(data.site_xpos[site], axes, data.xpos[body]))

    return in_region


def _joint(
    test: str, enough: Callable[[Iterable[bool]], bool]
) -> Callable[[Any, mujoco.MjModel, str], Predicate]:
    """Return the predicate about the joints of a thing, or of the part that carries a region.

    Args:
        test: Name of the test of one joint position in LIBERO's class of the object.
        enough: `any` or `all`: how many of the joints must pass it.
    """

    def predicate(env: Any, model: mujoco.MjModel, thing: str) -> Predicate:
        region = env.object_sites_dict.get(thing)
        owner = env.get_object(thing if region is None else region.parent_name)
        joints = (owner if region is None else region).joints
        addresses, passes = [int(model.joint(joint).qposadr[0]) for joint in joints], getattr(owner, test)
        return lambda data: enough(passes(data.qpos[address]) for address in addresses)

    return predicate


PREDICATES: Mapping[str, Callable[..., Predicate]] = {
    "on": _on,
    "in": _in,
    "open": _joint("is_open", any),
    "close": _joint("is_close", all),
    "turnon": _joint("turn_on", any),
    "turnoff": _joint("turn_off", all),
}
"""The predicates of LIBERO's goals, by their names in BDDL."""


def _body(env: Any, model: mujoco.MjModel, thing: str) -> int:
    return int(model.body(env.get_object(thing).root_body).id)


def _touching(env: Any, model: mujoco.MjModel, one: str, other: str) -> Predicate:
    """Return the predicate that two objects touch each other."""
    of_one, of_other = _geoms(env, model, one), _geoms(env, model, other)

    def touching(data: mujoco.MjData) -> bool:
        first, second = data.contact.geom.T
        return bool(np.any((of_one[first] & of_other[second]) | (of_one[second] & of_other[first])))

    return touching


def _geoms(env: Any, model: mujoco.MjModel, thing: str) -> NDArray[np.bool_]:
    """Return which geoms of the model are the solid ones of a thing, (geoms,)."""
    solid = np.zeros(model.ngeom, np.bool_)
    solid[[model.geom(geom).id for geom in env.get_object(thing).contact_geoms]] = True
    return solid
