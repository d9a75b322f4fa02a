"""Names that strangers choose: their form, and a check that none can be mistaken for one of ours.

A name becomes a folder and a cell of a table. It has ASCII letters, digits and underscores, and single dashes
and dots between them where these are allowed. It therefore cannot leave its folder, hide in a listing, or use
the letters of another alphabet.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from importlib.metadata import EntryPoint, entry_points

from clbench.base.entry_points import class_hint, unknown
from clbench.base.errors import InputError, UnknownNameError, WrongTypeError
from clbench.base.text import did_you_mean, quoted
from clbench.spec.fields import LONGEST
from clbench.spec.policies import policy_names

LONGEST_LABEL = 200
"""Length limit of a method's name with its changed settings, in characters; file systems allow 255."""

_IDENTIFIER = r"[A-Za-z_]\w*"
_WORD = r"[A-Za-z0-9]\w*(?:[.-]\w+)*"
_SCENARIO = re.compile(rf"[A-Za-z]\w*(?:-\w+)*/{_WORD}-v(?:0|[1-9]\d{{0,3}})", re.ASCII)
_METHOD = re.compile(
    rf"[A-Za-z]\w*(?:-\w+)*|{_WORD}/[A-Za-z]\w*(?:[.-]\w+)*|{_IDENTIFIER}(?:\.{_IDENTIFIER})*:{_IDENTIFIER}",
    re.ASCII,
)
_CHANGES = re.compile(rf"(?:\+{_IDENTIFIER}=[\w .,()\[\]'+-]*[\w)\]'])*", re.ASCII)
_PLAIN = re.compile(r"\w+(?:[.-]\w+)*", re.ASCII)

_RESERVED = {"con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(10))}
"""Names of devices on Windows, which are reserved whatever follows after a dot."""

_ALIKE = str.maketrans("01i", "oll")


def installed_methods() -> dict[str, EntryPoint]:
    """Return the entry points of installed methods by name; a method of another package is "package/name"."""
    found = {}
    for entry in entry_points(group="clbench.methods"):
        package = entry.dist.name if entry.dist is not None else "unknown"
        found[entry.name if package == "clbench" else f"{package}/{entry.name}"] = entry
    return found


@cache
def built_in_methods() -> dict[str, EntryPoint]:
    """Return the entry points of the methods that are part of clbench, by name; nothing is imported."""
    return {name: entry for name, entry in installed_methods().items() if "/" not in name}


def check_known(scenarios: Iterable[str], methods: Iterable[str]) -> None:
    """Refuse names that are not registered or installed; nothing is imported.

    Names with a module, "module:id" and "module:Class", pass: only an import can check them.

    Raises:
        UnknownNameError: Nothing has the name; the message names the nearest one.
    """
    for name in scenarios:
        if ":" not in name and name not in scenario_ids():
            if name in built_in_methods() or name in installed_methods():
                raise UnknownNameError(f"{name!r} is a method: the scenario comes first, then its methods.")
            raise unknown_scenario(name)
    for name in methods:
        if ":" not in name and name not in built_in_methods() and name not in installed_methods():
            raise unknown_method(name)


def unknown_scenario(name: str) -> UnknownNameError:
    """Return the error for an id, or "module:id", under which no scenario is registered."""
    module, _, name = name.rpartition(":")
    known = scenario_ids()
    hint = did_you_mean(name, known)
    if module:
        hint += f" The module {module!r} was imported, and does not register it."
    elif "/" in name and name.partition("/")[0] != "clbench":
        hint += f" If a module of yours registers it, name the module too, as {f'module:{name}'!r}."
    return unknown("scenario", name, known, hint)


def unknown_method(name: str) -> UnknownNameError:
    """Return the error for a name that no installed method has, with the nearest one."""
    installed = sorted(installed_methods())
    if name in policy_names():
        hint = f" It is a policy: give it as `--policy {name}`."
    else:
        hint = did_you_mean(name, installed) or class_hint(name)
    names = ", ".join(installed) or "none; run `pip install -e .` in the checkout"
    return UnknownNameError(f"No method is called {name!r}.{hint} Installed: {names}. Or give module:Class.")


def check_scenario_id(scenario: str) -> None:
    """Refuse a text that cannot be the id of a scenario.

    Raises:
        InputError: It does not have the form "namespace/Name-v0", or looks like another registered id.
    """
    if not isinstance(scenario, str):
        raise WrongTypeError(f"The id of a scenario is a string such as 'me/Mine-v0', not {scenario!r:.60}.")
    if len(scenario) > LONGEST or not _SCENARIO.fullmatch(scenario):
        raise InputError(
            f"{quoted(scenario)} cannot be the id of a scenario: it must be of the form namespace/Name-v0."
        )
    _check_reserved(scenario.rpartition("/")[2])
    _check_alike("scenario", scenario, scenario_ids())
    _check_not_ours("scenario", scenario, scenario.partition("/")[0])


def check_method_name(method: str) -> None:
    """Refuse a text that cannot be the name of a method.

    Raises:
        InputError: It is neither a name, "package/name" nor "module:Class", or looks like a built-in.
    """
    if len(method) > LONGEST or not _METHOD.fullmatch(method):
        raise InputError(
            f"{quoted(method)} cannot be the name of a method: it must be package/name or module:Class. "
            "A name begins with a letter, and has letters, digits and _ with single - or . between them."
        )
    _check_reserved(method)
    _check_alike("method", method, built_in_methods())
    package = re.split("[/.:]", method)[0]
    if package != method:
        _check_not_ours("method", method, package)
        if package == "clbench":
            raise InputError(
                f"Names of built-in methods have no package: write their name alone, not {quoted(method)}."
            )


def check_label(label: str) -> None:
    """Refuse a text that cannot be a method with its changed settings, such as "lora+rank=4".

    Raises:
        InputError: It has another form, is too long for the name of a folder, or its method is refused.
    """
    method, plus, changes = label.partition("+")
    check_method_name(method)
    if len(label) > LONGEST_LABEL or not _CHANGES.fullmatch(plus + changes):
        raise InputError(
            f"{quoted(label)} cannot be the name of a folder: settings may have letters, digits, spaces and "
            f".,()[]'+- only. The whole name may have at most {LONGEST_LABEL} characters."
        )


def check_plain(kind: str, name: str) -> None:
    """Refuse a name with other characters than letters, digits, _, - and dots.

    Args:
        kind: Kind of thing that `name` names, such as "task", for the message.
        name: Name to check.

    Raises:
        InputError: The name has other characters, or too many.
    """
    if len(name) > LONGEST or not _PLAIN.fullmatch(name):
        raise InputError(f"{quoted(name)} cannot be the name of a {kind}: letters, digits, _, - and . only.")


def without_module(scenario: str) -> str:
    """Return the Gymnasium id in a name of a scenario, which may be "module:id"."""
    return scenario.rpartition(":")[2]


def folder_name(name: str) -> str:
    """Return the name of a folder for a checked scenario id or label; no two share one."""
    return name.removeprefix("clbench/").replace("/", "--").replace(":", ".")


def _check_reserved(name: str) -> None:
    if re.split("[.:]", name)[0].casefold() in _RESERVED:
        raise InputError(
            f"Nothing can be called {quoted(name)}, the name of a device on Windows: choose another name."
        )


def _check_alike(kind: str, name: str, ours: Iterable[str]) -> None:
    """Refuse a name that is easily mistaken for one of `ours`."""
    for other in ours:
        if name != other and _folded(name) == _folded(other):
            raise InputError(
                f"The {kind} cannot be called {quoted(name)}, which readers would take for {other!r}: choose "
                "a name that differs in more than case and punctuation."
            )


def _check_not_ours(kind: str, name: str, package: str) -> None:
    if package != "clbench" and _folded(package) == "clbench":
        raise InputError(
            f"The {kind} cannot be called {quoted(name)}, which readers would take for a {kind} of clbench: "
            "put the name of your own package before it."
        )


def _folded(name: str) -> str:
    """Return a name without easily overlooked differences: case, punctuation, 0 for o, 1 and i for l."""
    return "".join(filter(str.isalnum, name.casefold())).translate(_ALIKE)


def scenario_ids() -> list[str]:
    """Return the Gymnasium ids of all registered scenarios, sorted."""
    import gymnasium

    return sorted(name for name, spec in gymnasium.registry.items() if "scenario" in (spec.kwargs or {}))
