"""Installed packages: their versions, and the extras of clbench that bring optional ones."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from importlib import metadata
from importlib.util import find_spec

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from clbench.base.errors import MissingPackageError


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Return the version of each distribution, sorted by name.

    Raises:
        importlib.metadata.PackageNotFoundError: A distribution is not installed.
    """
    return {package: _version(package) for package in sorted(packages)}


@functools.cache  # parsing the metadata of a package takes 10 ms, and a run asks for about 70
def _version(package: str) -> str:
    return metadata.version(package)


def require(module: str, extra: str, purpose: str) -> None:
    """Check that an optional module is installed, before any work starts.

    Args:
        module: Module to be imported later.
        extra: Extra of clbench that brings the module.
        purpose: Purpose of the module, as the subject of a sentence in the message.

    Raises:
        MissingPackageError: The module is not installed; the message says how to get it.
    """
    if find_spec(module) is None:
        raise MissingPackageError(f"{purpose} needs the package {module}: pip install 'clbench[{extra}]'")


def require_packages(packages: Iterable[str], purpose: str) -> None:
    """Check that distributions are installed, before any work starts.

    Args:
        packages: Names of the distributions.
        purpose: Purpose of the distributions, as the subject of a sentence in the message.

    Raises:
        MissingPackageError: A distribution is not installed; the message says how to get it.
    """
    for package in sorted(packages):
        if not is_installed(package):
            raise MissingPackageError(
                f"{purpose} needs the package {package}: pip install {_wanted(package)}"
            )


def is_installed(package: str) -> bool:
    """Return whether a distribution is installed."""
    try:
        metadata.version(package)
    except metadata.PackageNotFoundError:
        return False
    return True


def extra_of(requirement: Requirement) -> str:
    """Return the extra of clbench that a requirement belongs to, empty if it is in none."""
    return str(requirement.marker).partition("==")[2].strip(" \"'") if requirement.marker else ""


def _wanted(package: str) -> str:
    """Return the argument of `pip install` for a distribution: its extra of clbench, else itself."""
    for requirement in map(Requirement, metadata.requires("clbench") or []):
        if canonicalize_name(requirement.name) == canonicalize_name(package) and extra_of(
            requirement
        ) not in ("", "dev"):
            return f"'clbench[{extra_of(requirement)}]'"
    return package
