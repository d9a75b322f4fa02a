"""Paths of records: the folders that hold them, and the names of their files."""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from clbench.base.errors import InputError, NoRecordsError
from clbench.spec.identifiers import check_label, check_scenario_id, folder_name
from clbench.spec.policies import DEFAULT_POLICY, check_policy_name

RECORDS = Path("leaderboard/records")
"""Folder of the leaderboard's records, relative to the working directory."""

TUNING = Path("leaderboard/tuning")
"""Folder of the records of tuning runs, relative to the working directory."""


def check_folder(folder: Path) -> None:
    """Refuse a folder of records that does not exist.

    Raises:
        NoRecordsError: There is no such folder.
    """
    if not folder.is_dir():
        raise NoRecordsError(
            f"There is no folder of records at {folder}. `clbench run` makes records, and "
            "`clbench leaderboard --published` copies the published ones."
        )


def label_of(method: str, changes: Mapping[str, Any]) -> str:
    """Return the method with its changed hyper-parameters, for example "experience_replay+replay=0.02"."""
    return "+".join([method, *(f"{name}={value}" for name, value in sorted(changes.items()))])


def table_name(scenario: str, policy: str) -> str:
    """Return the name of a run's table: the scenario, with the name of any policy but the default.

    Example: "clbench/Fetch-v1+discrete_diffusion". Policies of different names never share a table.

    Args:
        scenario: Gymnasium id.
        policy: Name of the policy, see `clbench.spec.policies`.
    """
    return scenario if policy == DEFAULT_POLICY else f"{scenario}+{policy}"


def table_parts(table: str) -> tuple[str, str]:
    """Return the scenario and the name of the policy of a table's name, see `table_name`."""
    scenario, _, policy = table.partition("+")
    return scenario, policy or DEFAULT_POLICY


def record_name(scenario: str, label: str, seed: int, order: int = 0, policy: str = DEFAULT_POLICY) -> Path:
    """Return the path of a run's record, relative to the folder of records and unique to the run.

    Args:
        scenario: Gymnasium id.
        label: The method with its changed hyper-parameters, see `label_of`.
        seed: Seed of the run.
        order: Order in which the targets were learned; 0 is the published one.
        policy: Name of the policy, see `clbench.spec.policies`.

    Raises:
        InputError: A name is refused.
    """
    check_scenario_id(scenario)
    check_policy_name(policy)
    check_label(label)
    name = f"seed-{seed}-order-{order}.json" if order else f"seed-{seed}.json"
    return Path(folder_name(table_name(scenario, policy)), folder_name(label), name)


def record_path(
    records: Path, scenario: str, label: str, seed: int, order: int = 0, policy: str = DEFAULT_POLICY
) -> Path:
    """Return the path of a run's record below the folder `records`, see `record_name`.

    The folder of the same name without .json, which holds the policies or logs of the run, is also checked.

    Raises:
        InputError: A name is refused, or a symbolic link leads out of the folder.
    """
    path = records / record_name(scenario, label, seed, order, policy)
    for place in (path.parent, path.with_suffix("")):
        # a link to itself is left to the code that reads or writes there: `Path.resolve` would raise
        if not Path(os.path.realpath(place)).is_relative_to(os.path.realpath(records)):
            raise InputError(f"{place}: a symbolic link leads out of {records}.")
    return path


def stage_folder(root: Path, number: int) -> Path:
    """Return the folder below `root` of the policy after a stage; 0 is before the first target."""
    return root / f"stage-{number}"


def failed_name(path: Path) -> Path:
    """Return the path of the record of a failed run beside a record that stays: "seed-0.json.failed"."""
    return path.with_name(f"{path.name}.failed")


def free_name(path: Path, ending: str) -> Path:
    """Return a free path next to a record, to set it aside: "seed-0.json.old", or the same with a number.

    Args:
        path: Path of the record.
        ending: Suffix to its name. Readers of records ignore such names.
    """
    names = (path.with_name(f"{path.name}.{ending}{number or ''}") for number in itertools.count())
    return next(name for name in names if not os.path.lexists(name))
