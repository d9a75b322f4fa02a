"""Records as tables of pandas, for analyses of one's own."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from clbench.records.paths import RECORDS, label_of
from clbench.records.reader import RecordError, read_record
from clbench.records.record import Record

if TYPE_CHECKING:
    import pandas

LOG = logging.getLogger("clbench")

COLUMNS = (
    "scenario",
    "method",
    "seed",
    "order",
    "stage",
    "step",
    "task",
    "group",
    "split",
    "episode",
    "success",
    "length",
)
"""Columns of `frame` and `load_records`."""


def load_records(folder: Path | str = RECORDS) -> pandas.DataFrame:
    """Return all evaluation episodes of the records below a folder, one row for each episode.

    Columns: `scenario` (Gymnasium id), `method` (with changed settings, as "lora+rank=4"), `seed`, `order`,
    `stage` (0 is before the first target), `step` (optimiser steps done in the stage), `task`, `group`
    ("retained", "target" or "held_out"), `split` ("test", "validation" or "perturbed"), `episode`, `success`
    (a boolean) and `length` (steps). Records of failed runs, and files that are no records, are left out; the
    log names them.

    Args:
        folder: Folder of records, at any depth.

    Raises:
        FileNotFoundError: There is no such folder.
    """
    import pandas

    if not Path(folder).is_dir():
        raise FileNotFoundError(f"There is no folder of records at {folder}.")
    frames = []
    for path in sorted(Path(folder).rglob("*.json")):
        try:
            record = read_record(path)
        except RecordError as error:
            LOG.warning("%s", error)
            continue
        if record.status == "success":
            frames.append(frame(record))
        else:
            LOG.warning("%s: the run failed.", path)
    return pandas.concat(frames, ignore_index=True) if frames else _typed(pandas.DataFrame(columns=COLUMNS))


def frame(record: Record) -> pandas.DataFrame:
    """Return the evaluation episodes of a record, with the columns of `load_records`."""
    import pandas

    episodes, run, scenario = record.episodes, record.run, record.scenario
    groups = {
        task: group for group in ("retained", "target", "held_out") for task in getattr(scenario, group)
    }
    found = pandas.DataFrame(
        {
            "scenario": run.scenario,
            "method": label_of(run.method, run.changes),
            "seed": run.seed,
            "order": run.order,
            **{name: episodes[name] for name in ("stage", "step", "task")},
            "group": [groups.get(task) for task in episodes["task"]],
            **{name: episodes[name] for name in ("split", "episode", "success", "length")},
        }
    )
    return _typed(found)


def matrix(record: Record) -> pandas.DataFrame:
    """Return the success rates at the ends of stages: a row for each stage, a column for each task.

    The first row is "pretrained", before any target; the others have the names of the targets in the order in
    which the run learned them. Columns have two levels, the group and the task. Only the scored split counts:
    test episodes or, in a tuning run, validation episodes.
    """
    import pandas

    found = frame(record)
    found = found[found.split == record.run.split]
    ends = found.groupby("stage").step.transform("max")
    rates = found[found.step == ends].groupby(["stage", "task"]).success.mean().unstack("task")
    columns = [
        (group, task)
        for group in ("retained", "target", "held_out")
        for task in getattr(record.scenario, group)
    ]
    rates = rates.reindex(columns=[task for _, task in columns])
    rates.columns = pandas.MultiIndex.from_tuples(columns, names=("group", "task"))
    names = ["pretrained", *record.scenario.target]
    rates.index = pandas.Index([names[int(stage)] for stage in rates.index], name="after")
    return rates


def _typed(found: pandas.DataFrame) -> pandas.DataFrame:
    """Return a table whose columns have their types, also if it has no rows."""
    numbers = dict.fromkeys(("seed", "order", "stage", "step", "episode", "length"), "int64")
    texts = dict.fromkeys(("scenario", "method", "task", "group", "split"), "str")
    return found.astype({**numbers, **texts, "success": "bool"})[list(COLUMNS)]
