"""One episode of Meta-World: its own environments, on a model that all episodes of a task share."""

from __future__ import annotations

import copy
import functools
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import mujoco
import numpy as np
from gymnasium.utils.seeding import np_random
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from metaworld.sawyer_xyz_env import SawyerXYZEnv
from numpy.typing import NDArray

from clbench.base.entry_points import unknown
from clbench.worlds.perturbation import with_mass

from .state import State

Vector = NDArray[np.float64]
Look: TypeAlias = tuple[str, str, str]
"""Something in the physics: of what kind it is, what it is called, and which of its arrays is asked for."""

START = 0.03
"""Metres along each axis that a perturbed hand starts beside its place, three steps of it."""
SETTLE = 20
"""Steps, of 0.0125 s, in which it gets there and comes to rest."""

PHYSICS = ("model", "data", "mujoco_renderer", "init_left_pad", "init_right_pad", "_looks")
"""Attributes of an episode that are its physics or views of it: also what Meta-World calls initial pads."""


class Models:
    """A model, and copies of it: threads that step at the same time move things in one of their own.

    Args:
        model: Used by whichever asks first; a copy takes 19 MB, so none is made before it is needed.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        self._free = [(model, model.body_pos, model.site_pos)]

    def take(self) -> tuple[mujoco.MjModel, Vector, Vector]:
        """Return a model that no other thread has, with its places of bodies and sites."""
        try:
            return self._free.pop()
        except IndexError:
            model = copy.copy(self._model)
            return model, model.body_pos, model.site_pos

    def give_back(self, taken: tuple[mujoco.MjModel, Vector, Vector]) -> None:
        """Let others take a model."""
        self._free.append(taken)


@dataclass(frozen=True)
class Scene:
    """The compiled scene of a task. All its episodes in a process share it."""

    model: mujoco.MjModel
    body_pos: Vector
    """Places of the bodies as compiled, (bodies, 3): an episode begins by moving some."""
    site_pos: Vector
    """Places of the sites as compiled, (sites, 3)."""
    start: mujoco.MjData
    """The physics once the hand has gone to where it starts."""
    models: Models = field(init=False)
    """The model, for threads that advance episodes at the same time."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "models", Models(self.model))


class Episode(SawyerXYZEnv):
    """What an episode does otherwise than Meta-World's environment, of which it is a subclass for each task.

    1. The goal is part of the state: Meta-World's experts look at it.
    2. All follows from the seed. In Meta-World the first state can still show things where they stood in the
       episode before.
    3. The hand's way to its start, 50 steps, is made once for each task.
    4. The model is shared: an episode takes its own places of bodies and sites with it, see `place`.
    5. Parts of the physics are looked up by name once, and contacts all together.
    """

    scene: Scene
    _settle = 0

    def __init__(self) -> None:
        self._looks: dict[Look, Vector] = {}
        super().__init__()
        self._set_task_called = True
        self._partially_observable = False
        del self.sawyer_observation_space  # that of a hidden goal
        self._places = self.scene.body_pos.copy(), self.scene.site_pos.copy()
        self._hand_place = np.array(self.hand_init_pos)

    def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        return self.scene.model, mujoco.MjData(self.scene.model)

    def begin(self, seed: int, start: tuple[float, float, float] | None = None) -> State:
        """Draw the places of things from the seed, and return the first state (39,).

        Args:
            seed: Of the places.
            start: Share of `START`, from -1 to 1 along each axis, by which the hand of a perturbed episode
                starts beside its place; None in a plain one.
        """
        if start is not None:
            self._settle, self.hand_init_pos = SETTLE, self._hand_place + START * np.array(start)
        self.np_random = np_random(seed)[0]
        self.seeded_rand_vec, self._freeze_rand_vec = True, False
        self.model.body_pos[:], self.model.site_pos[:] = self.scene.body_pos, self.scene.site_pos
        self.reset_model()  # draws, and moves what is drawn
        self._freeze_rand_vec = True
        self.reset_model()  # with the same draw: now all is measured where it stands
        self._places = self.model.body_pos.copy(), self.model.site_pos.copy()
        mujoco.mj_forward(self.model, self.data)
        self._prev_obs = self._get_curr_obs_combined_no_goal()
        self.curr_path_length = 0
        return self._get_obs().astype(np.float32)

    def place(self) -> None:
        """Give the shared model this episode's places of bodies and sites."""
        self.model.body_pos[:], self.model.site_pos[:] = self._places

    def advance(self, action: NDArray[np.float32]) -> tuple[State, float, bool]:
        """Move by an action (4,) in [-1, 1]; return the state (39,), Meta-World's reward, and the success."""
        self.place()
        self.curr_path_length = 0  # whoever uses the world counts the steps
        state, reward, _, _, info = self.step(action)
        return state.astype(np.float32), float(reward), bool(info["success"])

    def move(self) -> None:
        """Advance the physics by one step, as far as observations and rewards depend on it.

        Many threads may do so at once, each with an episode of its own. What Meta-World computes in addition,
        forces in joints and contacts as they are after the step, is in nothing that is returned.
        """
        taken = self.scene.models.take()
        model, body_pos, site_pos = taken
        body_pos[:], site_pos[:] = self._places
        mujoco.mj_step(model, self.data, nstep=self.frame_skip)
        mujoco.mj_kinematics(model, self.data)
        self.scene.models.give_back(taken)

    @property
    def before(self) -> Vector:
        """How things were after the last step, (18,)."""
        return self._prev_obs

    @before.setter
    def before(self, now: Vector) -> None:
        self._prev_obs = now

    def __deepcopy__(self, memo: dict[int, Any]) -> Episode:
        """Return an episode with its own physics, in the same state."""
        copied = type(self)()
        mujoco.mj_copyData(copied.data, self.model, self.data)
        for name, value in vars(self).items():
            if name not in PHYSICS:
                setattr(copied, name, copy.deepcopy(value, memo))
        return copied

    def _reset_hand(self, steps: int = 50) -> None:
        mujoco.mj_copyData(self.data, self.model, self.scene.start)
        mujoco.mj_forward(self.model, self.data)
        super()._reset_hand(steps=self._settle)

    # ---- what is looked up by name ---------------------------------------------------------------------

    def look(self, look: Look) -> Vector:
        """Return a view of something in the physics."""
        if look not in self._looks:
            kind, name, array = look
            self._looks[look] = getattr(getattr(self.data, kind)(name), array)
        return self._looks[look]

    def get_body_com(self, body_name: str) -> Vector:
        """Return the place of a body (3,), as a view of the physics."""
        return self.look(("body", body_name, "xpos"))

    def _get_site_pos(self, site_name: str) -> Vector:
        return self.look(("site", site_name, "xpos")).copy()

    def get_endeff_pos(self) -> Vector:
        """Return the place of the hand (3,), as a view of the physics."""
        return self.get_body_com("hand")

    @property
    def tcp_center(self) -> Vector:
        """Place between the fingers (3,)."""
        right, left = self._get_site_pos("rightEndEffector"), self._get_site_pos("leftEndEffector")
        center: Vector = (right + left) / 2.0
        return center

    def touching_object(self, object_geom_id: int) -> bool:
        """Return whether both fingers press on a geom; Meta-World looks at each contact twice, in Python."""
        contact, force = self.data.contact, self.data.efc_force
        of_object = (contact.geom == object_geom_id).any(axis=1)
        for pad in ("leftpad_geom", "rightpad_geom"):
            of_both = of_object & (contact.geom == self.data.geom(pad).id).any(axis=1)
            if not sum(force[address] for address in contact.efc_address[of_both]) > 0:
                return False
        return True

    def _get_curr_obs_combined_no_goal(self) -> Vector:
        observation = np.zeros(18)
        observation[:3] = self.get_body_com("hand")
        apart = np.linalg.norm(self.get_body_com("rightclaw") - self.get_body_com("leftclaw"))
        observation[3] = min(max(float(apart) / 0.1, 0.0), 1.0)
        places, turns = self._get_pos_objects(), self._get_quat_objects()
        for number in range(len(places) // 3):
            first = 4 + 7 * number
            observation[first : first + 3] = places[3 * number : 3 * number + 3]
            observation[first + 3 : first + 7] = turns[4 * number : 4 * number + 4]
        return observation


@functools.cache
def _episode_class(task: str, mass: float | None) -> type[Episode]:
    if mass is not None:
        plain = _episode_class(task, None)
        scene, model = plain.scene, plain.scene.model
        model.body_pos[:], model.site_pos[:] = scene.body_pos, scene.site_pos  # an episode has moved them
        scene = replace(scene, model=with_mass(model, _things(model), mass))
        return type(f"Perturbed{plain.__name__}", (plain,), {"scene": scene})
    name = f"{task.replace('_', '-')}-v3"
    if name not in ALL_V3_ENVIRONMENTS:
        known = (entry.removesuffix("-v3").replace("-", "_") for entry in ALL_V3_ENVIRONMENTS)
        raise unknown("task of the Meta-World world", task, known)
    original = ALL_V3_ENVIRONMENTS[name]
    env: Any = original()
    env._reset_hand()
    model = env.model
    scene = Scene(model, model.body_pos.copy(), model.site_pos.copy(), env.data)
    return type(f"Episode{original.__name__}", (Episode, original), {"scene": scene})


def _things(model: mujoco.MjModel) -> list[int]:
    """Return the bodies that can be moved and are no part of the robot."""
    robot, moved = model.body("base").id, model.body_weldid != 0
    return [int(body) for body in np.flatnonzero(moved & (model.body_rootid != robot))]


def new_episode(task: str, mass: float | None = None) -> Episode:
    """Return a place for episodes of a task, as "drawer_open"; its scene is compiled when first needed.

    Args:
        task: What to do.
        mass: How many times as heavy things are in perturbed episodes; those of a plain place if None.

    Raises:
        LookupError: No task has this name; the nearest one is named.
    """
    return _episode_class(task, mass)()
