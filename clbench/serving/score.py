"""Score a policy that was fine-tuned elsewhere: stage by stage, on the test episodes of every run.

Its record has the division `external`: how the policy was trained is declared by its authors, and not known.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from clbench.base.errors import InputError
from clbench.base.progress import ProgressCallback, no_progress
from clbench.base.seeding import seeded
from clbench.evaluation.episodes import Episode, Trial
from clbench.evaluation.players import ChunkPolicy, play_chunks
from clbench.records.paths import RECORDS
from clbench.records.record import Record
from clbench.runs.agents import StagedRun
from clbench.spec.registry import load_scenario

USES = {"external": True}
"""`RunInfo.uses` of a policy that was trained elsewhere. Nothing is known of its data: it may even have
learned from the demonstrations of clbench, which can be exported."""


def is_scored(
    scenario: str, *, stage: int, method: str, seed: int = 0, records: Path | str = RECORDS
) -> bool:
    """Return whether a stage has been scored; the arguments are those of `score`.

    Raises:
        InputError: An earlier stage comes first, there is no such stage, or the name or the seed is invalid.
    """
    run = StagedRun(load_scenario(scenario), method, seed, Path(records))
    if not 0 <= stage <= run.last:
        raise InputError(f"{run.scenario.id} has stages 0 to {run.last}, not {stage}.")
    if stage > run.next:
        raise InputError(f"Stage {run.next} of {run} comes next, not {stage}.")
    return stage < run.next


def score(
    scenario: str,
    policy: ChunkPolicy,
    *,
    stage: int,
    method: str,
    seed: int = 0,
    executed: int | None = None,
    data: str | None = None,
    steps: int | None = None,
    records: Path | str = RECORDS,
    progress: ProgressCallback = no_progress,
) -> Record:
    """Evaluate a policy at the end of a stage, and write the record after the last stage.

    Until then the record is kept in the cache: an interrupted program loses only the stage that was running.

    Args:
        scenario: Gymnasium id of the scenario.
        policy: Function from the observations of 40 episodes to chunks of actions, see `play_chunks`. It
            should not draw at random, except from the seeds that it observes.
        stage: Stage after whose fine-tuning the policy is evaluated; 0 is before the first target.
        method: Name of the row on the leaderboard, for example "me/lora".
        seed: Seed of the run; it chooses the initial states, the same for all methods.
        executed: Actions of a chunk that are executed before the policy acts again; all if None.
        data: What the policy was trained on in this stage, in words.
        steps: Optimiser steps of the stage.
        records: Folder of the records.
        progress: Called with the share of the stage's episodes that have ended since its last call.

    Returns:
        The record so far. Its scores come from test episodes: base no choice on them.

    Raises:
        InputError: Another stage comes next, a record exists already, `executed` is not that of stage 0, or
            the actions have the wrong shape.
    """
    run = StagedRun(load_scenario(scenario), method, seed, Path(records))
    settings = {} if executed is None else {"executed": executed}
    begin = time.perf_counter()
    record = run.begin(stage, settings, USES, policy)

    def play(trials: Sequence[Trial]) -> list[Episode]:
        return play_chunks(
            policy, run.scenario, trials, seed, executed, lambda count: progress(count / len(trials))
        )

    with seeded("external evaluation", seed, stage):
        run.report(record, stage, play)
    declared = {"data": data, "steps": steps}
    record.diagnostics[str(stage)] = {name: value for name, value in declared.items() if value is not None}
    run.time(record, None, time.perf_counter() - begin)
    run.keep(record, stage)
    return record
