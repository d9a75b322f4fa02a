"""Score a policy that was fine-tuned elsewhere: stage by stage, on the test episodes of every run.

Its record has the division `external`: the authors declare how the policy was trained; clbench cannot know.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from clbench.base.errors import InputError, WrongTypeError
from clbench.base.progress import ProgressCallback, no_progress
from clbench.base.seeding import seeded
from clbench.base.text import printable
from clbench.evaluation.players import ChunkPlay, ChunkPolicy, play_chunks
from clbench.evaluation.views import SIZE, SimulatorCameras
from clbench.records.paths import RECORDS
from clbench.records.reader import RecordError, read_record
from clbench.records.record import EXTERNAL_USES, Record
from clbench.records.writer import check_diagnostics
from clbench.runs.agents import UNFINISHED, StagedRun
from clbench.spec.fields import is_whole, whole_number
from clbench.spec.registry import load_scenario

LOG = logging.getLogger("clbench")

MOST_METADATA = 20
"""Most entries of a server's metadata that a record keeps."""

LONGEST_METADATA = 200
"""Length limit of a name or text in the kept metadata, in characters."""


def is_scored(
    scenario: str,
    *,
    stage: int,
    method: str,
    seed: int = 0,
    executed: int | None = None,
    data: str | None = None,
    steps: int | None = None,
    pictures: Sequence[str] = (),
    picture_size: int = SIZE,
    restart: bool = False,
    records: Path | str = RECORDS,
) -> bool:
    """Return whether a stage has been scored already; the arguments are those of `score`.

    Raises:
        InputError: An earlier stage comes first, there is no such stage, the stage was scored with other
            `executed`, `data`, `steps` or `pictures`, or `score` would refuse it for another reason.
        RecordError: The record of the earlier stages cannot be read.
    """
    run = StagedRun(load_scenario(scenario), method, seed, Path(records), EXTERNAL_USES)
    if restart:
        run.check_unfinished()
    record = run.record_before(stage, restart)
    if restart or record is None or stage == run.next_after(record):
        return False
    kept = {**record.run.settings, **record.diagnostics.get(str(stage), {})}
    cameras = SimulatorCameras(pictures, picture_size)
    settings = {"executed": executed, "data": data, "steps": steps, **cameras.settings}
    for name, value in settings.items():
        if value is not None and kept.get(name) != value:
            hint = (
                "The record is finished and is never edited"
                if run.path.exists()
                else "Score it again with --restart, which also drops all later stages, or omit the option"
            )
            raise InputError(
                f"Stage {stage} of {run} was scored with {name} {kept.get(name)!r}, not {value!r}. {hint}."
            )
    return True


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
    pictures: Sequence[str] = (),
    picture_size: int = SIZE,
    restart: bool = False,
    records: Path | str = RECORDS,
    progress: ProgressCallback = no_progress,
) -> Record:
    """Evaluate a policy at the end of a stage, and write the record after the last stage.

    Until then the record lies beside its final place, in a file whose name ends with `.json.unfinished`: an
    interrupted program loses only the stage that was running.

    Args:
        scenario: Gymnasium id of the scenario.
        policy: Function from the observations of 40 episodes to chunks of actions, see `play_chunks`. It
            should not draw at random, except from the seeds that it observes. The record keeps the texts and
            numbers of its attribute `metadata`, which a `ServedPolicy` has from its server.
        stage: Stage after whose fine-tuning the policy is evaluated; 0 is before the first target.
        method: Name of the row on the leaderboard, for example "me/lora".
        seed: Seed of the run; it chooses the initial states, the same for all methods. From 100 on,
            validation episodes are played.
        executed: Actions of a chunk that are executed before the policy acts again, the same number in all
            stages. None executes all of them: chunks must then have one length in all stages.
        data: What the policy was trained on in this stage, in words.
        steps: Optimiser steps of the stage.
        pictures: Cameras of the simulator whose pictures the policy gets, the same in all stages.
        picture_size: Height and width of these pictures in pixels.
        restart: Score the stage again if it was scored: its old scores and those of later stages are dropped.
        records: Folder of the records.
        progress: Called with the share of the stage's episodes that have ended since its last call.

    Returns:
        The record so far. Base no choice on test episodes; choose with a seed from 100 on.

    Raises:
        InputError: Another stage comes next, a record exists already, `executed` differs from stage 0, the
            earlier stages had another version of the scenario or its simulator, or other pictures, the
            actions have the wrong shape, a name or number is invalid, or a record cannot hold `data` or
            `steps`.
        RecordError: The record of the earlier stages cannot be read.
        LeaseLostError: Another program took over the run, or the file of its lease was removed.
        UnknownNameError: A scene has no such camera.
        RenderingError: This machine cannot draw the pictures.
        WrongTypeError: `data` is not a text.
    """
    executed = None if executed is None else whole_number("executed", executed, 1)
    steps = None if steps is None else whole_number("steps", steps, 0)
    stage = int(stage) if is_whole(stage) else stage  # of NumPy, which JSON cannot hold
    if data is not None and not isinstance(data, str):
        raise WrongTypeError(f"data must be a string, not {data!r}.")
    check_diagnostics({"data": data, "steps": steps})  # now, and not after hours of episodes
    run = StagedRun(load_scenario(scenario), method, seed, Path(records), EXTERNAL_USES)
    begin = time.perf_counter()
    cameras = SimulatorCameras(pictures, picture_size)
    record = run.begin(stage, _settings(run, stage, restart, executed, cameras), policy, restart)
    server = _kept_metadata(getattr(policy, "metadata", {}))
    if server:
        _warn_if_known(server, record, run, stage)
    trials = run.trials(stage)
    with seeded("external evaluation", seed, stage), contextlib.closing(cameras):
        played = play_chunks(
            policy,
            run.scenario,
            trials,
            seed,
            record.run.settings.get("executed"),
            whole=executed is None,
            progress=lambda count: progress(count / len(trials)),
            cameras=cameras if cameras.names else None,
        )
    _warn(stage, played)
    run.report(record, stage, played.episodes)
    _warn_if_unchanged(record, stage)
    record.run.settings = {"executed": played.executed, **cameras.settings}
    declared = {"data": data, "steps": steps, "server": server or None}
    record.diagnostics[str(stage)] = {
        **{name: value for name, value in declared.items() if value is not None},
        "not_finite_actions": round(played.not_finite, 6),
        "clipped_actions": round(played.clipped, 6),
    }
    run.time(record, None, time.perf_counter() - begin)
    run.keep(record, stage)
    return record


def _settings(
    run: StagedRun, stage: int, restart: bool, executed: int | None, cameras: SimulatorCameras
) -> dict[str, Any] | None:
    """Return the settings of a stage: pictures come from this call, `executed` may come from stage 0."""
    before = run.record_before(stage, restart) if stage else None
    known = before.run.settings.get("executed") if before else None
    chosen = {"executed": known if executed is None else executed, **cameras.settings}
    return {name: value for name, value in chosen.items() if value is not None} or None


def _warn_if_known(server: Mapping[str, Any], record: Record, run: StagedRun, stage: int) -> None:
    """Warn if a server sends the same metadata as in the stage before, or as with another seed."""
    if server == record.diagnostics.get(str(stage - 1), {}).get("server"):
        LOG.warning(
            "The server sends the same metadata as in stage %d (%s): does it serve the new checkpoint?",
            stage - 1,
            described(server),
        )
    same = _seeds_of(server, run, stage) if stage else []
    if same:
        LOG.warning(
            "The server sends the same metadata as with seed %s in this stage (%s): fine-tune once for "
            "each seed. Seeds of one checkpoint differ only in their initial states.",
            ", ".join(map(str, same)),
            described(server),
        )


def _warn_if_unchanged(record: Record, stage: int) -> None:
    """Warn if all episodes ended as in the stage before: an unchanged policy repeats itself exactly."""
    names = ("stage", "task", "split", "episode", "success", "length")
    outcomes: dict[int, dict[tuple[Any, ...], tuple[Any, ...]]] = {}
    for one, *place, success, length in zip(*(record.episodes[name] for name in names), strict=True):
        outcomes.setdefault(one, {})[tuple(place)] = success, length
    before, now = outcomes.get(stage - 1, {}), outcomes.get(stage, {})
    shared = before.keys() & now.keys()
    succeeded = any(now[place][0] for place in shared)  # all failures have the same length
    if succeeded and all(before[place] == now[place] for place in shared):
        LOG.warning(
            "All %d episodes ended as in stage %d, after as many steps: does the policy have the new "
            "checkpoint?",
            len(shared),
            stage - 1,
        )


def _seeds_of(server: Mapping[str, Any], run: StagedRun, stage: int) -> list[int]:
    """Return the other seeds of a row whose server sent the same metadata in a stage."""
    found = set()
    for path in (*run.path.parent.glob("seed-*.json"), *run.path.parent.glob(f"seed-*.json{UNFINISHED}")):
        with contextlib.suppress(RecordError):  # the board names a damaged one
            record = read_record(path)
            if record.diagnostics.get(str(stage), {}).get("server") == server:
                found.add(record.run.seed)
    return sorted(found - {run.seed})


def described(server: Mapping[str, Any]) -> str:
    """Return, in one line, the metadata that a record keeps."""
    return ", ".join(f"{name} {value}" for name, value in server.items())


def _kept_metadata(metadata: object) -> dict[str, Any]:
    """Return the metadata that a record keeps: texts and finite numbers, without control characters."""
    plain: dict[str, Any] = {}
    for name, value in metadata.items() if isinstance(metadata, Mapping) else ():
        found = value.item() if isinstance(value, np.generic) else value
        if isinstance(found, str):
            found = printable(found)[:LONGEST_METADATA]
        elif not isinstance(found, int | float) or not abs(found) < 2**63:  # nor is NaN
            continue
        plain[printable(str(name))[:LONGEST_METADATA]] = found
    return dict(list(plain.items())[:MOST_METADATA])


def _warn(stage: int, played: ChunkPlay) -> None:
    """Warn of actions that were replaced: they are most often a fault of the program, not of the policy."""
    found = [
        f"{100 * share:.3g} % of the steps had an action {what}"
        for share, what in (
            (
                played.not_finite,
                "with NaN or infinite numbers, which were replaced by 0 or the nearest bound",
            ),
            (played.clipped, "outside of the action space, which was clipped to its bounds"),
        )
        if share
    ]
    if found:
        LOG.warning("Stage %d: %s.", stage, "; ".join(found))
