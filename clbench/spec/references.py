"""Names of the methods that other methods are compared with."""

from __future__ import annotations

BASELINE = "sft"
"""Plain fine-tuning: the method that gain, relative cost and cards compare with."""

JOINT = "joint"
"""Training on everything met so far: the limit for a method that has all the data."""

FROZEN = "frozen"
"""The pretrained policy, never changed: the abilities before any target."""

FROM_SCRATCH = "from_scratch"
"""A policy without pretraining: the cost of each target without transfer."""

REFERENCES = (JOINT, FROZEN, FROM_SCRATCH)
"""Methods that do not compete."""

COMPARED = (BASELINE, *REFERENCES)
"""Methods whose records a scenario card needs, the baseline first."""
