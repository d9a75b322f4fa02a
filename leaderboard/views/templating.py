"""The templates of all Markdown pages, and what they escape.

A template escapes every value unless it is of the type `Markdown`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template

from clbench.base.text import printable
from clbench.scoring.intervals import Estimate

from .format import MISSING, format_interval, number_text, title_of

_ARXIV = re.compile(r"arXiv (\d{4}\.\d{5})")


class Markdown(str):
    """Text that is Markdown already: templates do not escape it."""


def template(module: str, name: str) -> Template:
    """Return a template from the folder `templates` beside a module, whose `__file__` is `module`."""
    return _templates(Path(module).with_name("templates")).get_template(name)


@cache
def _templates(folder: Path) -> Environment:
    """Return the templates in `folder`, with the filters that Markdown pages need."""
    environment = Environment(
        loader=FileSystemLoader(folder),
        autoescape=False,  # it would escape HTML; `finalize` escapes Markdown
        finalize=_escaped_unless_markdown,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters.update(
        code=code,
        interval=_interval,
        lines=_lines,
        links=links,
        number=number_text,
        prose=prose,
        raw=Markdown,
        title_of=title_of,
    )
    environment.globals.update(MISSING=MISSING)
    return environment


def _escaped_unless_markdown(value: object) -> str:
    return value if isinstance(value, Markdown) else escaped(str(value))


def escaped(text: str) -> Markdown:
    """Return `text`, which a stranger may have written, so that Markdown shows it as it is.

    Backslashes go before every character that can open markup, HTML, a formula, a mention or a table cell,
    and into web addresses.
    """
    return Markdown(
        re.sub(
            r"([\\`*_{}\[\]<>|~&@#$]|(?<=:)/(?=/)|(?<=www)\.)", r"\\\1", printable(text), flags=re.IGNORECASE
        )
    )


def prose(text: str) -> Markdown:
    """Return our own words as Markdown: code in backticks stays, arXiv identifiers become links."""
    parts = re.split(r"(`[^`]+`)", text)
    return Markdown("".join(part if part.startswith("`") else linked(escaped(part)) for part in parts))


def linked(text: str) -> Markdown:
    """Return `text` with links for the arXiv identifiers in it."""
    return Markdown(_ARXIV.sub(r"[arXiv \1](https://arxiv.org/abs/\1)", text))


def arxiv_ids(text: str) -> list[str]:
    """Return the arXiv identifiers in `text`, each once, in order."""
    return list(dict.fromkeys(_ARXIV.findall(text)))


def links(ids: Iterable[str]) -> Markdown:
    """Return links to papers, given their arXiv identifiers."""
    return Markdown(", ".join(linked(f"arXiv {one}") for one in ids))


def code(text: str) -> Markdown:
    """Return our own `text` as code."""
    return Markdown(f"`{text}`")


def _interval(estimate: Estimate, form: str = ".2f") -> Markdown:
    return Markdown(format_interval(estimate, form))


def _lines(texts: Iterable[Any]) -> Markdown:
    """Return texts below each other in one cell."""
    return Markdown("<br>".join(map(escaped, texts)))
