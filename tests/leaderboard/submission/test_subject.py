"""Records of other machines than the verifier's."""

import platform
from pathlib import Path
from typing import Any

from verification import edit, verify


def test_other_rollouts_on_another_kind_of_machine_prove_nothing(mine: Path, honest: Path) -> None:
    verify(mine, "recomputed", honest)

    def moves_otherwise(values: dict[str, Any]) -> None:
        rollouts, definition = (values["fingerprint"][name] for name in ("rollouts", "definition"))
        rollouts |= dict.fromkeys(rollouts, "0" * 16)
        definition |= {"task left": "0" * 16}

    edit(mine, moves_otherwise)
    assert all(check.passed is not None for check in verify(mine, "recomputed", honest))
    edit(mine, lambda values: values["fingerprint"]["hardware"].update(machine="aarch64"))
    unsure = [check for check in verify(mine, "recomputed", honest) if not check.passed]
    assert [check.name for check in unsure] == ["simulator", "definition"]
    assert all(
        check.passed is None and f"machine aarch64, {platform.machine()} here" in check.found
        for check in unsure
    )
