from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from agents import ID

from clbench.records.record import Record
from clbench.serving.score import score


@pytest.fixture
def run(tmp_path: Path, empty_caches: Path) -> Callable[..., Record]:
    """Return `score` for the method me/elsewhere on the toy, with records and caches for one test."""

    def run(policy: Any, stage: int, **options: Any) -> Record:
        return score(
            ID,
            policy,
            stage=stage,
            **{"method": "me/elsewhere", "records": tmp_path / "records", **options},
        )

    return run
