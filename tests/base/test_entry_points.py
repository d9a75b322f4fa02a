"""Entry points: an object by name, and errors that name the fault of a module."""

from collections.abc import Callable
from pathlib import Path

import pytest

from clbench.base.entry_points import class_hint, import_module, resolve
from clbench.base.errors import InputError, UnknownNameError


def test_an_entry_point_names_an_object() -> None:
    assert resolve("clbench.base.entry_points:resolve") is resolve


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("clbench.base.entry_points:resolv", "Did you mean 'resolve'"),
        ("clbench.no.such:thing", "No module 'clbench.no'"),
        (":thing", "No module ''"),
        ("mine.py:Mine", "Did you mean 'mine:Mine'"),
        ("./methods/mine.py:Mine", "Did you mean 'methods.mine:Mine'"),
    ],
)
def test_a_wrong_name_is_refused_with_the_nearest_one(name: str, message: str) -> None:
    with pytest.raises(UnknownNameError, match=message):
        resolve(name)


def test_a_misspelt_module_is_refused_with_the_nearest_one(
    write_module: Callable[[str, str], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_module("my_robots_policy", "")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        UnknownNameError, match=r"No module 'my_robot_policy' .* Did you mean 'my_robots_policy'"
    ):
        resolve("my_robot_policy:Mine")


def test_a_module_of_another_folder_is_refused_with_the_folder_that_lacks_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(UnknownNameError, match=f"No installed package .* and no file in {tmp_path}"):
        resolve("qqzzqqzz:Mine")


def test_a_missing_package_of_a_module_is_not_looked_for_among_files(
    write_module: Callable[[str, str], None],
) -> None:
    write_module("needing_module", "import qqzzqqzz")
    with pytest.raises(
        UnknownNameError, match=r"No module 'qqzzqqzz' can be imported for 'needing_module:Mine'\.$"
    ):
        resolve("needing_module:Mine")


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("my_module.py", "a class of this file, as 'my_module:Class'"),
        ("./lab/my_module.py", "a class of this file, as 'lab.my_module:Class'"),
        ("my_module.Mine", "'my_module:Mine'"),
        ("lab.my_module", "a class of this module, as 'lab.my_module:Class'"),
        ("my_module", "a class of this module, as 'my_module:Class'"),
    ],
)
def test_a_file_or_module_is_answered_with_the_form_of_a_class(
    name: str, hint: str, write_module: Callable[[str, str], None]
) -> None:
    write_module("my_module", "raise AssertionError('nothing is imported')")
    assert class_hint(name) == f" Did you mean {hint}?"


@pytest.mark.parametrize("name", ["no_module_of_this_name", "two words", "", "ws://a.B:1"])
def test_other_texts_get_no_hint(name: str) -> None:
    assert class_hint(name) == ""


def test_an_error_inside_a_third_party_module_is_one_line_that_names_it(
    write_module: Callable[[str, str], None],
) -> None:
    write_module("faulty_module", "raise ValueError('nothing works')")
    message = "'faulty_module' cannot be imported for 'x': ValueError: nothing works"
    with pytest.raises(InputError, match=message):
        import_module("faulty_module", "x")


def test_an_import_error_with_a_text_of_its_own_keeps_it(write_module: Callable[[str, str], None]) -> None:
    write_module("old_package", "raise ModuleNotFoundError('flash_attn is too old')")
    with pytest.raises(InputError, match="'x': ModuleNotFoundError: flash_attn is too old"):
        import_module("old_package", "x")


def test_a_script_that_exits_is_no_end_of_the_command(write_module: Callable[[str, str], None]) -> None:
    write_module("exiting_module", "import sys; sys.exit(3)")
    with pytest.raises(InputError, match="'exiting_module' cannot be imported for 'x': SystemExit: 3"):
        import_module("exiting_module", "x")
