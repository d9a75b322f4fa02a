"""The guide to policies from elsewhere: its server and its commands run as they are written."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from agents import ID
from helpers import blocks_of
from served import SERVER

PAGE = Path(__file__).parents[2] / "docs" / "guide" / "external.md"


@pytest.mark.slow
def test_the_policy_of_the_page_is_served_and_scored_by_its_commands(
    tmp_path: Path, empty_caches: Path
) -> None:
    shutil.copy(SERVER, tmp_path / "server.py")
    program = blocks_of(PAGE, "python")[0].replace("8, 4)", "8, 2)").replace("port=8000", "port=0")
    (tmp_path / "serve_policy.py").write_text(program, encoding="utf-8")
    with subprocess.Popen(
        [sys.executable, "serve_policy.py"], cwd=tmp_path, stdout=subprocess.PIPE, text=True
    ) as server:
        try:
            assert server.stdout is not None
            address = server.stdout.readline().split()[-1]
            for stage, shown in enumerate(blocks_of(PAGE, "console")):
                command = shown.replace("clbench/Fetch-v1", ID).replace("ws://localhost:8000", address)
                done = subprocess.run(
                    f"{sys.executable} -m {command}",
                    shell=True,
                    cwd=tmp_path,
                    env=dict(os.environ),
                    check=False,
                    capture_output=True,
                    text=True,
                )
                assert f"stage {stage}: left 0.00" in done.stderr, done.stderr
        finally:
            server.kill()
