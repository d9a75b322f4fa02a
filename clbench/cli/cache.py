"""The command `clbench cache`: what the cache holds, and which of it is stale."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import shutil
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from stat import S_ISDIR
from typing import Annotated, Any

from rich.console import Console
from rich.table import Table
from safetensors import SafetensorError, safe_open

from clbench.base.cache import MANIFEST, cache_folder, hash_of, minari_folder
from clbench.base.errors import InputError
from clbench.base.leftovers import finished_name, is_idle, is_left_behind, is_unfinished, unfinished
from clbench.base.text import counted, megabytes, print_plain
from clbench.cli.arguments import checked_input, whole_number
from clbench.records.reader import RecordError, read_record

LOG = logging.getLogger("clbench")

DEMONSTRATIONS = "demonstrations"
"""Kind of the Minari datasets that clbench collected."""

KINDS = {
    DEMONSTRATIONS: "episodes of the experts, as Minari datasets",
    "definitions": "hashes of what scenarios do",
    "scenes": "states that questions are asked about",
    "frames": "pictures of demonstrations and scenes",
    "pretrained": "pretrained policies",
    "reports": "evaluations of pretrained policies",
    "runs": "checkpoints of unfinished runs",
    "stages": "policies of finished runs, made again",
    "ray": "records of runs on a Ray cluster",
    "experts": "checkpoints of expert training",
    "vectors": "capability vectors of fast_dvla",
    "watched": "what methods kept of the pretraining that they watched",
}
"""Kinds of entries and their contents. All kinds but the first are folders of the cache."""

_NAME = re.compile(r"(?:.*-)?[0-9a-f]{16}(?:\.\w+)?")
"""Names of entries: they end with a hash. Nothing else is shown or deleted."""
_READ_HERE = ("ray", "experts")
"""Kinds without manifests: this command itself reads their files. A run or a training writes them again."""
_CODE = ("source", "versions", "torch")
WIDE = 100
"""Width of a terminal in characters from which on the table says what each kind contains."""

_DAY = 24 * 60 * 60


def cache(
    *,
    prune: bool = False,
    dry_run: bool = False,
    older_than: Annotated[int, whole_number(0)] = 30,
) -> None:
    """Show what the cache and the Minari datasets of clbench hold, and which entries are stale.

    An entry is stale if it has not been used for --older-than days, if newer code has made its replacement
    since its last use, or if a killed process left it behind. An entry that a process is using, such as a run
    in progress, is never stale. The cache holds no records, and clbench can make everything in it again.
    clbench never deletes files that it did not make: it names an entry with such a file, and leaves it as it
    is. On a file system without access times, an entry counts as used when it was made.

    Args:
        prune: List the stale entries, and delete them.
        dry_run: List the stale entries without deleting them.
        older_than: Days without use after which an entry is stale.
    """
    now = time.time()
    with checked_input():
        try:
            found = list(entries())
        except PermissionError as error:  # the cache of another user
            raise InputError(f"{error.filename} cannot be read: {error.strerror}.") from error
    stale = find_stale(found, older_than, now)
    console = Console(highlight=False)
    console.print(_table(found, stale, now, console.width >= WIDE))
    lines = [
        f"Cache: {cache_folder()} (CLBENCH_CACHE moves it)",
        f"Demonstrations: {minari_folder()} (MINARI_DATASETS_PATH moves it)",
    ]
    lines += [
        f"{entry.path} is not deleted: clbench did not make {_some(entry.foreign)} in it."
        for entry in found
        if entry.foreign
    ]
    if prune or dry_run:
        lines += [f"{megabytes(entry.size):>9}  {entry.path}: {reason}" for entry, reason in stale.items()]
    print_plain(console, "\n".join(lines))
    count = counted(len(stale), "stale entry", "stale entries")
    size = megabytes(sum(entry.size for entry in stale))
    if prune and not dry_run:
        faults = []
        for entry in stale:
            try:
                entry.delete()
            except InputError as error:
                faults.append(str(error))
        with checked_input():
            if faults:
                raise InputError(f"{len(faults)} of {count} could not be deleted. {' '.join(faults)}")
        console.print(f"Deleted {count}, {size}.", soft_wrap=True)
    elif stale:
        console.print(f"`clbench cache --prune` deletes {count}, {size}.", soft_wrap=True)


@dataclass(frozen=True, eq=False)
class Entry:
    """A folder or a file that is kept or deleted as a whole."""

    kind: str
    """Kind of the entry, see `KINDS`."""
    path: Path
    """Path of the folder or file."""

    @cached_property
    def _stats(self) -> dict[Path, os.stat_result]:
        return _stats_below(self.path)

    @property
    def size(self) -> int:
        """Bytes of its files."""
        return _bytes(self._stats)

    @property
    def made(self) -> float:
        """Time of the last change."""
        return max((stat.st_mtime for stat in self._stats.values()), default=0.0)

    @property
    def used(self) -> float:
        """Time of the last change, or of the last reading as far as the file system notes it."""
        if self.kind in _READ_HERE:
            return self.made
        # this command itself reads manifests and lists folders
        read = (
            stat.st_atime
            for path, stat in self._stats.items()
            if path.name != MANIFEST and not S_ISDIR(stat.st_mode)
        )
        return max((self.made, *read))

    @cached_property
    def foreign(self) -> list[str]:
        """Paths of the files in it that clbench did not write; a leftover has no list to tell them by."""
        if self.is_leftover or not self.path.is_dir():
            return []
        files = {path for path, stat in self._stats.items() if not S_ISDIR(stat.st_mode)}
        if self.kind == "ray":
            ours = {path for path in files if _is_record(path)}
        else:
            ours = set[Path]().union(*(_listed(path) for path in files if path.name == MANIFEST))
        left = (path for path in files - ours if os.path.lexists(path))  # a run may just remove its own
        return sorted(path.relative_to(self.path).as_posix() for path in left)

    @property
    def is_leftover(self) -> bool:
        """Whether a process is filling it, or was killed while it did."""
        return is_unfinished(self.path.name)

    @cached_property
    def origin(self) -> tuple[str, str] | None:
        """Hashes of its inputs and of the code that made it; None if no manifest shows these."""
        manifests = sorted(path for path in self._stats if path.name == MANIFEST)
        manifest = _read_manifest(manifests[0]) if manifests else None
        if manifest is None:
            return None
        code: list[Any] = []
        purpose = _without_code(manifest["made_from"], code)
        return hash_of([self.kind, purpose]), hash_of(code)

    def delete(self) -> None:
        """Delete it. It gets another name first, so that no process meets half of it.

        Raises:
            InputError: The file system refuses.
        """
        doomed = unfinished(self.path.with_name(finished_name(self.path.name))).with_suffix(".old")
        try:
            self.path.rename(doomed)
            if doomed.is_dir():
                shutil.rmtree(doomed)
            else:
                doomed.unlink()
        except FileNotFoundError:  # another process has just deleted it
            return
        except OSError as error:
            raise InputError(f"{self.path} cannot be deleted: {error.strerror}.") from error


def entries() -> Iterator[Entry]:
    """Yield what clbench made in the cache, and the Minari datasets that it collected.

    The folders may hold other people's files too. An entry has a name and a place that clbench gives, and the
    files that it writes there; links are never followed.
    """
    for kind in KINDS:
        folder = cache_folder() / kind
        if kind == DEMONSTRATIONS or not _is_folder(folder):
            continue
        for path in _inside(folder):
            if _NAME.fullmatch(path.name) and _is_made_here(kind, path):
                yield Entry(kind, path)
        yield from _leftovers(kind, folder)
    datasets = minari_folder() / "clbench"  # the ids of its datasets begin with this name
    if _is_folder(datasets):
        manifests = sorted(path for path in _walk(datasets) if path.name == MANIFEST)
        yield from (Entry(DEMONSTRATIONS, path.parent) for path in manifests if _is_dataset(path.parent))
        yield from _leftovers(DEMONSTRATIONS, datasets)


def _inside(folder: Path) -> list[Path]:
    """Return what is in a folder, nothing if this user may not read it: the log says so."""
    try:
        return sorted(folder.iterdir())
    except PermissionError as error:
        LOG.warning("%s cannot be read: %s.", folder, error.strerror)
        return []


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _is_made_here(kind: str, path: Path) -> bool:
    """Return whether a path below the folder of a kind holds what clbench writes there."""
    if kind == "experts":
        return not path.is_symlink() and _is_training(path)
    if not _is_folder(path):
        return False
    if kind == "ray":  # records on their way; a worker that was killed leaves them
        return any(map(_is_record, _walk(path)))
    inside = (one for one in _inside(path) if _is_folder(one))
    return any(_read_manifest(one / MANIFEST) is not None for one in (path, *inside))


def _is_dataset(folder: Path) -> bool:
    """Return whether a folder is a dataset that clbench collected, and nothing else is in it."""
    parts = {path.name for path in folder.iterdir()}
    nested = any(path.name == MANIFEST and path.parent != folder for path in _walk(folder))
    return parts == {MANIFEST, "data"} and not nested and _read_manifest(folder / MANIFEST) is not None


def _is_training(path: Path) -> bool:
    """Return whether a file is the checkpoint of an expert's training."""
    try:
        with safe_open(path, "np") as file:
            return "training" in (file.metadata() or {})
    except (OSError, SafetensorError):
        return False


def _is_record(path: Path) -> bool:
    """Return whether a file is a record, which no one has changed."""
    try:
        read_record(path)
    except (OSError, RecordError):
        return False
    return True


def _read_manifest(path: Path) -> dict[str, Any] | None:
    """Return a manifest of `clbench.base.cache`, None if the file is no such manifest."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    whole = isinstance(values, dict) and {"inputs", "files", "made_from"} <= set(values)
    return values if whole and isinstance(values["files"], dict) else None


def _listed(manifest: Path) -> set[Path]:
    """Return the files that a manifest lists, and itself."""
    values = _read_manifest(manifest)
    return set() if values is None else {manifest, *(manifest.parent / name for name in values["files"])}


def size_of(path: Path) -> int:
    """Return the bytes of the files in a folder, 0 if it does not exist."""
    return _bytes(_stats_below(path))


def _bytes(stats: Mapping[Path, os.stat_result]) -> int:
    return sum(stat.st_size for stat in stats.values() if not S_ISDIR(stat.st_mode))


def _stats_below(path: Path) -> dict[Path, os.stat_result]:
    stats = {}
    for one in (path, *_walk(path)):
        with contextlib.suppress(FileNotFoundError, PermissionError):  # a run has just removed it
            stats[one] = one.lstat()
    return stats


def _walk(folder: Path) -> Iterator[Path]:
    """Yield everything below a folder, except leftovers; what vanishes meanwhile is left out."""
    for place, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not is_unfinished(name)]
        yield from (Path(place, name) for name in (*folders, *files))


def _leftovers(kind: str, folder: Path) -> Iterator[Entry]:
    """Yield the folders with names of leftovers, in entries and of entries."""
    for place, folders, _ in os.walk(folder):
        above = Path(place).relative_to(folder).parts
        for name in sorted(folders):
            if not is_unfinished(name) or Path(place, name).is_symlink():
                continue
            if kind == DEMONSTRATIONS or _NAME.fullmatch(above[0] if above else finished_name(name)):
                yield Entry(kind, Path(place, name))


def _without_code(value: Any, code: list[Any]) -> Any:
    """Return inputs of the cache without those that describe code, which are appended to `code`."""
    if isinstance(value, list):
        return [_without_code(part, code) for part in value]
    if not isinstance(value, dict):
        return value
    code.extend(value[name] for name in _CODE if name in value)
    return {name: _without_code(part, code) for name, part in value.items() if name not in (*_CODE, "stage")}


def find_stale(found: Iterable[Entry], days: int, now: float) -> dict[Entry, str]:
    """Return the stale entries, each with the reason.

    An entry with foreign files is never stale, nor is one whose lease a process holds.

    Args:
        found: Entries.
        days: Days without use after which an entry is stale.
        now: Present time, in seconds since the epoch.
    """
    found = [entry for entry in found if not entry.foreign]
    newest: dict[str, Entry] = {}
    for entry in found:
        if entry.origin is not None and not entry.is_leftover:
            purpose, _ = entry.origin
            newest[purpose] = max(newest.get(purpose, entry), entry, key=lambda one: one.made)
    stale = {}
    for entry in found:
        newer = newest.get(entry.origin[0]) if entry.origin is not None else None
        if entry.is_leftover:
            if is_left_behind(entry.path):
                stale[entry] = "left behind by a killed process"
        elif not is_idle(entry.path):
            continue  # a run writes its checkpoints at the ends of stages only
        elif now - entry.used > days * _DAY:
            stale[entry] = f"not used for {_days(now - entry.used)}"
        elif newer is not None and newer.origin != entry.origin and entry.used < newer.made:
            stale[entry] = f"replaced by {newer.path.name}, which newer code made"
    return stale


def _table(found: Sequence[Entry], stale: Mapping[Entry, str], now: float, is_wide: bool) -> Table:
    """Return the kinds as a table; a wide one says what they contain."""
    table = Table()
    table.add_column("kind", no_wrap=True)
    for column in ("entries", "size", "oldest", "stale"):
        table.add_column(column, justify="right", no_wrap=True)
    if is_wide:
        table.add_column("contents")
    present = {entry.kind for entry in found}
    for kind in filter(present.__contains__, KINDS):
        ours = [entry for entry in found if entry.kind == kind]
        unused = [entry.size for entry in ours if entry in stale]
        table.add_row(
            kind,
            str(len(ours)),
            megabytes(sum(entry.size for entry in ours)),
            _days(max(now - entry.made for entry in ours)),
            f"{len(unused)} ({megabytes(sum(unused))})" if unused else "-",
            *([KINDS[kind]] if is_wide else []),
        )
    return table


def _some(names: Sequence[str]) -> str:
    more = len(names) - 1
    return names[0] + (f" and {counted(more, 'more file')}" if more else "")


def _days(seconds: float) -> str:
    return counted(int(max(0.0, seconds) // _DAY), "day")
