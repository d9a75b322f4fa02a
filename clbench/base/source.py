"""Hashes of source code for cache keys: a result is made again when the code that made it changes.

A key covers whole packages, with every package below them, and not single modules. A module that moves inside
its package therefore stays covered, and code that cannot change a result (the film maker, the command line)
stays out of the key. The code of users has no such order, so the files beside their modules count too if the
modules import them.

Comments, docstrings and blank lines of Python files do not count: editing them makes no result again.
"""

from __future__ import annotations

import ast
import dataclasses
import enum
import errno
import functools
import hashlib
import importlib.util
import os
import re
import stat
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path, PurePath
from types import CodeType, FunctionType
from typing import Any

DATA_SOURCES = ("clbench.base", "clbench.spec", "clbench.policy", "clbench.worlds", "clbench.data")
"""Code that demonstrations and questions depend on, besides the suite of their tasks."""

TRAINING_SOURCES = (*DATA_SOURCES, "clbench.learning")
"""Code that a pretrained policy depends on, besides the suites of its tasks and questions."""

RUN_SOURCES = (*TRAINING_SOURCES, "clbench.records", "clbench.evaluation", "clbench.runs")
"""Code that a run depends on, besides the suites of its tasks and the package of its method."""


def source_hash(*modules: str) -> str:
    """Return the hash of the code of `modules`.

    A package counts with all files below it, except for hidden ones such as those of editors. Outside of
    clbench, the files beside a module that it imports count too, directly or through other imports: files
    below the same folder on Python's path or, if the module is installed, files of its own top-level package.
    Imports are read, not run.

    Args:
        modules: Names of modules and packages, in any order.

    Raises:
        ModuleNotFoundError: A module does not exist. Its name must not be hashed in place of its source: the
            key would never change.
    """
    digest = hashlib.sha256()
    for module in sorted(set(modules)):
        origin = _origin(module)
        digest.update(module.encode())
        if origin is None:  # a class that was typed at a prompt has no source to read
            continue
        files = [origin]
        if origin.name == "__init__.py":
            # Python and numba keep compiled code in __pycache__, which would change the key during a run
            below = files_below(origin.parent)
            files = [one for one in below if one.parent.name != "__pycache__" and one.name[0] != "."]
        for path in [*files, *_imported_beside(module, origin, files)]:
            if path.is_file():
                digest.update(_file_hash(path, *_stamp(path)))
    return digest.hexdigest()[:16]


def files_below(folder: Path) -> list[Path]:
    """Return the regular files below a folder, in order.

    Raises:
        OSError: The file system refuses. (Since Python 3.12, `Path.rglob` leaves out what it cannot list.)
    """

    def refuse(error: OSError) -> None:
        raise error

    found = (Path(place, name) for place, _, names in os.walk(folder, onerror=refuse) for name in names)
    return sorted(filter(_is_regular, found))


def _is_regular(path: Path) -> bool:
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except OSError as error:
        if error.errno in (errno.ENOENT, errno.ENOTDIR, errno.ELOOP):  # a link that leads nowhere
            return False
        raise


def _stamp(path: Path) -> tuple[int, int]:
    """Return the time of a file's last change, in nanoseconds, and its size, in bytes."""
    status = path.stat()
    return status.st_mtime_ns, status.st_size


@functools.lru_cache(maxsize=4096)  # a run asks 20 times
def _file_hash(path: Path, changed: int, size: int) -> bytes:
    """Return the hash of a file; the time of its last change and its size tell versions of it apart."""
    content = path.read_bytes()
    return hashlib.sha256(_code(content) if path.suffix == ".py" else content).digest()


_TRIPLE = r"{0}{0}{0}[^{0}\\]*(?:(?:\\.|{0}(?!{0}{0}))[^{0}\\]*)*{0}{0}{0}"
_SINGLE = r"{0}(?!{0}{0})[^{0}\\\n]*(?:\\.[^{0}\\\n]*)*{0}"
_STRINGS = [kind.format(quote) for quote in "'\"" for kind in (_TRIPLE, _SINGLE)]
_PIECE = re.compile("|".join(["#[^\n]*", *_STRINGS, "['\"]"]), re.DOTALL)
"""A comment, a string without its prefix, or a quotation mark that begins none of these strings."""
_PREFIX = re.compile(r"(?<!\w)[A-Za-z]{1,2}\Z")
_REST = re.compile(r"[ \t\f]*(?:#|\n|\Z)")
"""What may follow a docstring on its last line."""


def _code(content: bytes) -> bytes:
    """Return a Python file without comments, docstrings and blank lines.

    A docstring is any statement that is only a string. The file is returned as it is if it cannot be parsed
    this way with certainty: it is not text, or a quotation mark or a brace has no partner, as in the strings
    inside formatted strings that Python 3.12 allows. This is so for 5 of 4,051 files of Python's library and
    six packages. For all others the bytes equal those from `tokenize`, in a tenth of the time.
    """
    try:
        text = content.decode().replace("\r\n", "\n")
    except UnicodeDecodeError:
        return content
    kept, end, depth = [], 0, 0
    for match in _PIECE.finditer(text):
        begin, between, piece = match.start(), text[end : match.start()], match.group()
        end = match.end()
        depth += sum(map(between.count, "([{")) - sum(map(between.count, ")]}"))
        if piece[0] == "#":
            kept.append(between.rstrip(" \t\f"))
            continue
        found = _PREFIX.search(between[-3:])
        prefix = found.group().lower() if found else ""
        formatted = "f" in prefix or "t" in prefix
        if len(piece) == 1 or (formatted and piece.count("{") != piece.count("}")):
            return content
        line = text.rfind("\n", 0, begin) + 1
        alone = text[line:begin].strip().lower() == prefix and _REST.match(text, end)
        continued = text.endswith("\\\n", 0, line)
        if alone and not (depth or formatted or continued):
            kept.append(between[: len(between) - len(prefix)])
        else:  # the zero byte, which no Python file may have, keeps the lines of a string together
            kept += [between, piece.replace("\n", "\0")]
    lines = "".join([*kept, text[end:]]).split("\n")
    return "\n".join(line for line in lines if line.strip()).replace("\0", "\n").encode()


def _origin(module: str) -> Path | None:
    """Return the file of a module, None if it has no file.

    Raises:
        ModuleNotFoundError: The module does not exist.
    """
    try:
        spec = importlib.util.find_spec(module)
    except ValueError:  # `__main__` has no spec; the file of a script on standard input is called <stdin>
        spec, file = None, getattr(sys.modules.get(module), "__file__", None)
        file = file if file is not None and Path(file).is_file() else None
    else:
        file = spec.origin if spec is not None else None
    if spec is None and module not in sys.modules:
        raise ModuleNotFoundError(
            f"There is no module {module!r}, whose source is part of a key.", name=module
        )
    return Path(file) if file is not None else None


def _imported_beside(module: str, origin: Path, files: Iterable[Path]) -> list[Path]:
    """Return the other files that the `files` of a module outside of clbench import, in a fixed order."""
    if module == "__main__":  # a script, or a module that `python -m` runs
        module = getattr(sys.modules[module].__spec__, "name", origin.stem)
    top, depth = module.partition(".")[0], module.count(".") + (origin.name == "__init__.py")
    folder = origin.parents[depth] if depth < len(origin.parents) else origin.parent
    if top == "clbench" or _file_below(folder, module) != origin:
        return []
    installed = folder.name in ("site-packages", "dist-packages")
    found: dict[Path, None] = dict.fromkeys(files)
    own, pending = len(found), [path for path in found if path.suffix == ".py"]
    while pending:
        path = pending.pop()
        for name in _imports(path, folder, *_stamp(path)):
            first = name.partition(".")[0]
            file = (
                _file_below(folder, name) if first == top or not (installed or first == "clbench") else None
            )
            if file is not None and file not in found:
                found[file] = None
                pending.append(file)
    return sorted(list(found)[own:])


def _file_below(folder: Path, module: str) -> Path | None:
    place = folder.joinpath(*module.split("."))
    return next((one for one in (place / "__init__.py", Path(f"{place}.py")) if one.is_file()), None)


@functools.lru_cache(maxsize=4096)
def _imports(path: Path, folder: Path, changed: int, size: int) -> tuple[str, ...]:
    """Return the names in a file's imports that may be modules, each with the packages that contain it."""
    try:
        tree = ast.parse(path.read_bytes())
    except (SyntaxError, ValueError):  # nobody can import it either; its bytes count
        return ()
    package = path.relative_to(folder).parent.parts
    names = [name for node in ast.walk(tree) for name in _imported_by(node, package)]
    return tuple(dict.fromkeys(".".join(name[:end]) for name in names for end in range(1, len(name) + 1)))


def _imported_by(node: ast.AST, package: Sequence[str]) -> Iterator[list[str]]:
    """Yield the parts of the names that an import in a module of `package` asks for."""
    if isinstance(node, ast.Import):
        yield from (alias.name.split(".") for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        start = package[: len(package) - node.level + 1] if node.level else ()
        base = [*start, *(node.module.split(".") if node.module else ())]
        yield from ([*base, alias.name] for alias in node.names)


def class_hash(cls: type) -> str:
    """Return the hash of the code and the plain values of a class that was typed at a prompt.

    Code outside the class that its methods call does not count.
    """
    digest = hashlib.sha256()
    for name, value in sorted(vars(cls).items()):
        functions = list(functions_behind(value))
        if functions or not name.startswith("__"):
            try:
                text = _text_of([*functions, value], {})
            except RecursionError:  # a chain of hundreds of values
                text = type(value).__qualname__
            digest.update(f"{name} {text}".encode())
    return digest.hexdigest()[:16]


def functions_behind(value: object) -> Iterator[FunctionType]:
    """Yield the functions of an attribute of a class, with those that a descriptor or a decorator holds."""
    todo, seen = [value], {}
    while todo:
        one = todo.pop()
        if id(one) in seen:  # a function may name itself as what it wraps
            continue
        seen[id(one)] = one
        if isinstance(one, FunctionType):
            yield one
        todo += _held_by(one)


def _held_by(value: object) -> Sequence[object]:
    if isinstance(value, property):
        return value.fget, value.fset, value.fdel
    if isinstance(value, functools.singledispatchmethod):
        return tuple(value.dispatcher.registry.values())
    if isinstance(value, functools.cached_property | functools.partialmethod | functools.partial):
        return (value.func,)
    if isinstance(value, staticmethod | classmethod):
        return (value.__func__,)
    # not getattr: some objects have every attribute
    return (_own(value).get("__wrapped__"),)


def _own(value: object) -> dict[str, Any]:
    """Return the attributes of an object of its own; none of a class, or of an object with slots."""
    found = getattr(value, "__dict__", None)
    return found if isinstance(found, dict) else {}


def _text_of(value: object, seen: dict[int, object]) -> str:
    """Return code or a plain value as text that is the same in each process, without line numbers.

    Args:
        value: Of an object that is neither code nor a plain value, the text is its type.
        seen: Parts of values so far, by id: each is told once, and one that holds itself has an end.
    """
    if isinstance(value, enum.Enum):
        return f"{type(value).__qualname__}.{value.name}"
    for kind in (bool, int, float, complex, str, bytes):
        if isinstance(value, kind):
            return kind.__repr__(value)  # a subclass may have an address in its own
    if value is None or isinstance(value, PurePath):
        return str(value)
    if isinstance(value, type):
        return value.__qualname__
    if id(value) in seen:
        return f"#{list(seen).index(id(value))}"
    parts = _parts_of(value)
    seen[id(value)] = value, parts  # they stay alive, so that no other gets their ids
    told = [_text_of(one, seen) for one in parts]
    if isinstance(value, set | frozenset):  # it has another order in each process
        told.sort()
    return f"{type(value).__qualname__}[{', '.join(told)}]"


def _parts_of(value: object) -> list[Any]:
    if isinstance(value, CodeType):
        return [value.co_code, value.co_names, value.co_consts]
    if isinstance(value, FunctionType):
        return [value.__code__, value.__defaults__, value.__kwdefaults__]
    if isinstance(value, functools.partialmethod | functools.partial):
        return [value.func, value.args, value.keywords]
    if isinstance(value, dict):
        return list(value.items())
    if dataclasses.is_dataclass(value):
        return [_own(value).get(one.name) for one in dataclasses.fields(value)]
    return list(value) if isinstance(value, tuple | list | set | frozenset) else []


def names_in(code: CodeType) -> set[str]:
    """Return the names of attributes and global variables that code and the functions inside it use.

    A comprehension is a function of its own in Python 3.11, but not in 3.12.
    """
    inside = (names_in(constant) for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*inside)


def has_source(module: str) -> bool:
    """Return whether a module has a file; the module of an interactive prompt has none."""
    return _origin(module) is not None


def package_of(entry_point: str) -> str:
    """Return the package of "package.module:attribute", or the module if it is in no package."""
    module = entry_point.partition(":")[0]
    package = module.rpartition(".")[0]
    try:
        return package if package and _origin(package) is not None else module
    except ModuleNotFoundError:  # a class whose `__module__` was set by hand is in no package
        return module
