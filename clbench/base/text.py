"""Texts for people: names of strangers, counts, the nearest right name, tables for notebooks, and `help`."""

from __future__ import annotations

import difflib
import html
import inspect
import textwrap
from collections.abc import Iterable
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.console import Console

T = TypeVar("T")

_HEADING = "Attributes:"

LONGEST_SHOWN = 500
"""Characters of an error's message that a terminal shows."""


def quoted(text: str) -> str:
    """Return a stranger's text as a Python literal, cut to 60 characters."""
    return repr(text) if len(text) <= 60 else f"{text[:60]!r}..."


def printable(text: str) -> str:
    """Return a stranger's text in one line, without characters that control a terminal."""
    visible = (one if one.isprintable() else one.encode("unicode_escape").decode("ascii") for one in text)
    return "".join(visible)


def printable_lines(text: str) -> str:
    """Return a stranger's text with its lines, but without characters that control a terminal."""
    return "\n".join(map(printable, text.splitlines()))


def shortened(text: str, whole: str) -> str:
    """Return a text of up to `LONGEST_SHOWN` characters as it is, else its start and where the rest is."""
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]} [... {whole} has the rest]"


def counted(count: int, noun: str, nouns: str = "") -> str:
    """Return a count with its noun, "1 seed" or "2 seeds"; `nouns` is the plural if not `noun` with an s."""
    return f"{count} {noun if count == 1 else nouns or f'{noun}s'}"


def megabytes(count: int) -> str:
    """Return a number of bytes as megabytes, such as "4.2 MB"."""
    return f"{count / 1e6:.1f} MB"


def print_plain(console: Console, text: str, style: str | None = None) -> None:
    """Print text as it is: `rich` changes no [name] and no :name:, colours no word and breaks no line."""
    console.print(text, style=style, highlight=False, markup=False, emoji=False, soft_wrap=True)


def listed(parts: Iterable[str]) -> str:
    """Return the parts joined as in a sentence: "a", "a and b", "a, b and c"."""
    *first, last = list(parts) or [""]
    return " and ".join([*filter(None, [", ".join(first)]), last])


def clock_time(seconds: float) -> str:
    """Return a duration in minutes and seconds, such as "2:05", or from one hour on as "1:02:05"."""
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return the end of a message with the nearest known name, empty if none is near.

    Case does not count, and a name with a namespace can also be found by its last part.
    """
    names: dict[str, str] = {}
    for one in known:
        for part in (one, one.rpartition("/")[2]):
            names.setdefault(part.casefold(), one)
    near = difflib.get_close_matches(name.casefold(), names, n=1)
    return f" Did you mean {names[near[0]]!r}?" if near else ""


def html_table(title: str, columns: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Return a title and a table as HTML; texts are escaped, and a tuple in a cell takes a line per item."""

    def cell(value: object) -> str:
        parts = value if isinstance(value, tuple) else (value,)
        return f"<td>{'<br>'.join(html.escape(str(part)) for part in parts)}</td>"

    head = "".join(f"<th>{html.escape(name)}</th>" for name in columns)
    body = "".join(f"<tr>{''.join(map(cell, row))}</tr>" for row in rows)
    return f"<p>{html.escape(title)}</p><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def field_docstrings(cls: type) -> dict[str, str]:
    """Return the docstrings under the fields of a class, by field; Python itself drops them."""
    from docstring_parser import parse_from_object  # 20 ms, and it reads the source

    own = inspect.get_annotations(cls)
    documented = parse_from_object(cls).params
    return {
        one.arg_name: " ".join((one.description or "").split()) for one in documented if one.arg_name in own
    }


def with_fields(cls: type[T]) -> type[T]:
    """Add the fields of a class, with their docstrings, to its docstring for `help`, and return the class."""
    own = cls.__dict__.get("__doc__") or ""
    if _HEADING not in own and (fields := field_docstrings(cls)):
        lines = [f"    {name}: {text}" for name, text in fields.items()]
        wrapped = [textwrap.fill(line, 100, subsequent_indent=" " * 8) for line in lines]
        cls.__doc__ = "\n".join([inspect.cleandoc(own), "", _HEADING, *wrapped])
    return cls
