"""The commands that make records, as pages and the terminal show them."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path

from clbench.base.text import printable
from clbench.records.paths import RECORDS, table_parts
from clbench.spec.policies import DEFAULT_POLICY

from .frontier import FACTOR
from .paths import CONTROLS, LADDER, sibling
from .runs import Run


def run_command(scenario: str, *labels: str, records: Path = RECORDS, controls: Path = CONTROLS) -> str:
    """Return the command that makes the records of `labels`, which all have the same changed settings.

    Args:
        scenario: Scenario as it was typed, with its module if it has one.
        labels: Methods with their settings. A label such as "sft@0.3" is a run of the ladder.
        records: Folder of the records of the board; the ladder is beside it.
        controls: Folder of the other records with changed settings.
    """
    names = [label.partition("@")[0] for label in labels]
    methods = [name.partition("+")[0] for name in names]
    changes = [tuple(change.split("=", 1)) for change in names[0].split("+")[1:]]
    factor = labels[0].partition("@")[2]
    changes += [(FACTOR, factor)] if factor else []
    settings = [f"--set.{name} {value}" for name, value in changes]
    folder = (sibling(records, LADDER.name) if factor else controls) if changes else records
    option = [] if folder == RECORDS else [f"--records {shlex.quote(folder.as_posix())}"]
    return " ".join(["clbench run", scenario, *methods, *settings, *option])


def commands_of(runs: Iterable[Run]) -> list[str]:
    """Return the commands that make the records of one row's runs again, quoted for the shell.

    The quoting matters because a stranger may have written the records.
    """
    lines = []
    for (device, perturb), members in groupby(runs, key=_how):
        same = list(members)
        scenario, policy = table_parts(same[0].table)
        for first, count in _in_a_row([run.seed for run in same]):
            words = ["clbench", "run", scenario, same[0].label, "--seeds", str(count)]
            words += [] if policy == DEFAULT_POLICY else ["--policy", policy]
            words += ["--first-seed", str(first)] if first else []
            words += [] if device == "cpu" else ["--device", printable(device)]
            words += ["--perturb"] if perturb else []
            lines.append(shlex.join(words))
    return lines


def _how(run: Run) -> tuple[str, bool]:
    """Return the device of a run, and whether it has perturbed episodes."""
    return run.record.run.device, run.record.run.perturb


def _in_a_row(seeds: Iterable[int]) -> list[tuple[int, int]]:
    """Return rising seeds as ranges: first seed and number of consecutive seeds."""
    found: list[tuple[int, int]] = []
    for seed in seeds:
        if found and sum(found[-1]) == seed:
            found[-1] = (found[-1][0], found[-1][1] + 1)
        else:
            found.append((seed, 1))
    return found
