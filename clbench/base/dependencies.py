"""Installed packages: their versions, and the extras that bring those which only some things need."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from importlib import metadata
from importlib.util import find_spec

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from clbench.base.errors import MissingPackageError


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Return the version of each distribution, in order of the names.

    Raises:
        importlib.metadata.PackageNotFoundError: One is not installed.
    """
    return {package: _version(package) for package in sorted(packages)}


@functools.cache  # to parse the metadata of a package takes 10 ms, and a run asks for about 70
def _version(package: str) -> str:
    return metadata.version(package)


def require(module: str, extra: str, purpose: str) -> None:
    """Refuse to go on without an extra, before any work is done.

    Args:
        module: What would be imported.
        extra: Name of the extra of clbench that brings it.
        purpose: What needs it, as the subject of a sentence.

    Raises:
        LookupError: It is not installed; the message says how to get it.
    """
    if find_spec(module) is None:
        raise MissingPackageError(f"{purpose} needs the package {module}: pip install 'clbench[{extra}]'")


def require_packages(packages: Iterable[str], purpose: str) -> None:
    """Refuse to go on without distributions, before any work is done.

    Args:
        packages: Names of the distributions.
        purpose: What needs them, as the subject of a sentence.

    Raises:
        LookupError: One is not installed; the message says how to get it.
    """
    for package in sorted(packages):
        if not is_installed(package):
            raise MissingPackageError(
                f"{purpose} needs the package {package}: pip install {_wanted(package)}"
            )


def is_installed(package: str) -> bool:
    """Return whether a distribution is there."""
    try:
        metadata.version(package)
    except metadata.PackageNotFoundError:
        return False
    return True


def extra_of(requirement: Requirement) -> str:
    """Return the extra of clbench that a requirement belongs to, empty if it is always installed."""
    return str(requirement.marker).partition("==")[2].strip(" \"'") if requirement.marker else ""


def _wanted(package: str) -> str:
    """Return what to install to get a distribution: the extra of clbench that brings it, else itself."""
    for requirement in map(Requirement, metadata.requires("clbench") or []):
        if canonicalize_name(requirement.name) == canonicalize_name(package) and extra_of(
            requirement
        ) not in ("", "dev"):
            return f"'clbench[{extra_of(requirement)}]'"
    return package
