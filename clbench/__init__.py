"""Continual-learning benchmark for robot policies: what a fine-tuned policy learned, and what it forgot."""

import importlib
from importlib.metadata import version
from pathlib import Path
from typing import Any

import lazy_loader

__version__ = version("clbench")

# The front door: `__init__.pyi` says where each public name is defined. A name is imported when first used,
# so that `import clbench`, which registers the scenarios, imports neither PyTorch nor MuJoCo.
_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    value = _load(name)
    if not isinstance(value, type):
        return value
    from clbench.base.text import with_fields

    return with_fields(value)


# A wheel has envs/, methods/ and leaderboard/ inside this directory, a checkout beside it.
_HERE = Path(__file__).resolve().parent
if not (_HERE / "envs").is_dir():
    __path__.append(str(_HERE.parent))

importlib.import_module("clbench.envs")  # registers the scenarios with Gymnasium
