"""Continual-learning benchmark for robot policies: what a fine-tuned policy learned, and what it forgot."""

import os
import signal
import sys

if signal.getsignal(signal.SIGINT) is signal.default_int_handler and (
    os.path.basename(sys.argv[0]) in ("clbench", "clbench.exe")
    or (sys.argv[0] == "-m" and "-m clbench" in " ".join(sys.orig_argv))
):
    # This is the command `clbench`, not a program that uses the package: Ctrl-C during the imports below ends
    # it without a traceback, before `clbench.cli.entry` takes over.
    signal.signal(signal.SIGINT, lambda *_: os._exit(130))

import importlib
from importlib.metadata import version
from pathlib import Path

import lazy_loader

__version__ = version("clbench")

# The front door: `__init__.pyi` says where each public name is defined. A name is imported when first used, so
# that `import clbench`, which registers the scenarios, imports neither PyTorch nor MuJoCo.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# A wheel has envs/, methods/ and leaderboard/ inside this directory, a checkout beside it.
_HERE = Path(__file__).resolve().parent
if not (_HERE / "envs").is_dir():
    __path__.append(str(_HERE.parent))

importlib.import_module("clbench.envs")  # registers the scenarios with Gymnasium
