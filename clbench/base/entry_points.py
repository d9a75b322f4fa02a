"""Entry points: objects that are found by a name of the form "module:attribute"."""

from __future__ import annotations

import importlib
import os
import pkgutil
import sys
from collections.abc import Iterable
from typing import Any

from clbench.base.errors import ClbenchError, InputError, UnknownNameError
from clbench.base.text import did_you_mean


def is_entry_point(text: str) -> bool:
    """Return whether a text has the form "module:attribute"."""
    module, _, attribute = text.partition(":")
    return attribute.isidentifier() and is_module(module)


def is_module(text: str) -> bool:
    """Return whether a text has the form of a module's name."""
    return all(map(str.isidentifier, text.split(".")))


def resolve(name: str) -> Any:
    """Return the object at the entry point `name`, "module:attribute".

    Raises:
        UnknownNameError: There is no such module, or it has no such attribute; the nearest one is named.
    """
    module, _, attribute = name.partition(":")
    found = import_module(module, name)
    if not hasattr(found, attribute):
        hint = did_you_mean(attribute, dir(found))
        raise UnknownNameError(f"No entry point {name!r}: module {module!r} has no {attribute!r}.{hint}")
    return getattr(found, attribute)


def import_module(module: str, needed_for: str) -> Any:
    """Import a module and return it.

    Args:
        module: Name of the module.
        needed_for: Name of what needs the module, for the message.

    Raises:
        UnknownNameError: The module, or a module that it imports, does not exist.
        InputError: A module that is not part of clbench raises an error or exits while it is imported.
    """
    near = _as_module(module)
    hint = f" Did you mean {near + needed_for.removeprefix(module)!r}?" if near != module else ""
    if not is_module(module):
        raise UnknownNameError(f"No module {module!r} can be imported for {needed_for!r}.{hint}")
    try:
        return importlib.import_module(module)
    except ClbenchError:
        raise
    except ModuleNotFoundError as error:
        if error.name is None:  # raised by hand, with a text of its own
            raise InputError(_cannot_import(module, needed_for, error)) from error
        if not hint and error.name == module.partition(".")[0]:  # else a module that it imports is missing
            hint = _hint_of_folder(error.name)
        raise UnknownNameError(
            f"No module {error.name!r} can be imported for {needed_for!r}.{hint}"
        ) from error
    except (Exception, SystemExit) as error:  # a script without `if __name__ == "__main__"` may exit
        if module.partition(".")[0] == "clbench":  # a bug of ours shows its traceback
            raise
        raise InputError(_cannot_import(module, needed_for, error)) from error


def _cannot_import(module: str, needed_for: str, error: BaseException) -> str:
    what = f"{type(error).__name__}: {error}"
    return f"The module {module!r} cannot be imported for {needed_for!r}: {what}"


def _as_module(path: str) -> str:
    """Return the name of the module in a file; the name of a module stays as it is."""
    return path.removeprefix("./").removesuffix(".py").replace("/", ".")


def _hint_of_folder(name: str) -> str:
    """Return the end of a message: the nearest module in the working directory, or that there is none."""
    folder = os.getcwd()
    if not {"", folder} & set(sys.path):  # such as in a script of another folder
        return ""
    near = did_you_mean(name, (one.name for one in pkgutil.iter_modules([folder])))
    return near or f" No installed package has this name, and no file in {folder}."


def class_hint(name: str) -> str:
    """Return the end of a message about a file, a module or a dotted name in place of "module:Class"."""
    stem = _as_module(name)
    module, _, attribute = stem.rpartition(".")
    if not is_module(stem):
        return ""
    if name.endswith(".py"):
        return f" Did you mean a class of this file, as {f'{stem}:Class'!r}?"
    if module and attribute[0].isupper():
        return f" Did you mean {f'{module}:{attribute}'!r}?"
    if module or stem in (one.name for one in pkgutil.iter_modules([os.getcwd(), *sys.path])):
        return f" Did you mean a class of this module, as {f'{stem}:Class'!r}?"
    return ""


def unknown(kind: str, name: str, known: Iterable[str], hint: str | None = None) -> UnknownNameError:
    """Return the error for a name that is not `known`, with a hint.

    Args:
        kind: Kind of thing that is named, such as "task".
        name: Unknown name.
        known: Known names.
        hint: What was probably meant, as sentences after a space; None names the nearest known name.
    """
    known = sorted(known)
    hint = did_you_mean(name, known) if hint is None else hint
    return UnknownNameError(f"No {kind} is called {name!r}.{hint} Known: {', '.join(known)}.")
