"""The folders that work reads and writes, and a test before work begins that they can be written to."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from clbench.base.cache import cache_folder, minari_folder
from clbench.base.errors import InputError
from clbench.base.leftovers import unfinished

PLACES = ("CLBENCH_CACHE", "XDG_CACHE_HOME", "MINARI_DATASETS_PATH")
"""Environment variables that name data folders."""


def absolute_places() -> dict[str, str]:
    """Return the variables that name data folders, made absolute: a job may change its working directory."""
    return {
        name: str(Path(os.environ[name]).expanduser().absolute()) for name in PLACES if os.environ.get(name)
    }


def check_folders(folders: Mapping[str, Path | None]) -> None:
    """Refuse folders, caches included, that cannot be made or written to, and leave nothing behind.

    Args:
        folders: Folders by the name of their option.

    Raises:
        InputError: A part of a path is not a folder, or no file can be written there.
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
