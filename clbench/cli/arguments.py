"""Input of commands: limits that `--help` shows, and errors in one line with the nearest right name."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, get_args

from cyclopts import (
    App,
    ArgumentCollection,
    CoercionError,
    CycloptsError,
    Parameter,
    Token,
    UnknownCommandError,
    UnusedCliTokensError,
)
from cyclopts.validators import Number
from rich.console import Console
from rich.text import Text

from clbench.base.entry_points import unknown
from clbench.base.errors import ClbenchError, InputError
from clbench.base.text import printable
from clbench.spec.identifiers import check_known, installed_methods, scenario_ids
from clbench.spec.policies import policy_names
from clbench.spec.protocol import LARGEST_SEED, MOST_SEEDS


def whole_number(least: int, most: int | None = None) -> Parameter:
    """Return the annotation of a whole number from `least` to `most`; `--help` shows the lower limit."""
    return Parameter(
        converter=_whole_number,
        validator=Number(gte=least, lte=most),
        metavar=f"INT>={least}",
    )


def _whole_number(_: object, tokens: Sequence[Token]) -> int:
    """Return the number that a token spells; cyclopts would round 1.5, and Python reads 1_0 as 10."""
    text = tokens[0].value
    if not re.fullmatch(r"[+-]?\d{1,99}", text):
        raise ValueError(f"it must be a whole number, not {text!r}")
    return int(text)


Seed = Annotated[int, whole_number(0, LARGEST_SEED)]
"""Seed of a run, or the order of its targets, on the command line."""

Seeds = Annotated[int, whole_number(1, MOST_SEEDS)]
"""Number of seeds on the command line."""


# TAB completes names, which are looked up when it is pressed
ScenarioId = Annotated[str, Parameter(completer=lambda _: tuple(scenario_ids()))]
"""Gymnasium id of a scenario on the command line."""

MethodName = Annotated[str, Parameter(completer=lambda _: tuple(sorted(installed_methods())))]
"""Name of a method on the command line."""

PolicyName = Annotated[str, Parameter(completer=lambda _: tuple(policy_names()))]
"""Name of a policy on the command line."""

AsJson = Annotated[bool, Parameter(name="--json")]
"""Switch of a command that can print JSON instead of tables."""


def print_json(values: object) -> None:
    """Print a value as JSON for other programs; what is missing is null."""
    sys.stdout.write(f"{json.dumps(values, indent=1, allow_nan=False)}\n")


def items_of(option: str, text: str) -> list[str]:
    """Return the items of a list with commas outside brackets, each once and without the space around it.

    Args:
        option: Name of the option or argument.
        text: The list.

    Raises:
        InputError: An item is empty.
    """
    depth, items = 0, [""]
    for sign in text:
        depth += (sign == "[") - (sign == "]")
        if sign == "," and depth <= 0:
            items.append("")
        else:
            items[-1] += sign
    items = [item.strip() for item in items]
    if "" in items:
        raise InputError(f"{option} has an empty item: {text!r}. Separate items with single commas.")
    return list(dict.fromkeys(items))


def chosen_pictures(cameras: str | None, size: int | None) -> dict[str, Any]:
    """Return the arguments `pictures` and `picture_size` that --pictures and --picture-size stand for."""
    with checked_input():
        if cameras is None and size is not None:
            raise InputError("--picture-size needs --pictures: name the cameras there.")
        chosen = [] if cameras is None else items_of("--pictures", cameras)
    return {"pictures": chosen, **({} if size is None else {"picture_size": size})}


def chosen_methods(methods: Iterable[str], every: bool) -> list[str]:
    """Return the names of methods, each once.

    Args:
        methods: Names of methods.
        every: Whether all installed methods are meant, too.

    Raises:
        InputError: No method is named.
    """
    from clbench.learning.registry import method_names

    names = list(dict.fromkeys([*methods, *(method_names() if every else ())]))
    if not names:
        raise InputError("Name at least one method, or use --all; `clbench list` shows all methods.")
    return names


def check_names(scenarios: Iterable[str], methods: Iterable[str]) -> None:
    """End with exit code 2 if a name is not known, before anything heavy is imported."""
    with checked_input():
        check_known(scenarios, methods)


def error_line(message: object) -> Text:
    """Return an error message as one line, with the spaces of the names in it."""
    lines = (line.strip() for line in str(message).splitlines())
    return Text(f"error: {printable(' '.join(filter(None, lines)))}", style="bold red")


def read_paths(_: App, __: Sequence[str], arguments: ArgumentCollection) -> None:
    """Refuse empty paths, and replace ~ at the beginning of each: no shell does so in --records=~/x.

    An empty path, for example of a variable that is not set, would stand for the working directory.
    """
    for argument in arguments:
        if Path in (argument.hint, *get_args(argument.hint)):
            if any(not token.value for token in argument.tokens):
                raise CycloptsError(f"{argument.name} must not be empty.")
            argument.tokens[:] = [
                token.evolve(value=os.path.expanduser(token.value)) for token in argument.tokens
            ]


def parsing_error(error: CycloptsError) -> Text:
    """Return an error in the arguments as one line."""
    if isinstance(error, UnknownCommandError) and error.app is not None and error.unused_tokens:
        # the message of cyclopts imports every command
        commands = [name for name in error.app if not name.startswith("-")]
        return error_line(unknown("command", error.unused_tokens[0], commands))
    if isinstance(error, UnusedCliTokensError) and error.unused_tokens and error.command_chain:
        command, words = " ".join(error.command_chain), " ".join(error.unused_tokens)
        return error_line(f"{command} does not take {words!r}: see clbench {command} --help.")
    token = error.token if isinstance(error, CoercionError) else None
    if token is not None and token.keyword in BY_NAME:
        name, _, value = token.value.partition("=")
        example = f"{token.keyword}.{name if name.isidentifier() else 'NAME'} {value or 'VALUE'}"
        return error_line(f"The name is part of the option: write {example}")
    return error_line(error)


BY_NAME = ("--set", "--values")
"""Options that have a value for each hyper-parameter."""


@contextmanager
def checked_input() -> Iterator[None]:
    """End with exit code 2 and one line if the input is wrong; a bug inside shows its traceback."""
    try:
        yield
    except ClbenchError as error:
        Console(stderr=True, soft_wrap=True).print(
            error_line(error.args[0] if error.args else type(error).__name__)
        )
        sys.exit(2)


@contextmanager
def checked_writing(path: Path) -> Iterator[None]:
    """Refuse a path with an `InputError` if the file system does, for example because the disk is full."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror or error}.") from error


def check_cwd() -> None:
    """Exit if the working directory was deleted: importing PyTorch would end the process without a reason."""
    with checked_input():
        try:
            os.getcwd()
        except FileNotFoundError:
            raise InputError("The working directory no longer exists: change to another one.") from None


def add_cwd_to_path() -> None:
    """Let module:Class name a module in the working directory: a console script does not look there."""
    sys.path.insert(0, os.getcwd())
