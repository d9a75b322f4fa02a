"""The folders that work reads and writes, and a check that they can be written to before it begins."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from clbench.base.cache import cache_folder
from clbench.base.errors import InputError
from clbench.base.leftovers import unfinished

PLACES = ("CLBENCH_CACHE", "XDG_CACHE_HOME", "MINARI_DATASETS_PATH")
"""Variables that name folders of data."""


def minari_folder() -> Path:
    """Return the folder of all Minari datasets."""
    return Path(os.environ.get("MINARI_DATASETS_PATH") or "~/.minari/datasets").expanduser().absolute()


def absolute_places() -> dict[str, str]:
    """Return the variables that name folders of data, absolute: a job may change its working directory."""
    return {
        name: str(Path(os.environ[name]).expanduser().absolute()) for name in PLACES if os.environ.get(name)
    }


def check_folders(folders: Mapping[str, Path | None]) -> None:
    """Refuse folders that cannot be made or written to, and the cache's; nothing is left behind.

    Args:
        folders: Folders by the name of their option.

    Raises:
        InputError: A part of a path is no folder, or no file can be written there.
    """
    data = {"CLBENCH_CACHE": cache_folder(), "MINARI_DATASETS_PATH": minari_folder()}
    for name, folder in {**folders, **data}.items():
        if folder is None:
            continue
        there = next(one for one in (folder, *folder.absolute().parents) if os.path.lexists(one))
        probe = unfinished(there / "probe")
        try:
            probe.touch()
            probe.unlink()
        except OSError as error:
            raise InputError(f"{name} {folder} cannot be written to: {error.strerror}.") from error
