"""The toy with so few steps and episodes that a run takes a third of a second; its policies learn nothing.

It is for tests of what happens around the learning: files, processes, clocks, and what is made once.
"""

from dataclasses import replace

from clbench.spec.registry import register
from clbench.testing.toy import TOY

TINY = replace(
    TOY,
    id="me/Tiny-v0",
    budget=replace(
        TOY.budget,
        demonstrations=4,
        test_questions=20,
        pretraining_steps=10,
        adaptation_steps=8,  # the time of a step is measured in blocks of five
        evaluation_points=2,
        validation_episodes=1,
        test_episodes=2,
        curve_episodes=1,
    ),
)

register(TINY.id, f"{__name__}:TINY")
