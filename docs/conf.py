"""How Sphinx makes the documentation site from this folder: `make site`."""

import re
import shutil
from pathlib import Path
from typing import Any

import clbench

DOCS = Path(__file__).parent
REPOSITORY = "https://github.com/clbench/clbench/blob/main"

project = "clbench"
author = "clbench developers"
version = release = clbench.__version__
language = "en"

extensions = [
    "myst_nb",  # Markdown, and notebooks
    "sphinx_external_toc",  # the order of the pages, from _toc.yml: the pages themselves stay plain Markdown
    "sphinx.ext.autodoc",  # the reference of the Python names, from docstrings
    "sphinx.ext.napoleon",  # ... which have Google's layout
    "sphinx_copybutton",  # a button that copies a command
]
external_toc_path = "_toc.yml"

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
nb_execution_mode = "auto"  # the notebooks are committed without results
nb_execution_excludepatterns = ["first_method.ipynb"]  # it trains
nb_execution_timeout = -1  # no limit: a busy machine may take minutes
nb_execution_raise_on_error = True

suppress_warnings = [
    "ref.python",  # two fields are called `bytes`, like the type of others
    "misc.highlighting_failure",  # a table in `csv`, which GitHub colours and Pygments does not know
]
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"

html_theme = "furo"
html_title = "clbench"
html_static_path = ["site.css"]
html_css_files = ["site.css"]
html_theme_options = {
    "source_repository": "https://github.com/clbench/clbench",
    "source_branch": "main",
    "source_directory": "docs/",
}

_LINK = re.compile(r"\[([^\]]+)\]\(((?:\.\./)+[^)#\s]+)(#[^)\s]*)?\)")
_BOARD = DOCS.parent / "leaderboard" / "site" / "index.html"


def lead_out(_app: Any, page: str, source: list[str]) -> None:
    """Let links that leave docs/ lead to the repository, and those to the leaderboard to its copy here."""
    folder = (DOCS / page).parent

    def link(found: re.Match[str]) -> str:
        text, target, heading = found.groups(default="")
        path = (folder / target).resolve()
        if path == _BOARD:
            return f'<a href="{"../" * page.count("/")}leaderboard/index.html{heading}">{text}</a>'
        if path.is_relative_to(DOCS):
            return found[0]
        if not path.exists():
            raise FileNotFoundError(f"docs/{page}: the link {target} leads to no file")
        return f"[{text}]({REPOSITORY}/{path.relative_to(DOCS.parent).as_posix()}{heading})"

    source[0] = _LINK.sub(link, source[0])


def help_of_commands() -> str:
    """Return what `--help` says of every command, as Markdown."""
    from cyclopts.docs import generate_markdown_docs

    from clbench.cli.main import app

    for command in app.resolved_commands().values():
        command.resolved_commands()  # one that is not imported has no summary in its list
    text = generate_markdown_docs(
        app,
        heading_level=2,
        no_root_title=True,
        generate_toc=False,
        exclude_commands=["--install-completion"],  # its heading has no anchor that a link finds
    )
    text = re.sub(r"^clbench (.+) \1 ", r"clbench \1 ", text, flags=re.MULTILINE)  # Cyclopts says it twice
    # an option in a sentence becomes code: as text, Sphinx makes a dash of its hyphens
    text = re.sub(r"(`[^`\n]*`)|(--[a-z][\w.-]*\w)", lambda found: found[1] or f"`{found[2]}`", text)
    return text.replace(f"{DOCS.parent}/", "")  # in defaults


def complete(app: Any, page: str, source: list[str]) -> None:
    """Add what the site makes to a page, and read pages again whose contents are not in their files alone."""
    if page == "reference/commands":
        source[0] += f"\n{help_of_commands()}"
        app.env.note_reread()
    elif page == "notebooks/reading_the_board":
        app.env.note_dependency(_BOARD)  # newer records have a newer board


def add_files(app: Any, error: Exception | None) -> None:
    """Copy the interactive page of the leaderboard into the site, and pictures that a page has in HTML."""
    if error is None and app.builder.format == "html":
        shutil.copytree(_BOARD.parent, app.outdir / "leaderboard", dirs_exist_ok=True)
        findings = Path("reference", "findings")
        shutil.copytree(DOCS / findings, app.outdir / findings, dirs_exist_ok=True)


def show_fields_once(_app: Any, what: str, _name: str, _what: Any, _options: Any, lines: list[str]) -> None:
    """Show the fields of a class with their own docstrings alone, and those docstrings as they are."""
    if what == "class" and "Attributes:" in lines:
        del lines[lines.index("Attributes:") :]  # they follow as members
    elif what in ("attribute", "property"):
        # an empty comment: napoleon takes what is before a colon in the first line for a type
        lines[:0] = ["..", ""]


def setup(app: Any) -> None:
    """Connect what Sphinx calls."""
    app.connect("source-read", lead_out)
    app.connect("source-read", complete)
    app.connect("autodoc-process-docstring", show_fields_once, priority=400)  # before napoleon
    app.connect("build-finished", add_files)
