"""Installed packages: their versions, and the extras of clbench that bring optional ones."""

from __future__ import annotations

import functools
import platform
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
            raise MissingPackageError(f"{purpose} needs the package {package}{_way_to(package)}")


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


def is_for_this_python(requirement: Requirement) -> bool:
    """Return whether clbench has a requirement, or one of an extra, with this version of Python."""
    return requirement.marker is None or requirement.marker.evaluate({"extra": extra_of(requirement)})


def _way_to(package: str) -> str:
    """Return how to get a distribution, as the end of a sentence: by its extra of clbench, or by itself."""
    for requirement in map(Requirement, metadata.requires("clbench") or []):
        if canonicalize_name(requirement.name) != canonicalize_name(package):
            continue
        if not is_for_this_python(requirement):
            here = platform.python_version()
            return f", which clbench uses only where {requirement.marker}: this is Python {here}"
        if extra_of(requirement) not in ("", "dev"):
            return f": pip install 'clbench[{extra_of(requirement)}]'"
    return f": pip install {package}"
