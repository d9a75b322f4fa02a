"""The commands that pages give to make missing records."""

from __future__ import annotations

from ..board.frontier import FACTOR
from ..board.places import CONTROLS, LADDER


def run_command(scenario: str, *labels: str) -> str:
    """Return the command that makes the records of `labels`, which all have the same changed settings.

    A label such as "sft@0.3" belongs to the ladder of step sizes.
    """
    names = [label.partition("@")[0] for label in labels]
    methods = [name.partition("+")[0] for name in names]
    changes = [tuple(change.split("=", 1)) for change in names[0].split("+")[1:]]
    factor = labels[0].partition("@")[2]
    changes += [(FACTOR, factor)] if factor else []
    settings = [f"--set.{name} {value}" for name, value in changes]
    folder = [f"--records {(LADDER if factor else CONTROLS).as_posix()}"] if changes else []
    return " ".join(["clbench run", scenario, *methods, *settings, *folder])
