"""What the tests of faults share, and their counts: what they tried tells as much as that they passed."""

from collections.abc import Iterator
from pathlib import Path

import fault_server
import pytest
from fault_server import Runs


@pytest.fixture(scope="session")
def runs() -> Iterator[Runs]:
    with fault_server.start() as runs:
        yield runs


@pytest.fixture(scope="session")
def whole(runs: Runs, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """Return the folder of an undisturbed run, which no test changes, and the number of its operations."""
    folder = tmp_path_factory.mktemp("whole")
    count, end = runs.do(folder)
    assert end == "success"
    assert count is not None
    return folder, count


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print what the tests of this folder counted."""
    counted = [
        (report.nodeid.rpartition("::")[2], counts)
        for report in terminalreporter.stats.get("passed", [])
        for name, counts in report.user_properties
        if name == "counts"
    ]
    if counted:
        terminalreporter.section("faults")
        for test, counts in sorted(counted):
            terminalreporter.line(f"{test}: {', '.join(f'{name} {n}' for name, n in sorted(counts.items()))}")
