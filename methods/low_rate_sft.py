"""Low-rate SFT: plain fine-tuning at a fifth of the step size.

The control for every method that forgets less: such a method may only take smaller steps.
"""

from dataclasses import dataclass

from clbench.learning.method import Method, Progress

from ._requirements import in_range


@dataclass
class LowRateSFT(Method):
    """Minimise the target's action loss with smaller steps."""

    speed: float = 0.2
    """Factor of the step size."""

    def __post_init__(self) -> None:
        in_range("speed", self.speed, 1e-9)

    def learning_rate(self, scheduled: float, progress: Progress) -> float:
        """Return a share of the scheduled step size."""
        return self.speed * scheduled
