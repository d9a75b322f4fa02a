"""The tests of faults print their counts at the end, as what they tried is as telling as that they passed."""

import pytest


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
