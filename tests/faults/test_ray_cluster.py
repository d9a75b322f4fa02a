"""A Ray cluster that loses one part after another: the records still equal those of one machine."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest

TOY = "clbench.testing:clbench/Toy-v0"
METHODS = ("sft", "lora", "experience_replay")
SEEDS = 4

# Ray leaves a socket and a log file to the garbage collector
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::ResourceWarning")]


def _command(records: Path, *options: str) -> list[str]:
    runs = [sys.executable, "-m", "clbench", "run", TOY, *METHODS, "--seeds", str(SEEDS)]
    return [*runs, "--records", str(records), *options]


@contextmanager
def _cluster() -> Iterator[Any]:
    """Start a cluster of a head without cores and a node with two."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    cluster.add_node(num_cpus=2)
    try:
        yield cluster
    finally:
        cluster.shutdown()


def _kill(processes: list[psutil.Process]) -> None:
    assert processes
    for process in processes:
        process.kill()


def _ray_processes(name: str) -> list[psutil.Process]:
    """Return the processes of this user's Ray whose title has a name in it."""
    found = []
    for process in psutil.process_iter(["cmdline"]):
        if any(part.startswith("ray::") and name in part for part in process.info["cmdline"] or ()):
            found.append(process)
    return found


def _lose_worker(cluster: Any, driver: subprocess.Popen[str]) -> None:
    _kill(_ray_processes("_do")[:1])


def _lose_actor(cluster: Any, driver: subprocess.Popen[str]) -> None:
    _kill(_ray_processes("_ProgressActor"))


def _lose_agent(cluster: Any, driver: subprocess.Popen[str]) -> None:
    """Kill what speaks for the node, and with it the node; another one joins."""
    (node,) = cluster.worker_nodes
    cluster.add_node(num_cpus=2)
    cluster.remove_node(node, allow_graceful=False)


def _lose_head(cluster: Any, driver: subprocess.Popen[str]) -> None:
    cluster.head_node.kill_gcs_server(check_alive=False)


def _lose_driver(cluster: Any, driver: subprocess.Popen[str]) -> None:
    os.kill(driver.pid, signal.SIGKILL)


LOSSES = {
    "worker": _lose_worker,
    "actor": _lose_actor,
    "agent": _lose_agent,
    "head": _lose_head,
    "driver": _lose_driver,
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the records of one machine."""
    records = tmp_path_factory.mktemp("whole") / "records"
    subprocess.run(_command(records), check=True, capture_output=True)
    return records


@pytest.mark.parametrize("lost", LOSSES)
def test_a_cluster_that_loses_a_part_ends_with_the_records_of_one_machine(
    lost: str, whole: Path, tmp_path: Path, lasting_records: Callable[[Path], dict[str, Any]]
) -> None:
    records = tmp_path / "records"
    with _cluster() as cluster:
        driver = subprocess.Popen(
            _command(records, "--ray", cluster.address),
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        deadline = time.monotonic() + 200
        while time.monotonic() < deadline and not list(records.rglob("*.json")):
            time.sleep(0.1)
        LOSSES[lost](cluster, driver)
        _, said = driver.communicate(timeout=400)
        assert "Traceback" not in said, said
        assert (driver.returncode == 0) == (lost not in ("head", "driver")), said
    if lost in ("head", "driver"):
        with _cluster() as cluster:
            subprocess.run(_command(records, "--ray", cluster.address), check=True, capture_output=True)
    assert lasting_records(records) == lasting_records(whole)
