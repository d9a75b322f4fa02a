"""Methods that others are compared with, by name."""

from __future__ import annotations

BASELINE = "sft"
"""Plain fine-tuning: the method that matched retention, relative cost and cards compare with."""

JOINT = "joint"
"""Training on everything met so far: what a method with all the data can reach."""

FROZEN = "frozen"
"""The pretrained policy, never changed: what is there before any target."""

FROM_SCRATCH = "from_scratch"
"""A policy without pretraining: what each target needs if nothing is transferred."""

REFERENCES = (BASELINE, JOINT, FROZEN, FROM_SCRATCH)
"""All of them, the baseline first."""
