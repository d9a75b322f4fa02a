"""A record for the tests of reading and writing."""

from collections.abc import Callable

import pytest

from clbench.records.record import Record


@pytest.fixture
def record(make_record: Callable[..., Record]) -> Record:
    """A run of one target, with answers and the sparsity of its update."""
    return make_record(
        [[1.0, 0.0, 0.0], [0.5, 1.0, 0.0]],
        answers={(0, "left"): (10, 9), (1, "left"): (10, 8)},
        sparsity=[[0.9, 0.8, 0.7, 0.6]],
    )
