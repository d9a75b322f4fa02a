"""What releases promise to keep, as lines: names in Python, commands, scenarios, methods and metrics.

To add a promise, write the lines again: `python tests/shared/promised.py > tests/promised.txt`.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any

from cyclopts import App

import clbench
import clbench.testing
from clbench.cli.main import COMMANDS, app
from clbench.scoring.metrics import METRICS

# docs/guide/versions.md: these may change.
NOT_PROMISED = {*COMMANDS["Pages"], "experts", "metrics --markdown"}

PROMISED: dict[str, tuple[ModuleType, list[str]]] = {
    "clbench": (clbench, clbench.__all__),
    "clbench.metrics": (clbench.metrics, clbench.metrics.__all__),
    "clbench.plot": (clbench.plot, clbench.plot.__all__),
    "clbench.testing": (clbench.testing, [name for name in dir(clbench.testing) if "check" in name]),
}


def promises() -> list[str]:
    """Return every promise, in alphabetical order."""
    return sorted({*_names(), *_commands(app, "clbench"), *_scenarios(), *_methods(), *_metrics()})


def _scenarios() -> Iterator[str]:
    yield from (f"scenario {name}" for name in clbench.scenario_ids() if not name.endswith("-v0"))


def _methods() -> Iterator[str]:
    for name in clbench.method_names():
        yield f"method {name}{_parameters(clbench.load_method(name))}"


def _metrics() -> Iterator[str]:
    yield from (f"metric {name}, version {metric.version}" for name, metric in METRICS.items())


def _names() -> Iterator[str]:
    for prefix, (module, names) in PROMISED.items():
        for name in names:
            value = getattr(module, name)
            if not inspect.ismodule(value):
                yield from _value(f"{prefix}.{name}", value)


def _value(name: str, value: Any) -> Iterator[str]:
    yield name + _parameters(value)
    if isinstance(value, type):
        own = [base for base in value.__mro__ if base.__module__.split(".")[0] == "clbench"]
        for member in {member for base in own for member in vars(base) if not member.startswith("_")}:
            yield f"{name}.{member}{_parameters(getattr(value, member))}"


def _parameters(value: Any) -> str:
    """Return the parameters without their types and defaults: "" of what cannot be called."""
    if not callable(value) or (isinstance(value, type) and issubclass(value, BaseException)):
        return ""
    signature = inspect.signature(value)
    shown = [
        one.replace(
            annotation=inspect.Parameter.empty,
            default=one.default if one.default is inspect.Parameter.empty else ...,
        )
        for one in signature.parameters.values()
    ]
    return str(signature.replace(parameters=shown, return_annotation=inspect.Signature.empty)).replace(
        "Ellipsis", "..."
    )


def _commands(parent: App, prefix: str) -> Iterator[str]:
    for name, command in parent.resolved_commands().items():
        if name.startswith("-") or name in NOT_PROMISED:
            continue
        yield f"{prefix} {name}"
        for argument in command.assemble_argument_collection(default_parameter=app.default_parameter):
            words = (f"{name} {word}" for word in argument.names)
            yield from (f"{prefix} {word}" for word in words if word not in NOT_PROMISED)
        yield from _commands(command, f"{prefix} {name}")


if __name__ == "__main__":
    sys.stdout.writelines(f"{line}\n" for line in promises())
