"""Policies that a separate program serves, from a copy of `clbench/serving/server.py` alone."""

import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from clbench.serving import server

SERVER = Path(server.__file__)

POLICY = '''
"""Policies of the toy after each stage: they forget "left" when they learn "right"."""

import numpy as np

DIRECTIONS = {"left": (-1, 0), "up": (0, 1), "right": (1, 0), "down": (0, -1)}
LEARNED = [["left", "up"], ["up", "right"], ["up", "right", "down"]]
CHUNK = 3


def policy_of(stage):
    def act(observations):
        chunks = np.zeros((len(observations["state"]), CHUNK, 2), np.float32)
        for row, words in enumerate(observations["instruction"]):
            noise = np.random.default_rng([observations["seed"][row], observations["step"][row]])
            direction = sum(np.array(DIRECTIONS[w]) for w in words.split() if w in LEARNED[stage])
            chunks[row] = direction + 0.4 * noise.standard_normal((CHUNK, 2)) * observations["state"][row, 2:]
        return chunks

    return act
'''

PROGRAM = """
import sys
sys.modules["clbench"] = None  # nothing can import it
sys.path.insert(0, sys.argv[1])
from policy import policy_of
from server import serve
serve(policy_of(int(sys.argv[2])), port=int(sys.argv[3]), metadata={"stage": int(sys.argv[2])})
"""


def write_policy(folder: Path) -> Callable[[int], Any]:
    """Write the policies and the server into a folder, and return `policy_of`, for this process."""
    path = folder / "policy.py"
    path.write_text(POLICY, encoding="utf-8")
    shutil.copy(SERVER, folder / "server.py")
    spec = importlib.util.spec_from_file_location("toy_policy", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    policy_of: Callable[[int], Any] = module.policy_of
    return policy_of


@contextmanager
def serving(folder: Path, stage: int, port: int = 0) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """Serve the policy of a stage from a process of its own, and yield its address and the process."""
    command = [sys.executable, "-I", "-c", PROGRAM, str(folder), str(stage), str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line.startswith("Serving a policy on ws://localhost:"), line
            yield line.split()[-1], process
        finally:
            process.kill()
