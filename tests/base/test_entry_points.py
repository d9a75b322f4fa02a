"""Entry points: an object by name, and errors that name the fault of a module."""

from collections.abc import Callable

import pytest

from clbench.base.entry_points import import_module, resolve
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


def test_an_error_inside_a_third_party_module_is_one_line_that_names_it(
    write_module: Callable[[str, str], None],
) -> None:
    write_module("faulty_module", "raise ValueError('nothing works')")
    message = "'faulty_module' cannot be imported for 'x': ValueError: nothing works"
    with pytest.raises(InputError, match=message):
        import_module("faulty_module", "x")


def test_a_script_that_exits_is_no_end_of_the_command(write_module: Callable[[str, str], None]) -> None:
    write_module("exiting_module", "import sys; sys.exit(3)")
    with pytest.raises(InputError, match="'exiting_module' cannot be imported for 'x': SystemExit: 3"):
        import_module("exiting_module", "x")
