"""The command line: the names of all commands."""

from __future__ import annotations

import ast
import logging
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import App, Group, Parameter
from rich.console import Console
from rich.logging import RichHandler

import clbench
from clbench.base.text import printable_lines
from clbench.cli.arguments import check_cwd, parsing_error, read_paths
from clbench.cli.data import DEMONSTRATIONS
from clbench.cli.data import demonstrations as collect

if TYPE_CHECKING:
    from cyclopts.help import HelpPanel
    from cyclopts.help.protocols import HelpFormatter
    from rich.console import ConsoleOptions

# Named, not imported: a command imports what it needs, and the core knows its parts by name alone.
COMMANDS = {
    "Measure": {
        "list": "clbench.cli.catalogue:list_",
        "run": "clbench.cli.runs:run",
        "score": "clbench.cli.runs:score",
        "status": "clbench.cli.status:status",
        "leaderboard": "clbench.leaderboard.cli:show",
        "metrics": "clbench.cli.catalogue:metrics",
        "film": "clbench.cli.film:film",
    },
    "Add a method or a policy": {
        "new-method": "clbench.cli.scaffold:new_method",
        "new-policy": "clbench.cli.scaffold:new_policy",
        "submit": "clbench.leaderboard.cli:submit",
        "tune": "clbench.cli.tune:tune",
        "verify": "clbench.leaderboard.cli:verify",
    },
    "Inputs and machine": {
        "doctor": "clbench.cli.catalogue:doctor",
        "pretrain": "clbench.cli.data:pretrain",
        "cache": "clbench.cli.cache:cache",
    },
    "Pages": {
        "claims": "clbench.leaderboard.pages.cli:claims",
        "findings": "clbench.leaderboard.pages.cli:findings",
        "method-pages": "clbench.leaderboard.pages.cli:method_pages",
        "scenario-card": "clbench.leaderboard.pages.cli:scenario_card",
    },
}
"""Entry points of the commands, in the groups of `clbench --help`."""

USAGES = {
    "run": "SCENARIOS [METHODS...]",
    "status": "[SCENARIOS] [METHODS...]",
    "leaderboard": "[SCENARIO]",
    "score": "SCENARIO",
    "metrics": "[NAME|FILE]",
    "film": "SCENARIO METHODS...",
    "tune": "SCENARIO [METHODS...]",
    "verify": "PATHS...",
    "scenario-card": "[SCENARIOS...]",
    "demonstrations export": "SCENARIO [TASKS...]",
    "experts measure": "SCENARIO [TASKS...]",
}
"""Arguments in the first line of a command's help, where Cyclopts would show [ARGS...]."""

EXPERTS = {
    "measure": "clbench.cli.data:measure",
    "train": "clbench.envs.dm_control.expert_training.cli:train",
}
"""Entry points of the commands of `clbench experts`."""


def main() -> None:
    """Run the command line."""
    handler = RichHandler(console=Console(stderr=True), show_time=False, show_path=False)
    handler.addFilter(_made_printable)
    logging.basicConfig(level=logging.WARNING, format="%(message)s", handlers=[handler])
    check_cwd()
    app()


def _made_printable(record: logging.LogRecord) -> bool:
    """Rid a message of characters that control the terminal: it may quote a stranger's text."""
    record.msg, record.args = printable_lines(record.getMessage()), ()
    return True


def _summaries(entry_points: dict[str, str]) -> HelpFormatter:
    """Return what shows commands with the first lines of their docstrings, which are read: no import."""

    def show(console: Console, options: ConsoleOptions, panel: HelpPanel) -> None:
        from cyclopts.help import DefaultFormatter, InlineText

        entries = []
        for entry in panel.entries:
            known = entry_points.get(entry.names[0]) if entry.names else None
            text = InlineText.from_format(_summary(known), format="plaintext") if known else entry.description
            entries.append(entry.copy(description=text))
        DefaultFormatter()(console, options, panel.copy(entries=entries))

    return show


def _summary(entry_point: str) -> str:
    """Return the first line of the docstring of a function of clbench, without importing its module."""
    module, _, function = entry_point.partition(":")
    place = Path(*module.split(".")[1:]).with_suffix(".py")
    (path,) = (Path(folder, place) for folder in clbench.__path__ if Path(folder, place).is_file())
    tree = ast.parse(path.read_text(encoding="utf-8"))
    found = (node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == function)
    return (ast.get_docstring(next(found)) or "").partition("\n")[0]


def _app(name: str, text: str | None, commands: dict[Group, dict[str, str]]) -> App:
    """Return the command `name` with lazy subcommands in groups."""
    made = App(
        name=name,
        help=text,
        version=clbench.__version__,
        group_commands=Group("Options"),
        error_console=Console(stderr=True, soft_wrap=True),
        error_formatter=parsing_error,
        config=read_paths,
        default_parameter=Parameter(negative=""),  # an option that is off needs no --no-option
        suppress_keyboard_interrupt=False,  # `clbench.cli.entry` reports it
    )
    for group, members in commands.items():
        for number, (command, entry_point) in enumerate(members.items()):
            words = command if name == "clbench" else f"{name} {command}"
            usage = f"Usage: clbench {words} [OPTIONS] {USAGES[words]}" if words in USAGES else None
            made.command(entry_point, name=command, group=group, sort_key=number, usage=usage)
    return made


def _grouped(commands: dict[str, dict[str, str]]) -> dict[Group, dict[str, str]]:
    """Return commands by the group that `--help` shows them in, in this order."""
    return {
        Group.create_ordered(title, help_formatter=_summaries(members)): members
        for title, members in commands.items()
    }


GROUPS = _grouped(COMMANDS)
app = _app("clbench", clbench.__doc__ or "", GROUPS)
demonstrations = _app("demonstrations", None, _grouped({"Commands": DEMONSTRATIONS}))
demonstrations.usage = (
    "Usage: clbench demonstrations [OPTIONS] SCENARIO\n       clbench demonstrations COMMAND"
)
demonstrations.default(collect)
experts = _app(
    "experts",
    "Measure the experts that demonstrate tasks, and train learned experts.",
    _grouped({"Commands": EXPERTS}),
)
for place, nested in enumerate((demonstrations, experts)):
    nested.group = next(group for group in GROUPS if group.name == "Inputs and machine")
    nested.sort_key = len(COMMANDS["Inputs and machine"]) + place
    app.command(nested)
app.register_install_completion_command(help="Let TAB complete commands, options, methods and scenarios.")
