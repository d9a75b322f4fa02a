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
    "sphinxcontrib.mermaid",  # the diagram in architecture.md
]
external_toc_path = "_toc.yml"

myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["mermaid"]
myst_heading_anchors = 4
nb_execution_mode = "off"  # tests/test_notebooks.py executes them

suppress_warnings = [
    "ref.python",  # two fields are called `bytes`, like the type of others
    "misc.highlighting_failure",  # a table in `csv`, which GitHub colours and Pygments does not know
]
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_member_order = "bysource"

html_theme = "furo"
html_title = "clbench"
html_theme_options = {
    "source_repository": "https://github.com/clbench/clbench",
    "source_branch": "main",
    "source_directory": "docs/",
}

_LINK = re.compile(r"\[([^\]]+)\]\(((?:\.\./)+[^)#\s]+)\)")
_BOARD = DOCS.parent / "leaderboard" / "site" / "index.html"


def lead_out(_app: Any, page: str, source: list[str]) -> None:
    """Let links that leave docs/ lead to the repository, and those to the leaderboard to its copy here."""
    folder = (DOCS / page).parent

    def link(found: re.Match[str]) -> str:
        text, path = found[1], (folder / found[2]).resolve()
        if path == _BOARD:
            return f'<a href="{"../" * page.count("/")}leaderboard/index.html">{text}</a>'
        if path.is_relative_to(DOCS):
            return found[0]
        if not path.exists():
            raise FileNotFoundError(f"docs/{page}: the link {found[2]} leads to no file")
        return f"[{text}]({REPOSITORY}/{path.relative_to(DOCS.parent).as_posix()})"

    source[0] = _LINK.sub(link, source[0])


def add_leaderboard(app: Any, error: Exception | None) -> None:
    """Copy the interactive page of the leaderboard into the site."""
    if error is None and app.builder.format == "html":
        shutil.copytree(_BOARD.parent, app.outdir / "leaderboard", dirs_exist_ok=True)


def show_fields_once(_app: Any, what: str, _name: str, _what: Any, _options: Any, lines: list[str]) -> None:
    """Show the fields of a class with their own docstrings alone, and those docstrings as they are."""
    if what == "class" and "Attributes:" in lines:
        del lines[lines.index("Attributes:") :]  # they follow as members
    elif what in ("attribute", "property"):
        lines.insert(0, "")  # otherwise napoleon takes what is before a colon for a type


def setup(app: Any) -> None:
    """Connect what Sphinx calls."""
    app.connect("source-read", lead_out)
    app.connect("autodoc-process-docstring", show_fields_once, priority=400)  # before napoleon
    app.connect("build-finished", add_leaderboard)
