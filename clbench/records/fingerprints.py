"""The fingerprint of a record, compared with another version of its scenario, packages or machine."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

LATER = "rule "
"""Prefix of the names of parts that the first definitions lacked."""


def other_parts(recorded: Any, known: Mapping[str, str]) -> list[str]:
    """Return the parts of the definition `known` that `recorded` defines differently.

    Args:
        recorded: `fingerprint["definition"]` of a record, which a stranger may have written. None in a record
            that is older than definitions: it is not known to differ.
        known: The definition to compare with, which names all parts. Parts of `LATER` that one of the two
            lacks are not known to differ.
    """
    if recorded is None:
        return []
    if not isinstance(recorded, dict):
        return ["the tasks themselves"]
    later = {name for name in recorded.keys() ^ known.keys() if name.startswith(LATER)}
    if recorded.keys() - known.keys() - later:
        return ["the tasks themselves"]
    return [name for name in known if name not in later and recorded.get(name) != known[name]]


def other_versions(recorded: Any, installed: Mapping[str, str]) -> list[str]:
    """Return in words which packages have other versions than in a record: "mujoco was 3.1 and is 3.2".

    Args:
        recorded: `fingerprint["versions"]` of a record, which a stranger may have written. A package that it
            lacks is not known to differ.
        installed: Versions by package.
    """
    before = recorded if isinstance(recorded, dict) else {}
    return [
        f"{name} was {before[name]} and is {version}"
        for name, version in installed.items()
        if before.get(name, version) != version
    ]


def machine_of(fingerprint: Mapping[str, Any]) -> str | None:
    """Return the kind of processor in a fingerprint, None if it names no known kind.

    MuJoCo's builds for ARM fuse multiplications and additions, so that some worlds move differently there.
    """
    hardware = fingerprint.get("hardware")
    found = hardware.get("machine") if isinstance(hardware, dict) else None
    return found if found in ("x86_64", "AMD64", "aarch64", "arm64") else None
