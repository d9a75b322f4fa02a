"""The commands that make missing records, as pages and the terminal name them."""

from __future__ import annotations

import shlex
from pathlib import Path

from clbench.records.paths import RECORDS

from .frontier import FACTOR
from .places import CONTROLS, LADDER
from .rows import Row


def run_command(scenario: str, *labels: str, records: Path = RECORDS) -> str:
    """Return the command that makes the records of `labels`, which all have the same changed settings.

    Args:
        scenario: Scenario as it was typed, with its module if it has one.
        labels: Methods with their settings. A label such as "sft@0.3" is a run of the ladder.
        records: Folder of the records of the board.
    """
    names = [label.partition("@")[0] for label in labels]
    methods = [name.partition("+")[0] for name in names]
    changes = [tuple(change.split("=", 1)) for change in names[0].split("+")[1:]]
    factor = labels[0].partition("@")[2]
    changes += [(FACTOR, factor)] if factor else []
    settings = [f"--set.{name} {value}" for name, value in changes]
    folder = (LADDER if factor else CONTROLS) if changes else records
    option = [] if folder == RECORDS else [f"--records {shlex.quote(folder.as_posix())}"]
    return " ".join(["clbench run", scenario, *methods, *settings, *option])


def row_command(row: Row) -> str:
    """Return the command that makes the records of a row with the usual policy."""
    first, last = row.seeds[0], row.seeds[-1]
    words = [run_command(row.scenario, row.method), f"--seeds {last - first + 1}"]
    words += [f"--first-seed {first}"] if first else []
    words += ["--perturb"] if any(run.record.run.perturb for run in row.runs) else []
    return " ".join(words)
