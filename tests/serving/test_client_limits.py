"""The limits of a request to a served policy: its size, and the time in which the server must read it."""

import socket
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from websockets.http11 import Request
from websockets.protocol import State
from websockets.server import ServerProtocol

from clbench.base.errors import InputError
from clbench.serving.client import ServedPolicy
from clbench.serving.server import open_server, pack

OBSERVATIONS = {
    "state": np.zeros((2, 4), np.float32),
    "instruction": ["go left", "go up"],
    "seed": np.array([1, 2]),
    "step": np.array([0, 0]),
}


@pytest.fixture
def served() -> Iterator[ServedPolicy]:
    """A policy that repeats states, in another thread."""
    with open_server(lambda seen: seen["state"][:, None], port=0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        policy = ServedPolicy(f"ws://localhost:{server.socket.getsockname()[1]}")
        yield policy
        policy.close()
        server.shutdown()
        thread.join()


def test_a_request_that_no_server_would_read_is_refused_before_it_is_sent(
    served: ServedPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures = {**OBSERVATIONS, "pictures/wrist": np.zeros((40, 200, 200, 3), np.uint8)}
    size = len(pack(pictures))
    monkeypatch.setattr("clbench.serving.client.LARGEST_MESSAGE", size)
    assert served(pictures).shape == (2, 1, 4)
    monkeypatch.setattr("clbench.serving.client.LARGEST_MESSAGE", size - 1)
    with pytest.raises(InputError, match="take 5 MB, and the limit is 4 MB: choose a smaller --pict"):
        served(pictures)
    assert served(OBSERVATIONS).shape == (2, 1, 4)


def test_a_reply_may_be_as_large_as_a_request(served: ServedPolicy) -> None:
    state = np.zeros((40, 60_000), bool)  # 2 MB; websockets alone would refuse more than 1 MB
    found = served({**OBSERVATIONS, "state": state})
    assert found.shape == (40, 1, 60_000)
    assert found.dtype == np.bool_


def test_the_time_limit_of_a_request_ends_with_it(served: ServedPolicy) -> None:
    served(OBSERVATIONS)
    timers = [thread for thread in threading.enumerate() if isinstance(thread, threading.Timer)]
    assert all(timer.finished.is_set() for timer in timers)


@pytest.mark.long
def test_a_server_that_does_not_read_a_large_request_is_an_error() -> None:
    pictures = {**OBSERVATIONS, "image": np.zeros((40, 512, 512, 3), np.uint8)}  # 31 MB fill every buffer
    with socket.create_server(("localhost", 0)) as listening:
        thread = threading.Thread(target=greet_and_never_read, args=(listening,))
        thread.start()
        served = ServedPolicy(f"ws://localhost:{listening.getsockname()[1]}", timeout=0.5)
        with pytest.raises(InputError, match=r"did not answer within 0\.5 seconds"):
            served(pictures)
        served.close()
        thread.join()


@pytest.mark.long
def test_a_connection_that_is_lost_within_a_large_request_is_not_taken_for_a_late_answer() -> None:
    pictures = {**OBSERVATIONS, "image": np.zeros((40, 512, 512, 3), np.uint8)}
    with socket.create_server(("localhost", 0)) as listening:
        thread = threading.Thread(target=greet_and_hang_up, args=(listening,))
        thread.start()
        served = ServedPolicy(f"ws://localhost:{listening.getsockname()[1]}")
        with pytest.raises(InputError, match="ended the connection 5 times during one request"):
            served(pictures)
        thread.join()


def greet_and_never_read(listening: socket.socket) -> None:
    """Open one connection, and read nothing until the client gives up."""
    with greeted(listening):
        time.sleep(3)


def greet_and_hang_up(listening: socket.socket) -> None:
    """Open five connections, and end each as soon as its request begins to arrive."""
    for _ in range(5):
        with greeted(listening) as connection:
            connection.recv(1)


def greeted(listening: socket.socket) -> socket.socket:
    """Return a new connection that has received metadata."""
    connection, _ = listening.accept()
    protocol = ServerProtocol()
    while protocol.state is State.CONNECTING:
        protocol.receive_data(connection.recv(4096))
        for request in protocol.events_received():
            assert isinstance(request, Request)
            protocol.send_response(protocol.accept(request))
    protocol.send_binary(pack({}))
    connection.sendall(b"".join(protocol.data_to_send()))
    return connection
