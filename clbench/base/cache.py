"""The cache of slow results: each is made once, and reused while it is whole and its inputs are the same."""

from __future__ import annotations

import errno
import glob
import hashlib
import json
import logging
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import SafetensorError

from clbench.base.errors import ClbenchError, InputError
from clbench.base.lease import Lease
from clbench.base.leftovers import finished_name, is_unfinished, unfinished
from clbench.base.source import files_below
from clbench.base.strict_json import read_json, refusal

if TYPE_CHECKING:
    from torch import Tensor


LOG = logging.getLogger("clbench")

MANIFEST = "clbench.json"
"""File in each entry that lists the entry's inputs, and its other files with their hashes."""

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EMFILE, errno.ENFILE)
"""Error numbers of a machine that has no room for a file, or that cannot keep another file open."""

FAILING = (
    errno.EIO,
    errno.ESTALE,
    errno.EROFS,
    errno.ESHUTDOWN,
    errno.ETIMEDOUT,
    errno.EHOSTDOWN,
    errno.EHOSTUNREACH,
)
"""Error numbers of a failing disk, or of a failing network to a shared folder."""


class CacheError(ClbenchError, OSError):
    """The file system refused to keep or read a result: a disk is full or fails, a folder is read-only."""


def cache_folder() -> Path:
    """Return the cache folder: `CLBENCH_CACHE` if it is set, else clbench in the user's own cache folder."""
    if os.environ.get("CLBENCH_CACHE"):
        return Path(os.path.realpath(_at_home(os.environ["CLBENCH_CACHE"])))
    return _at_home(os.environ.get("XDG_CACHE_HOME") or "~/.cache").absolute() / "clbench"


def minari_folder() -> Path:
    """Return the folder of all Minari datasets: `MINARI_DATASETS_PATH` if it is set, else Minari's own.

    Minari itself takes an empty value for a folder, and does not expand a tilde.
    """
    return _at_home(os.environ.get("MINARI_DATASETS_PATH") or "~/.minari/datasets").absolute()


def _at_home(path: str) -> Path:
    try:
        return Path(path).expanduser()
    except RuntimeError as error:  # a container may run under a user id that has no account
        raise InputError(
            f"There is no home folder for {path}: set CLBENCH_CACHE and MINARI_DATASETS_PATH to folders that "
            "can be written to."
        ) from error


def hash_of(values: Any) -> str:
    """Return a short hash of anything that JSON can hold."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]


def hash_of_tensors(tensors: Mapping[str, Tensor]) -> str:
    """Return a short hash of the names and the bits of tensors."""
    import torch  # takes a second to import

    digest = hashlib.sha256()
    for name, value in sorted(tensors.items()):
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        # as bytes: NumPy has no bfloat16
        digest.update(value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()[:16]


def cached(folder: Path, inputs: Mapping[str, Any], make: Callable[[Path], None]) -> Path:
    """Return `folder`, filled by `make` unless it already holds the result of the same `inputs`.

    A folder that is torn, foreign or made from other inputs is named in the log and made again. The new one
    appears in one step, so that a reader never meets half of it. If another process is making it, this one
    waits and uses its result.

    Args:
        folder: Folder of the result.
        inputs: Everything that the result depends on, as JSON.
        make: Fills an empty folder.

    Raises:
        CacheError: The file system refuses to keep the result.
    """
    key = hash_of(inputs)
    if _fault(folder, key) is None:
        return folder
    lease = Lease(folder)
    with _explained(folder), lease.held():
        _remove_unfinished(folder)
        fault = _fault(folder, key)
        if fault is not None:
            if folder.exists():
                LOG.warning("%s %s; making it again.", folder, fault)
            _make(folder, {"inputs": key, "made_from": dict(inputs)}, make, lease)
    return folder


def _remove_unfinished(folder: Path) -> None:
    """Remove what earlier makers of `folder` left when they were killed: this process has the lease now."""
    for path in folder.parent.glob(f".{glob.escape(folder.name)}.*"):
        if is_unfinished(path.name) and finished_name(path.name) == folder.name:
            shutil.rmtree(path, ignore_errors=True)


def _make(folder: Path, manifest: Mapping[str, Any], make: Callable[[Path], None], lease: Lease) -> None:
    """Make `folder` in one step; an earlier one is removed."""
    partial = unfinished(folder)
    partial.mkdir()
    try:
        make(partial)
        hashes = _file_hashes(partial)
        text = json.dumps({**manifest, "files": hashes}, indent=1)
        (partial / MANIFEST).write_text(text, encoding="utf-8")
        mode = (partial / MANIFEST).stat().st_mode
        with suppress(PermissionError):  # some file systems have no modes
            for name in hashes:  # safetensors lets only the owner read its files, whatever the umask allows
                (partial / name).chmod(mode)
        lease.check()
        if folder.exists():
            folder.rename(partial.with_suffix(".old"))
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        shutil.rmtree(partial.with_suffix(".old"), ignore_errors=True)


@contextmanager
def _explained(folder: Path) -> Iterator[None]:
    """Raise a `CacheError` that names `folder` if the file system fails inside the block.

    Errors about files elsewhere pass unchanged: `make` must handle them.
    """
    try:
        yield
    except CacheError:  # about another result, which `make` needs
        raise
    except (OSError, SafetensorError) as error:
        if isinstance(error, OSError) and not is_the_machines(error) and not _is_on_the_way(error, folder):
            raise
        reason = getattr(error, "strerror", None) or error
        raise CacheError(f"{folder} cannot be written: {reason}.") from error


def is_the_machines(error: OSError) -> bool:
    """Return whether the machine is to blame: it has no room, or its disk or network fails."""
    return error.errno in NO_ROOM + FAILING


def _is_on_the_way(error: OSError, folder: Path) -> bool:
    """Return whether an error concerns a path below the parent of `folder`, or a folder above that parent."""
    if error.filename is None:
        return False
    path, parent = (Path(os.path.abspath(os.fsdecode(name))) for name in (error.filename, folder.parent))
    return path.is_relative_to(parent) or parent.is_relative_to(path)


def is_cached(folder: Path, inputs: Mapping[str, Any]) -> bool:
    """Return whether `folder` is whole and was made from `inputs`.

    Raises:
        CacheError: The file system refuses to read.
    """
    return fault_of(folder, inputs) is None


def fault_of(folder: Path, inputs: Mapping[str, Any]) -> str | None:
    """Return why `folder` cannot serve as the result of `inputs`, as the end of a sentence, or None.

    Raises:
        CacheError: The file system refuses to read.
    """
    return _fault(folder, hash_of(inputs))


def _fault(folder: Path, key: str) -> str | None:
    """Return the fault of `folder`, or None.

    Raises:
        CacheError: The file system refuses to read. The entry may be whole, so it stays.
    """
    try:
        manifest = read_json(folder / MANIFEST)
        if manifest["inputs"] != key:
            return "was made from other inputs"
        if manifest["files"] != _file_hashes(folder):
            return "is torn: its files are not those that were written"
    except (OSError, ValueError, KeyError, TypeError) as error:
        refused = refusal(error)
        if refused is not None:
            raise CacheError(f"{folder} cannot be read now: {refused.strerror}.") from error
        return "is torn, or was not made by clbench: it has no readable manifest"
    return None


def _file_hashes(folder: Path) -> dict[str, str]:
    paths = [path for path in files_below(folder) if path.name != MANIFEST]
    return {path.relative_to(folder).as_posix(): _file_hash(path) for path in paths}


def _file_hash(path: Path) -> str:
    with path.open("rb") as file:  # in pieces: a policy may be larger than the free memory
        return hashlib.file_digest(file, "sha256").hexdigest()
