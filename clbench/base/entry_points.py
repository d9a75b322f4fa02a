"""Entry points: objects by their names "module:attribute"."""

from __future__ import annotations

import importlib
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
    """Return a module.

    Args:
        module: Name of the module.
        needed_for: Name of the thing that needs it, for the message.

    Raises:
        UnknownNameError: The module, or a module that it imports, does not exist.
        InputError: A module that is not part of clbench raises an error or exits while it is imported.
    """
    near = module.removeprefix("./").removesuffix(".py").replace("/", ".")
    hint = f" Did you mean {near + needed_for.removeprefix(module)!r}?" if near != module else ""
    if not is_module(module):
        raise UnknownNameError(f"No module {module!r} can be imported for {needed_for!r}.{hint}")
    try:
        return importlib.import_module(module)
    except ClbenchError:
        raise
    except ModuleNotFoundError as error:
        raise UnknownNameError(
            f"No module {error.name!r} can be imported for {needed_for!r}.{hint}"
        ) from error
    except (Exception, SystemExit) as error:  # a script without `if __name__ == "__main__"` may exit
        if module.partition(".")[0] == "clbench":  # a bug of ours shows its traceback
            raise
        what = f"{type(error).__name__}: {error}"
        raise InputError(f"The module {module!r} cannot be imported for {needed_for!r}: {what}") from error


def unknown(kind: str, name: str, known: Iterable[str]) -> UnknownNameError:
    """Return the error for a name that is not `known`, with the nearest known name.

    Args:
        kind: Kind of thing that is named, such as "task".
        name: Unknown name.
        known: Known names.
    """
    known = sorted(known)
    hint = did_you_mean(name, known)
    return UnknownNameError(f"No {kind} is called {name!r}.{hint} Known: {', '.join(known)}.")
