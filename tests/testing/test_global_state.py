"""Side effects of code: which files count."""

import os
from pathlib import Path

from clbench.base.cache import cache_folder
from clbench.testing.global_state import watched


def test_a_file_that_stays_counts_and_what_silences_a_library_does_not(tmp_path: Path) -> None:
    found: list[str] = []
    cache_folder().mkdir(parents=True, exist_ok=True)
    with watched(found, generators=False):
        Path(os.devnull).write_text("a library's words", encoding="utf-8")
        Path(cache_folder(), "mine.txt").write_text("in the cache", encoding="utf-8")
        Path(tmp_path, "gone.txt").touch()
        Path(tmp_path, "gone.txt").unlink()
        Path(tmp_path, "stays.txt").touch()
    Path(cache_folder(), "mine.txt").unlink()
    assert found == [f"the file {tmp_path / 'stays.txt'} is written"]
