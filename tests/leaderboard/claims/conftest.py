"""The bench of records for the tests of claims."""

from collections.abc import Callable
from pathlib import Path

import pytest
from claims_bench import Bench

from clbench.records.record import Record


@pytest.fixture
def bench(tmp_path: Path, make_record: Callable[..., Record], monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.setattr("clbench.leaderboard.claims.fast_dvla.read_decoding", lambda: None)
    return Bench(tmp_path, make_record)
