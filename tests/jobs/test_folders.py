"""Folders that cannot be written to: named before work begins, and nothing is left in those that can."""

import re
from pathlib import Path

import pytest
from helpers import lose_home

from clbench.base.errors import InputError
from clbench.jobs.folders import absolute_places, check_folders
from clbench.records.paths import record_path


def test_folders_that_can_be_written_to_or_made_stay_as_they_are(empty_caches: Path) -> None:
    (empty_caches / "there").mkdir()
    check_folders(
        {"--records": empty_caches / "there", "--output": empty_caches / "a" / "b", "--write": None}
    )
    assert [path.name for path in empty_caches.rglob("*")] == ["there"]


@pytest.mark.parametrize("below", [".", "a/b"])
def test_a_link_that_leads_to_itself_is_named(below: str, empty_caches: Path) -> None:
    loop = empty_caches / "loop"
    loop.symlink_to(loop)
    folder = loop / below
    record_path(folder, "clbench/Toy-v0", "sft", 0)  # looks at links, and leaves this one to the check
    reason = "Too many levels of symbolic links"
    with pytest.raises(
        InputError, match=rf"--records {re.escape(str(folder))} cannot be written to: {reason}"
    ):
        check_folders({"--records": folder})


def test_only_places_that_are_set_are_made_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, place in (("HOME", "/home/me"), ("CLBENCH_CACHE", "~/c"), ("MINARI_DATASETS_PATH", "data")):
        monkeypatch.setenv(name, place)
    monkeypatch.setenv("XDG_CACHE_HOME", "")  # as if it was unset
    assert absolute_places() == {"CLBENCH_CACHE": "/home/me/c", "MINARI_DATASETS_PATH": f"{tmp_path}/data"}


def test_a_user_without_a_home_folder_is_told_which_folders_to_name(monkeypatch: pytest.MonkeyPatch) -> None:
    lose_home(monkeypatch)
    with pytest.raises(InputError, match=r"no home folder for ~/\.cache: set CLBENCH_CACHE and MINARI"):
        check_folders({})
