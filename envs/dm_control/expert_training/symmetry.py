"""Tasks that are mirrored or shifted versions of others, so that one training serves both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..experts import Expert


@dataclass(frozen=True)
class Symmetry:
    """Derives the expert of a task from the expert of another task of the same body.

    The other expert acts on the observation minus `shift`, times `signs`; its action is multiplied by
    `action_signs`.
    """

    of: str
    """Name of the other task."""
    signs: tuple[float, ...]
    shift: tuple[float, ...]
    action_signs: tuple[float, ...]

    def apply(self, expert: Expert) -> Expert:
        """Return the derived expert. As tanh is odd, changed weights are enough."""
        layers = list(expert.layers)
        weight, bias = layers[0]
        seen = weight * np.array(self.signs, np.float32)
        layers[0] = (seen, bias - seen @ np.array(self.shift, np.float32))
        weight, bias = layers[-1]
        signs = np.array(self.action_signs, np.float32)
        layers[-1] = (signs[:, None] * weight, signs * bias)
        return Expert(tuple(layers))


SYMMETRIES: dict[str, Symmetry] = {
    # left and right change places
    "point_mass_left": Symmetry("point_mass_right", (-1.0, 1.0, -1.0, 1.0), (0.0,) * 4, (-1.0, 1.0)),
    "ball_in_cup_left": Symmetry("ball_in_cup_right", (-1.0, 1.0) * 4, (0.0,) * 8, (-1.0, 1.0)),
    "cartpole_right": Symmetry("cartpole_left", (-1.0, 1.0, -1.0, -1.0, -1.0), (0.0,) * 5, (-1.0,)),
    # the rail is the same everywhere except at its ends
    "cartpole_balance": Symmetry("cartpole_left", (1.0,) * 5, (0.8, 0.0, 0.0, 0.0, 0.0), (1.0,)),
}
"""Tasks whose experts are derived from the expert of another task."""
