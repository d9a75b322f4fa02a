"""The bench of records for the tests of claims."""

from collections.abc import Callable
from pathlib import Path

import pytest
from claims_bench import Bench

from clbench.records.record import Record


@pytest.fixture
def bench(tmp_path: Path, make_record: Callable[..., Record]) -> Bench:
    return Bench(tmp_path, make_record)
