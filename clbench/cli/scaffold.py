"""The commands `clbench new-method` and `new-policy`: a commented template on one page, and its test."""

from __future__ import annotations

import keyword
import re
import shlex
from importlib.util import find_spec
from pathlib import Path

from rich.console import Console

from clbench.base.errors import InputError
from clbench.base.text import print_plain, quoted
from clbench.cli.arguments import checked_input, checked_writing
from clbench.spec.identifiers import built_in_methods, check_method_name
from clbench.spec.policies import POLICIES

_TEMPLATES = Path(__file__).with_name("templates")

_METHOD_TEST = '''"""method_template keeps the contract of clbench."""

from clbench.testing import check_method

from method_template import MethodTemplate


def test_method_template_keeps_the_contract() -> None:
    check_method(MethodTemplate)
'''

_POLICY_TEST = '''"""policy_template keeps the contract of clbench."""

from clbench.testing import check_policy


def test_policy_template_keeps_the_contract() -> None:
    check_policy("policy_template:PolicyTemplate")
'''


def new_method(name: str, /, *, folder: Path = Path()) -> None:
    """Write NAME.py, a commented template of a method, and test_NAME.py.

    Args:
        name: Name of the module; the name of the class follows from it.
        folder: Existing folder for both files; no file in it is overwritten.
    """
    with checked_input():
        files = write_method(name, folder)
    _print_next("method", files, folder, f"clbench submit {name}:{class_name(name)}")


def new_policy(name: str, /, *, folder: Path = Path()) -> None:
    """Write NAME.py, a commented template of a policy, and test_NAME.py.

    Args:
        name: Name of the module; the name of the class follows from it.
        folder: Existing folder for both files; no file in it is overwritten.
    """
    with checked_input():
        files = write_policy(name, folder)
    command = f"clbench run clbench/Fetch-v1 sft --policy {name}:{class_name(name)}"
    _print_next("policy", files, folder, command)


def _print_next(kind: str, files: tuple[Path, Path], folder: Path, command: str) -> None:
    module, test = files
    lines = [f"Wrote {module} and {test}. Edit the {kind}, then run:"]
    lines += [f"  cd {shlex.quote(str(folder))}"] if folder != Path() else []
    lines += [f"  python -m pytest {test.name}  # pip install pytest", f"  {command}"]
    print_plain(Console(), "\n".join(lines))


def write_method(name: str, folder: Path) -> tuple[Path, Path]:
    """Write `name`.py, a method, and its test to `folder`, both or neither, and return their paths.

    Args:
        name: Name of the module.
        folder: An existing folder; no file in it is overwritten.

    Raises:
        InputError: The name is refused, or a file exists already or cannot be written.
    """
    if name in built_in_methods():
        raise InputError(f"{name!r} is a built-in method. Did you mean {f'my_{name}'!r}?")
    return _write("method", name, folder, _METHOD_TEST)


def write_policy(name: str, folder: Path) -> tuple[Path, Path]:
    """Write `name`.py, a policy, and its test to `folder`; `write_method` says what is refused."""
    if name in POLICIES:
        raise InputError(f"{name!r} is a built-in policy. Did you mean {f'my_{name}'!r}?")
    return _write("policy", name, folder, _POLICY_TEST)


def _write(kind: str, name: str, folder: Path, test: str) -> tuple[Path, Path]:
    check_new_name(name, kind)
    template = (_TEMPLATES / f"{kind}_template.py").read_text(encoding="utf-8")
    texts = {folder / f"{name}.py": template, folder / f"test_{name}.py": test}
    made: list[Path] = []
    try:
        for path, text in texts.items():
            with checked_writing(path), path.open("x", encoding="utf-8", newline="\n") as file:
                made.append(path)
                named = text.replace(f"{kind}_template", name)
                file.write(named.replace(f"{kind.capitalize()}Template", class_name(name)))
    except BaseException:
        for path in made:
            path.unlink()
        raise
    first, second = texts
    return first, second


def class_name(name: str) -> str:
    """Return the name of the class in the module `name`, for example "MyMethod" in my_method."""
    return "".join(word.capitalize() for word in name.split("_"))


def check_new_name(name: str, kind: str) -> None:
    """Refuse a name that the module of a new method or policy, its `kind`, cannot have.

    Raises:
        InputError: The name is taken, too like another, or not valid for a module; the message shows which.
    """
    if not re.fullmatch("[a-z][a-z0-9_]{0,49}", name):
        words = re.sub(r"\W+|(?<=[a-z0-9])(?=[A-Z])", "_", name, flags=re.ASCII).lower()
        near = words.lstrip("_0123456789").rstrip("_")
        hint = f" Did you mean {near!r}?" if re.fullmatch("[a-z][a-z0-9_]{0,49}", near) else ""
        raise InputError(
            f"{quoted(name)} cannot be the name of a module: it must begin with a letter, and have at most "
            f"50 lowercase letters, digits and _.{hint}"
        )
    word = next(filter(keyword.iskeyword, (name, class_name(name))), None)
    if word is not None:
        raise InputError(f"{word!r} is a Python keyword. Did you mean {f'{name}_{kind}'!r}?")
    check_method_name(name)
    if find_spec(name) is not None:
        raise InputError(f"A module named {name!r} already exists. Did you mean {f'{name}_{kind}'!r}?")
