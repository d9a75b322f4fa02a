"""One episode of Meta-World: its own environment, on a model that all episodes of a task share."""

from __future__ import annotations

import contextlib
import copy
import functools
from collections.abc import Iterator
from typing import Any, TypeAlias

import mujoco
import numpy as np
from gymnasium.utils.seeding import np_random
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from metaworld.sawyer_xyz_env import SawyerXYZEnv
from numpy.typing import NDArray

from clbench.base.entry_points import unknown

from .scene import Scene, Vector, scene_of
from .state import State

Look: TypeAlias = tuple[str, str, str]
"""An array in the physics: the kind of an element, its name, and the name of one of its arrays."""

START = 0.03
"""Largest displacement in metres of a perturbed hand along each axis, three steps' worth."""
SETTLE = 20
"""Steps of 0.0125 s for this displacement, until the hand is at rest."""

PHYSICS = ("model", "data", "mujoco_renderer", "init_left_pad", "init_right_pad", "_looks")
"""Attributes of an episode that are physics or views of it, including Meta-World's so-called initial pads."""


class Episode(SawyerXYZEnv):
    """An episode, with its differences from Meta-World's environment; each task has a subclass of both.

    1. The goal is part of the state: Meta-World's experts need it.
    2. The seed determines everything. In Meta-World the first state can still show objects where they were in
       the previous episode.
    3. The hand moves to its start, 50 steps, only once per task.
    4. Episodes share the model: each keeps its own places of bodies and sites, see `place`.
    5. Parts of the physics are looked up by name once, and contacts are tested together.
    """

    scene: Scene
    _settle = 0

    def __init__(self) -> None:
        self._looks: dict[Look, Vector] = {}
        super().__init__()
        self._set_task_called = True
        self._partially_observable = False
        del self.sawyer_observation_space  # cached with a hidden goal
        self._places = self.scene.body_pos.copy(), self.scene.site_pos.copy()
        self._hand_place = np.array(self.hand_init_pos)

    def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        return self.scene.model, mujoco.MjData(self.scene.model)

    def begin(self, seed: int, start: tuple[float, float, float] | None = None) -> State:
        """Draw the places of objects from the seed, and return the first state (39,).

        Args:
            seed: Seed of the places.
            start: Displacement of the hand in a perturbed episode, as shares of `START` from -1 to 1 along
                each axis; None in a plain episode.
        """
        if start is not None:
            self._settle, self.hand_init_pos = SETTLE, self._hand_place + START * np.array(start)
        self.np_random = np_random(seed)[0]
        self.seeded_rand_vec, self._freeze_rand_vec = True, False
        with self._own_model() as model:
            model.body_pos[:], model.site_pos[:] = self.scene.body_pos, self.scene.site_pos
            self.reset_model()  # draws places and moves objects there
            self._freeze_rand_vec = True
            self.reset_model()  # with the same draw: measures all objects in place
            self._places = model.body_pos.copy(), model.site_pos.copy()
            mujoco.mj_forward(model, self.data)
            self._prev_obs = self._get_curr_obs_combined_no_goal()
            self.curr_path_length = 0
            return self._get_obs().astype(np.float32)

    @contextlib.contextmanager
    def _own_model(self) -> Iterator[mujoco.MjModel]:
        """Let Meta-World's code use a model that no other thread moves or steps, and return it."""
        taken = self.scene.models.take()
        self.model = taken[0]
        try:
            yield self.model
        finally:
            self.model = self.scene.model
            self.scene.models.give_back(taken)

    def complete(self) -> None:
        """Compute what a picture needs beyond a step; no other thread steps in the model meanwhile."""
        with self._own_model() as model:
            self.place()
            mujoco.mj_forward(model, self.data)

    def place(self) -> None:
        """Set the places of bodies and sites in the model to this episode's."""
        self.model.body_pos[:], self.model.site_pos[:] = self._places

    def advance(self, action: NDArray[np.float32]) -> tuple[State, float, bool]:
        """Move by an action (4,) in [-1, 1]; return the state (39,), Meta-World's reward and the success."""
        self.curr_path_length = 0  # the caller counts the steps
        with self._own_model():
            self.place()
            state, reward, _, _, info = self.step(action)
        return state.astype(np.float32), float(reward), bool(info["success"])

    def move(self) -> None:
        """Advance the physics by one step, as far as observations and rewards depend on it.

        Several threads may call it at once, each for another episode. Meta-World also computes forces in
        joints and contacts after the step, which no result depends on.
        """
        taken = self.scene.models.take()
        model, body_pos, site_pos = taken
        body_pos[:], site_pos[:] = self._places
        mujoco.mj_step(model, self.data, nstep=self.frame_skip)
        mujoco.mj_kinematics(model, self.data)
        self.scene.models.give_back(taken)

    @property
    def before(self) -> Vector:
        """The current part of the last observation, (18,)."""
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

    # ---- lookups by name -------------------------------------------------------------------------------

    def look(self, look: Look) -> Vector:
        """Return a view of an array in the physics."""
        if look not in self._looks:
            kind, name, array = look
            self._looks[look] = getattr(getattr(self.data, kind)(name), array)
        return self._looks[look]

    def get_body_com(self, body_name: str) -> Vector:
        """Return the position of a body (3,), a view of the physics."""
        return self.look(("body", body_name, "xpos"))

    def _get_site_pos(self, site_name: str) -> Vector:
        return self.look(("site", site_name, "xpos")).copy()

    def get_endeff_pos(self) -> Vector:
        """Return the position of the hand (3,), a view of the physics."""
        return self.get_body_com("hand")

    @property
    def tcp_center(self) -> Vector:
        """Midpoint between the fingers (3,)."""
        right, left = self._get_site_pos("rightEndEffector"), self._get_site_pos("leftEndEffector")
        center: Vector = (right + left) / 2.0
        return center

    def touching_object(self, object_geom_id: int) -> bool:
        """Return whether both fingers press on a geom; Meta-World tests each contact twice, in Python."""
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
        return type(f"Perturbed{plain.__name__}", (plain,), {"scene": plain.scene.with_mass(mass)})
    name = f"{task.replace('_', '-')}-v3"
    if name not in ALL_V3_ENVIRONMENTS:
        known = (entry.removesuffix("-v3").replace("-", "_") for entry in ALL_V3_ENVIRONMENTS)
        raise unknown("task of the Meta-World world", task, known)
    original = ALL_V3_ENVIRONMENTS[name]
    return type(f"Episode{original.__name__}", (Episode, original), {"scene": scene_of(original)})


def new_episode(task: str, mass: float | None = None) -> Episode:
    """Return an object that runs episodes of a task; the first one of a task compiles its scene.

    Args:
        task: Name of the task, such as "drawer_open".
        mass: Factor on the masses of objects in perturbed episodes; None for plain episodes.

    Raises:
        UnknownNameError: No task has this name; the error names the nearest one.
    """
    return _episode_class(task, mass)()
