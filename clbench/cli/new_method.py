"""A new method: a commented template of a page, and its test."""

from __future__ import annotations

import keyword
import re
from importlib.util import find_spec
from pathlib import Path

from clbench.base.errors import InputError
from clbench.base.strict_json import quoted
from clbench.spec.identifiers import built_in_methods, check_method_name

_TEMPLATE = Path(__file__).with_name("method_template.py")

_TEST = '''"""method_template keeps the contract of clbench."""

from clbench.testing import check_method

from method_template import MethodTemplate


def test_method_template_keeps_the_contract() -> None:
    check_method(MethodTemplate)
'''


def write_method(name: str, folder: Path) -> tuple[Path, Path]:
    """Write `name`.py and its test to `folder`, both or neither, and return their paths.

    Args:
        name: Of the module.
        folder: An existing folder; no file in it is overwritten.

    Raises:
        ValueError: The name is refused, or a file is there already or cannot be written.
    """
    check_new_name(name)
    texts = {folder / f"{name}.py": _TEMPLATE.read_text(encoding="utf-8"), folder / f"test_{name}.py": _TEST}
    made: list[Path] = []
    try:
        for path, text in texts.items():
            with path.open("x", encoding="utf-8", newline="\n") as file:
                made.append(path)
                file.write(text.replace("method_template", name).replace("MethodTemplate", class_name(name)))
    except BaseException as error:
        for path in made:
            path.unlink()
        if isinstance(error, OSError):
            raise InputError(f"{error.filename} cannot be written: {error.strerror}.") from error
        raise
    module, test = texts
    return module, test


def class_name(name: str) -> str:
    """Return the name of the class in the module `name`, as "MyMethod" in my_method."""
    return "".join(word.capitalize() for word in name.split("_"))


def check_new_name(name: str) -> None:
    """Refuse a name that a new method's module cannot have.

    Raises:
        ValueError: It is no name of a module, or one that is taken or can be mistaken; the message says why.
    """
    if not re.fullmatch("[a-z][a-z0-9_]{0,49}", name):
        near = re.sub(r"\W+|(?<=[a-z0-9])(?=[A-Z])", "_", name, flags=re.ASCII).lower().strip("_0123456789")
        hint = f" Did you mean {near!r}?" if re.fullmatch("[a-z][a-z0-9_]{0,49}", near) else ""
        raise InputError(
            f"{quoted(name)} cannot be the name of a module: it must have at most 50 small letters, digits "
            f"and _, a letter first.{hint}"
        )
    if keyword.iskeyword(name):
        raise InputError(f"{name!r} is a word of Python. Did you mean {f'{name}_method'!r}?")
    if name in built_in_methods():
        raise InputError(f"{name!r} is a built-in method. Did you mean {f'my_{name}'!r}?")
    check_method_name(name)
    if find_spec(name) is not None:
        raise InputError(f"There is a module {name!r} already. Did you mean {f'{name}_method'!r}?")
