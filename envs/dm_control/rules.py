"""The tasks of the dm_control world: the body, the initial states and the rewards of each.

A task named after a task of dm_control has its rewards. The other tasks are variants on the same body with
the same initial states; only the instruction distinguishes them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .state import Observation

HORIZON = 100
"""Number of steps of an episode. A step takes 0.04 s, or 0.16 s for the slow point mass. dm_control's own
episodes last 10 s or 20 s."""
SUCCESS_SHARE = 0.8
"""Share of the expert's mean return that an episode must reach to succeed."""

POINT_TARGET = 0.015
"""Radius of the point mass's target, in metres."""
CUP_HALF_SIZE, BALL_RADIUS = 0.05, 0.025

Rewards: TypeAlias = NDArray[np.float64]
Reward: TypeAlias = Callable[[Observation, NDArray[np.float64]], Rewards]


@dataclass(frozen=True)
class Rule:
    """The definition of one task."""

    body: str
    """Domain of dm_control."""
    start: str
    """Task of the domain that the initial states come from."""
    reward: Reward
    """Maps observations (N, K) after a step and the actions (N, A) that led there to rewards (N,), 0 to 1."""
    guide: Reward | None = None
    """Maps the same arrays to the closeness (N,) of each state to a reward. Where the reward alone is nearly
    always 0, experts train on the mean of the reward and this guide; nothing else uses the guide."""
    mark: tuple[float, float] | None = None
    """Place of the drawn target (x, y) in metres, if the body has one."""
    batched: bool = False
    """Whether rewards computed together have the same bits as each computed alone. A power may differ: NumPy
    takes the C library's pow for one number, and a product for an array."""

    def rewards(self, observations: Observation, actions: NDArray[np.float64]) -> Rewards:
        """Return rewards (N,) for observations (N, K) after actions (N, A), with the bits of single calls."""
        if self.batched:
            return self.reward(observations, actions)
        pairs = zip(observations, actions, strict=True)
        return np.array([self.reward(observation, action) for observation, action in pairs])

    def training_reward(self, observation: Observation, action: NDArray[np.float64]) -> Rewards:
        """Return the reward that experts train on."""
        worth = self.reward(observation, action)
        return worth if self.guide is None else (worth + self.guide(observation, action)) / 2


def _tolerance(*values: Any, **options: Any) -> Rewards:
    from dm_control.utils.rewards import tolerance

    worth: Rewards = tolerance(*values, **options)
    return worth


def _length(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lengths of vectors (..., K), with the bits of `norm`; a sum of squares may differ."""
    length: NDArray[np.float64] = np.sqrt(np.vecdot(vectors, vectors))
    return length


def _near(distance: NDArray[np.float64], radius: float, margin: float) -> Rewards:
    """Return 1 within a radius, decreasing linearly to 0 at `margin` beyond it."""
    return _tolerance(distance, (0.0, radius), margin=margin, sigmoid="linear", value_at_margin=0.0)


def _small_control(action: NDArray[np.float64]) -> Rewards:
    worth = _tolerance(action, margin=1, value_at_margin=0, sigmoid="quadratic")
    mean: Rewards = (worth.mean(axis=-1) + 4) / 5
    return mean


def _move_to(observation: Observation, action: Rewards, *, place: tuple[float, float]) -> Rewards:
    """Return the reward of point_mass easy, with the target at `place`."""
    away = _length(np.array(place) - observation[..., :2])
    return _tolerance(away, bounds=(0, POINT_TARGET), margin=POINT_TARGET) * _small_control(action)


def _upright(observation: Observation, action: Rewards) -> Rewards:
    """Return the factor of cartpole's smooth reward that does not depend on the place of the cart."""
    upright = (observation[..., 1] + 1) / 2
    small_velocity = (1 + _tolerance(observation[..., 4], margin=5)) / 2
    worth: Rewards = upright * _small_control(action) * small_velocity
    return worth


def _balance(observation: Observation, action: Rewards) -> Rewards:
    centred = (1 + _tolerance(observation[..., 0], margin=2)) / 2
    return _upright(observation, action) * centred


def _balance_at(observation: Observation, action: Rewards, *, place: float, margin: float) -> Rewards:
    """Return the reward of cartpole balance with the cart at `place`, and 0 from a margin beyond it."""
    return _upright(observation, action) * _near(abs(observation[..., 0] - place), 0.25, margin)


def _catch(observation: Observation, _: Rewards) -> Rewards:
    """Return 1 if the ball is in the cup, else 0; at rest the cup is 0.55 m high, and the ball 0.2 m."""
    x = abs(observation[..., 0] - observation[..., 2])
    z = abs(0.55 + observation[..., 1] - (0.2 + observation[..., 3]))
    inside: Rewards = (np.maximum(x, z) < CUP_HALF_SIZE - BALL_RADIUS).astype(np.float64)
    return inside


def _catch_guide(observation: Observation, _: Rewards) -> Rewards:
    x = observation[..., 0] - observation[..., 2]
    z = 0.35 + observation[..., 1] - observation[..., 3]
    return _near(np.sqrt(x * x + z * z), 0.0, 0.5)


def _hold_cup(place: float) -> Rule:
    """Return the rule for holding the cup within 2 cm of a place left or right of its rest."""

    def reward(observation: Observation, _: Rewards, *, margin: float) -> Rewards:
        return _near(_length(observation[..., :2] - np.array([place, 0.0])), 0.02, margin)

    return Rule(
        "ball_in_cup",
        "catch",
        functools.partial(reward, margin=0.04),
        functools.partial(reward, margin=0.3),
        batched=True,
    )


def _point(x: float, y: float) -> Rule:
    """Return the rule for a point mass with its target at (x, y)."""
    return Rule(
        "point_mass",
        "easy",
        functools.partial(_move_to, place=(x, y)),
        lambda observation, _: _near(_length(observation[..., :2] - np.array([x, y])), POINT_TARGET, 0.4),
        mark=(x, y),
    )


def _cart(place: float) -> Rule:
    return Rule(
        "cartpole",
        "balance",
        functools.partial(_balance_at, place=place, margin=0.25),
        functools.partial(_balance_at, place=place, margin=1.5),
    )


RULES: dict[str, Rule] = {
    "point_mass_easy": _point(0.0, 0.0),
    "point_mass_left": _point(-0.15, 0.0),
    "point_mass_right": _point(0.15, 0.0),
    "cartpole_balance": Rule("cartpole", "balance", _balance),
    "cartpole_swingup": Rule("cartpole", "swingup", _balance),
    "cartpole_left": _cart(-0.8),
    "cartpole_right": _cart(0.8),
    "ball_in_cup_catch": Rule("ball_in_cup", "catch", _catch, _catch_guide, batched=True),
    "ball_in_cup_left": _hold_cup(-0.15),
    "ball_in_cup_right": _hold_cup(0.15),
}
