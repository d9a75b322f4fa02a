"""Side effects of code: which files count, and what a hook does once in a process."""

import dataclasses
import functools
import os
from collections.abc import Iterable
from pathlib import Path

import pytest
import torch
from torch import nn

from clbench.base.cache import cache_folder
from clbench.learning.method import Method, Stage
from clbench.policy.policy import Policy
from clbench.testing import ContractError, method_checks
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


def test_a_file_that_gets_its_name_at_the_end_counts_and_so_does_a_new_folder(tmp_path: Path) -> None:
    found: list[str] = []
    with watched(found, generators=False):
        Path(tmp_path, "unfinished").touch()
        Path(tmp_path, "unfinished").replace(tmp_path / "whole.txt")
        Path(tmp_path, "new").mkdir()
        tmp_path.mkdir(exist_ok=True)
        cache_folder().mkdir(parents=True, exist_ok=True)
    whole, new = tmp_path / "whole.txt", tmp_path / "new"
    assert found == [f"the file {whole} is written", f"the folder {new} is written"]


def test_the_compiled_form_of_an_imported_module_does_not_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Path(tmp_path, "imported_in_a_hook.py").write_text("value = 1\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("sys.dont_write_bytecode", False)
    monkeypatch.setattr("sys.pycache_prefix", None)
    found: list[str] = []
    with watched(found, generators=False):
        __import__("imported_in_a_hook")
    assert Path(tmp_path, "__pycache__").is_dir()
    assert found == []


@functools.cache
def configure() -> None:
    """Set the number of threads, once in a process."""
    torch.set_num_threads(torch.get_num_threads() + 1)


@dataclasses.dataclass
class Configures(Method):
    """Configures PyTorch at the first use."""

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        configure()
        return policy.parameters()


@pytest.mark.long
def test_a_setting_that_a_hook_changes_once_in_a_process_counts() -> None:
    configure.cache_clear()
    (check,) = (check for check in method_checks(Configures) if str(check) == "global_state")
    with pytest.raises(ContractError, match=r"after start_task\(\) torch\.get_num_threads\(\) is"):
        check()
