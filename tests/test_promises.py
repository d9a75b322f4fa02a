"""What releases promise, on the page of versions: a change of a promise is seen before it is made."""

from pathlib import Path

from promised import promises

PROMISED = Path(__file__).with_name("promised.txt")


def test_names_commands_scenarios_methods_and_metrics_are_those_that_releases_promise() -> None:
    """Added lines belong into the file; a line that is gone breaks a promise of docs/guide/versions.md."""
    found, stated = set(promises()), set(PROMISED.read_text(encoding="utf-8").splitlines())
    assert sorted(stated - found) == [], "a promise is broken"
    assert sorted(found - stated) == [], "run `python tests/shared/promised.py > tests/promised.txt`"
