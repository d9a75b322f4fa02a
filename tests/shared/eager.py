"""The toy with stages that end when the target is learned, for tests of such runs."""

from dataclasses import replace

from clbench.spec.registry import register
from clbench.testing.toy import TOY

EAGER = replace(
    TOY,
    id="me/Eager-v0",
    balanced=True,
    budget=replace(TOY.budget, criterion=0.75, adaptation_steps=200, validation_episodes=4),
)
"""The toy with a criterion of three successes in four episodes, and an order of the targets for each seed."""

register(EAGER.id, f"{__name__}:EAGER")
