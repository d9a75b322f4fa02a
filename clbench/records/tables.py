"""A record as pandas tables."""

from __future__ import annotations

from typing import TYPE_CHECKING, get_args

from clbench.records.paths import label_of
from clbench.spec.protocol import Point
from clbench.spec.scenario import Group

if TYPE_CHECKING:
    import pandas

    from clbench.records.record import Record

GROUPS = get_args(Group)

TYPES = {
    "scenario": "str",
    "policy": "str",
    "method": "str",
    "seed": "uint64",  # a seed may have 64 bits: int64 would turn the largest into negative numbers
    "order": "int64",
    "stage": "int64",
    "step": "int64",
    "task": "str",
    "group": "str",
    "split": "str",
    "episode": "int64",
    "success": "bool",
    "length": "int64",
}
"""Columns of `frame` and `load_records`, with their types."""


def frame(record: Record) -> pandas.DataFrame:
    """Return the evaluation episodes of a record, with the columns of `load_records`."""
    import pandas

    episodes, run, scenario = record.episodes, record.run, record.scenario
    groups = {task: group for group in GROUPS for task in getattr(scenario, group)}
    found = pandas.DataFrame(
        {
            "scenario": run.scenario,
            "policy": run.policy,
            "method": label_of(run.method, run.changes),
            "seed": run.seed,
            "order": run.order,
            "group": [groups.get(task) for task in episodes["task"]],
            **{name: episodes[name] for name in TYPES if name in episodes},
        }
    )
    return typed(found)


def matrix(record: Record) -> pandas.DataFrame:
    """Return the success rates at the ends of stages: a row for each stage, a column for each task.

    The first row is "pretrained", before any target; the others have the names of the targets in the order in
    which the run learned them. A stage that a failed run did not finish has no row. Columns have two levels,
    the group and the task. Only the scored split counts: test episodes or, in a tuning run, validation
    episodes.
    """
    import pandas

    found = frame(record)
    found = found[found.split == record.run.split]
    protocol = record.scenario.protocol(record.run.split)
    ends = [protocol.is_end(Point(*point)) for point in zip(found.stage, found.step, strict=True)]
    rates = found.loc[ends].groupby(["stage", "task"]).success.mean().unstack("task")
    columns = [(group, task) for group in GROUPS for task in getattr(record.scenario, group)]
    rates = rates.reindex(columns=[task for _, task in columns])
    rates.columns = pandas.MultiIndex.from_tuples(columns, names=("group", "task"))
    names = ["pretrained", *record.scenario.target]
    rates.index = pandas.Index([names[int(stage)] for stage in rates.index], name="after")
    return rates


def typed(found: pandas.DataFrame) -> pandas.DataFrame:
    """Return a table with its columns in order and with their types, even if it has no rows."""
    return found.astype(TYPES)[list(TYPES)]
