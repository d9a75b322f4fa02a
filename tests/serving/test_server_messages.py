"""Messages of a few bytes that stand for more than the largest message could hold."""

import numpy as np
import pytest

from clbench.serving.server import pack, unpack


@pytest.mark.parametrize(
    ("value", "fault"),
    [
        ({b"__npgeneric__": True, b"data": 10**6, b"dtype": "|S1"}, r"type \|S1 must be bytes, not int"),
        (
            {b"__npgeneric__": True, b"data": np.int64(10**6), b"dtype": "|S1"},
            r"type \|S1 must be bytes, not int64",
        ),
        (
            {b"__ndarray__": True, b"data": b"", b"dtype": "<f4", b"shape": [2**16 + 1, 0]},
            r"cannot have the shape \[65537, 0\]",
        ),
    ],
    ids=["a number", "a number of NumPy", "rows"],
)
def test_a_short_message_with_gigabytes_or_endless_rows_is_refused(value: object, fault: str) -> None:
    with pytest.raises(ValueError, match=f"not a valid message: .*{fault}"):
        unpack(pack({"state": value}))


def test_bytes_and_rows_without_numbers_come_back() -> None:
    found = unpack(pack({"name": np.bytes_(b"policy"), "state": np.zeros((2**16, 0), np.float32)}))
    assert (found["name"], found["state"].shape) == (b"policy", (2**16, 0))
