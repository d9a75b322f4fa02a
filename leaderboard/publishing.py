"""The folder `site` next to the records: every form of the board, and what it was made from.

Computing the board takes half a minute, most of it for intervals. The folder therefore keeps the numbers in
`board.json`, with hashes of their inputs and of the files themselves, and reads them back until one of these
changes.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clbench.base.cache import hash_of
from clbench.base.errors import InputError
from clbench.base.leftovers import sweep
from clbench.base.source import files_below, package_of, source_hash
from clbench.base.strict_json import StrictJSONError, read_regular
from clbench.records.content import content_hash
from clbench.records.pinned import pinned_file
from clbench.spec.identifiers import installed_methods

from .board.frontier import ladder_of
from .board.paths import CARDS, FILM, beside
from .board.summary import Summary
from .policies.decoders import RESULTS
from .views.csv import csv_text
from .views.files import write_all

if TYPE_CHECKING:
    from .board.rows import Board

PUBLISHED = Path(__file__).parent / "records"
"""Folder of the records that come with clbench."""

NUMBERS = "board.json"
"""Name of the file with the numbers of the board."""

MOST_OF_A_SITE = 2**30
"""Most bytes of a file of the site: the page of many records is larger than what a stranger's file may be."""

_CODE = (
    *("clbench.base", "clbench.spec", "clbench.records", "clbench.runs", "clbench.scoring"),
    *("clbench.learning", "clbench.metrics", "clbench.leaderboard.board", "clbench.leaderboard.policies"),
    *("clbench.leaderboard.views", "clbench.leaderboard.publishing"),
)
"""Code that the board and its pages depend on, besides the packages of the installed methods."""

_QUOTED = ("clbench.methods", "clbench.scoring")
"""Packages whose docstrings the pages quote; the hash of code leaves docstrings out."""


def site_of(records: Path) -> Path:
    """Return the folder of the board for a folder of records."""
    return beside(records, "site")


def add_published(records: Path) -> int:
    """Copy the published records, with their verifications, to a folder of records; existing files stay.

    The ladder is copied beside it: without plain fine-tuning at the settings that tied in tuning, no gain
    over it is certain.

    Returns:
        The number of records that were missing in the folder itself.
    """
    places = {PUBLISHED: records, ladder_of(PUBLISHED): ladder_of(records)}
    texts = {
        path: source.read_text(encoding="utf-8")
        for folder, place in places.items()
        for source in sorted(folder.rglob("seed-*"))
        if source.suffix in (".json", ".verified")
        and not (path := place / source.relative_to(folder)).exists()
    }
    return sum(path.suffix == ".json" and path.is_relative_to(records) for path in write_all(texts))


def inputs_of(records: Path) -> dict[str, str]:
    """Return the hashes of everything that the board of a folder of records is made from.

    Call it before the records are read: a record that arrives in between then changes the next hash.
    """
    pictures = sorted([*CARDS.glob("*/*.webp"), *CARDS.glob(f"*/{FILM}")])
    packages = {package_of(entry.value) for entry in installed_methods().values()}
    return {
        "records": _folder_hash(records),
        "ladder": _folder_hash(ladder_of(records)),
        "pictures": hash_of(
            {path.relative_to(CARDS).as_posix(): _hash_of_bytes(path.read_bytes()) for path in pictures}
        ),
        "decoding": _hash_of_bytes(RESULTS.read_bytes()) if RESULTS.is_file() else "",
        "definitions": _hash_of_bytes(pinned_file().read_bytes()),
        "code": source_hash(*_CODE, *packages),
        "docstrings": hash_of(_docstrings()),
    }


def _docstrings() -> list[str | None]:
    """Return the docstrings of the packages that the pages quote, in order."""
    specs = [importlib.util.find_spec(package) for package in _QUOTED]
    folders = [Path(spec.origin).parent for spec in specs if spec is not None and spec.origin is not None]
    paths = [path for folder in folders for path in files_below(folder) if path.suffix == ".py"]
    return [text for path in paths for text in _docstrings_in(path)]


def _docstrings_in(path: Path) -> list[str | None]:
    try:
        tree = ast.parse(path.read_bytes())
    except (SyntaxError, ValueError):  # half written, or an editor's: no page can quote it
        return []
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    return [ast.get_docstring(node) for node in ast.walk(tree) if isinstance(node, documented)]


def _folder_hash(folder: Path) -> str:
    """Return the hash of the names and contents of everything below `folder`; links are not followed."""
    found: dict[str, str] = {}
    for parent, folders, names in os.walk(folder):
        for path in (Path(parent, name) for name in (*folders, *names)):
            try:
                content = _hash_of_bytes(read_regular(path))
            except StrictJSONError as error:  # the reader of records refuses it with the same message
                content = str(error)
            except OSError as error:
                content = str(error.strerror)  # without the path: a copy of the folder has the same hash
            found[path.relative_to(folder).as_posix()] = content
    return hash_of(found)


def read_unchanged(records: Path, inputs: dict[str, str]) -> Summary | None:
    """Return the numbers of the board, None unless every file of the site is whole and made from `inputs`."""
    site = site_of(records)
    if site.is_symlink():
        return None
    try:
        kept: dict[str, Any] = json.loads(read_regular(site / NUMBERS, MOST_OF_A_SITE))
        files = {name: _hash_of_bytes(read_regular(site / name, MOST_OF_A_SITE)) for name in kept["files"]}
        whole = kept["files"] == files and kept["content"] == content_hash(kept)
        return Summary.from_json(kept["board"]) if whole and kept["made_from"] == inputs else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):  # none yet, or damaged
        return None


def read_board(records: Path) -> Summary:
    """Return the board of a folder of records: the numbers that it keeps, if they still hold.

    Raises:
        NoRecordsError: The folder does not exist.
    """
    from .board.rows import compute_board

    return read_unchanged(records, inputs_of(records)) or compute_board(records)


def check_site(records: Path) -> None:
    """Refuse a link in the place of the board's folder: it may lead to files of others.

    Raises:
        InputError: It is a link.
    """
    site = site_of(records)
    if site.is_symlink():
        raise InputError(f"{site} is a symbolic link, which is not followed. Put a folder in its place.")


def write_site(board: Board, records: Path, inputs: dict[str, str]) -> dict[Path, bool]:
    """Write every form of the board to the folder of the board, and return which files changed.

    Raises:
        InputError: The folder is a link, or the file system refuses one of the files.
    """
    check_site(records)
    # They load the charts, SciPy and PyTorch: 3 s.
    from .policies.compared import by_table
    from .views import page as web_page
    from .views.markdown import markdown

    comparisons = by_table(board.rows)
    texts = {
        "LEADERBOARD.md": markdown(board, comparisons),
        "leaderboard.csv": csv_text(board),
        "index.html": web_page.page(board, comparisons),
        **web_page.pictures(board),
    }
    files = {name: _hash_of_bytes(text.encode()) for name, text in texts.items()}
    kept = {"made_from": inputs, "files": files, "board": board.to_json()}
    texts[NUMBERS] = json.dumps({**kept, "content": content_hash(kept)}, indent=1) + "\n"
    site = site_of(records)
    sweep(site)
    former = _files_of(site)
    written = write_all({site / name: text for name, text in texts.items()})
    for name in former - texts.keys():  # such as the picture of a frontier that no longer exists
        if os.path.isfile(site / name):  # a stranger's list may name "..", or what no file can be called
            (site / name).unlink()
    return written


def _files_of(site: Path) -> set[str]:
    """Return the names of the files that the board of a folder was written to; empty if that is unknown."""
    try:
        names = json.loads(read_regular(site / NUMBERS, MOST_OF_A_SITE))["files"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return set()
    return {name for name in names if isinstance(name, str) and Path(name).name == name}


def _hash_of_bytes(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
