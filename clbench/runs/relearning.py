"""Relearning: how fast plain fine-tuning regains the retained skill that succeeds least.

A skill that comes back within a few steps was hidden rather than lost. All methods are measured alike: a copy
of the final policy is fine-tuned with all its parameters, adapters included, at the scenario's learning rate,
until it meets the criterion of the stages. Only parameters that the policy's own class freezes stay frozen.
"""

from __future__ import annotations

import copy

from clbench.base.progress import ProgressCallback
from clbench.base.seeding import derive_seed, seeded, torch_generator
from clbench.evaluation.checks import Checker
from clbench.evaluation.examiner import Examiner
from clbench.learning.adaptation import Step, adapt
from clbench.learning.method import Stage
from clbench.learning.optimise import MethodError
from clbench.learning.prior import Prior, Source
from clbench.learning.registry import load_method
from clbench.learning.trainer import Trainer
from clbench.policy.policy import Policy
from clbench.records.record import Relearning
from clbench.spec.protocol import Point
from clbench.spec.references import BASELINE
from clbench.spec.task import Task


def relearn(
    trainer: Trainer, examiner: Examiner, checker: Checker, progress: ProgressCallback
) -> Relearning | None:
    """Relearn the skill that succeeds least; return the outcome, None if plain fine-tuning fails.

    The skill is the one with the fewest successes in its validation episodes, the first on a tie.

    Args:
        trainer: Trainer of the run after the last stage; it does not change.
        examiner: Examiner of the run, which reports the progress of its own episodes.
        checker: Checker of the run.
        progress: Called with the number of optimiser steps done, or left out, since its last call.
    """
    successes = examiner.successes(trainer.policy)
    skill = min(successes, key=lambda name: successes[name])
    try:
        steps, met = _regain(trainer, trainer.scenario.task(skill), checker, progress)
    except MethodError:
        return None  # for example a diverged policy, whose loss is not finite
    progress(trainer.scenario.budget.adaptation_steps - steps)
    return Relearning(skill, successes[skill], steps, met)


def _trainable(policy: Policy, pretrained: Policy) -> Policy:
    """Return a copy that trains everything but what the policy's class freezes, such as an image encoder."""
    frozen = {name for name, one in pretrained.named_parameters() if not one.requires_grad}
    policy = copy.deepcopy(policy)
    for name, parameter in policy.named_parameters():
        # peft moves the weights of a layer with an adapter to `base_layer`
        parameter.requires_grad_(name.replace(".base_layer.", ".") not in frozen)
    return policy


def _regain(trainer: Trainer, skill: Task, checker: Checker, progress: ProgressCallback) -> tuple[int, bool]:
    """Fine-tune a copy of the policy on a skill; return the steps done, and whether it met the criterion."""
    budget, seed, number = trainer.scenario.budget, trainer.seed, len(trainer.scenario.target) + 1
    policy = _trainable(trainer.policy, trainer.pretrained)
    generator = torch_generator("relearning", seed)
    source = Source(trainer.data.demonstrations(skill), generator, budget.batch_size, trainer.device)
    stage = Stage(
        number, skill, derive_seed("relearning", seed), budget.adaptation_steps, source, prior=Prior({})
    )
    met = False

    def after(step: Step) -> bool:
        nonlocal met
        progress(min(step.done, 1))
        point = Point(number, step.done)
        met = checker.is_due(point) and checker.is_learned(checker.check(policy, skill, point))
        return met

    with seeded("relearning", seed):
        steps = adapt(policy, load_method(BASELINE)(step_factor=1.0), stage, budget, after)
    return steps, met
