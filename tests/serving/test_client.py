"""The client of a served policy: lost connections, time limits and errors."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from served import serving, write_policy
from websockets.sync.server import ServerConnection, serve

from clbench.base.errors import InputError
from clbench.serving.client import ServedPolicy
from clbench.serving.server import open_server, pack

OBSERVATIONS = {
    "state": np.zeros((2, 4), np.float32),
    "instruction": ["go left", "go up"],
    "seed": np.array([1, 2]),
    "step": np.array([0, 0]),
}


@contextmanager
def answering(handle: Callable[[ServerConnection], None], **options: Any) -> Iterator[str]:
    """Run a server of its own manners in a thread, and yield its address."""
    with serve(handle, "localhost", 0, **options) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"ws://localhost:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join()


def until(happened: Callable[[], bool]) -> None:
    """Wait until something has happened, for a minute at most."""
    deadline = time.monotonic() + 60
    while not happened():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_served_policy_acts_like_the_same_policy_here(tmp_path: Path) -> None:
    here = write_policy(tmp_path)(0)
    with serving(tmp_path, 0) as (address, _):
        served = ServedPolicy(address)
        assert served.metadata == {"stage": 0}
        found, expected = served(OBSERVATIONS), here(OBSERVATIONS)
        assert found.dtype == expected.dtype
        assert np.array_equal(found, expected)
        served.close()
        assert np.array_equal(served(OBSERVATIONS), expected)
        served.close()


@pytest.mark.long
def test_a_server_that_is_killed_and_started_again_is_found_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    expected = write_policy(tmp_path)(0)(OBSERVATIONS)
    with serving(tmp_path, 0) as (address, _):
        served = ServedPolicy(address)
        assert np.array_equal(served(OBSERVATIONS), expected)
    port = int(address.rpartition(":")[2])
    found: list[Any] = []
    thread = threading.Thread(target=lambda: found.append(served(OBSERVATIONS)))
    thread.start()
    until(lambda: "Waiting for the policy at" in caplog.text)
    with serving(tmp_path, 0, port):
        thread.join()
    assert np.array_equal(found[0], expected)
    assert f"Waiting for the policy at {address}" in caplog.text


def test_a_server_that_comes_back_with_another_checkpoint_ends_the_stage() -> None:
    checkpoints = iter(("stage-0", "stage-0", "stage-1"))

    def handle(connection: ServerConnection) -> None:
        connection.send(pack({"checkpoint": next(checkpoints), "config": "small"}))
        connection.recv()
        connection.send(pack({"actions": np.zeros((2, 3, 4), np.float32)}))

    with answering(handle) as address:
        served = ServedPolicy(address)
        for _ in range(2):
            assert served(OBSERVATIONS).shape == (2, 3, 4)
            served.close()
        with pytest.raises(
            InputError, match="is not the one that the stage began with: its metadata differ in checkpoint"
        ):
            served(OBSERVATIONS)


def test_nobody_at_the_address_is_an_error_that_says_what_to_do(caplog: pytest.LogCaptureFixture) -> None:
    with socket.create_server(("localhost", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(
        InputError, match=rf"No policy answers at ws://localhost:{port}: .*refused.*Start its"
    ):
        ServedPolicy(f"ws://localhost:{port}", patience=0.5)
    assert caplog.text.count("Waiting for the policy") == 1  # of several attempts


@pytest.mark.long
def test_a_server_that_is_still_loading_is_waited_for_with_a_message_now_and_then(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clbench.serving.client.REMINDER_SECONDS", 0.2)
    write_policy(tmp_path)
    with socket.create_server(("localhost", 0)) as free:
        port = free.getsockname()[1]
    address = f"ws://localhost:{port}"
    found: list[ServedPolicy] = []
    thread = threading.Thread(target=lambda: found.append(ServedPolicy(address)))
    thread.start()
    until(lambda: len(caplog.messages) >= 2)
    assert f"Waiting for the policy at {address}, for 0 of 600 seconds: " in caplog.messages[0]
    with serving(tmp_path, 0, port):
        thread.join()
    found[0].close()


@contextmanager
def guarded(**options: Any) -> Iterator[str]:
    """Serve a policy that repeats states, and yield the address without its scheme."""
    with open_server(lambda seen: seen["state"][:, None], port=0, **options) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"localhost:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join()


def test_the_token_of_the_environment_opens_a_server_that_asks_for_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("CLBENCH_POLICY_TOKEN", "secret")
    with guarded(token="secret") as place:
        served = ServedPolicy(f"ws://{place}")
        assert served(OBSERVATIONS).shape == (2, 1, 4)
        served.close()
    with guarded() as place:  # which asks for none
        ServedPolicy(f"ws://{place}").close()


@pytest.mark.parametrize("token", [None, "wrong"])
def test_a_client_without_the_right_token_is_told_at_once_what_to_set(
    token: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("CLBENCH_POLICY_TOKEN", raising=False)
    if token is not None:
        monkeypatch.setenv("CLBENCH_POLICY_TOKEN", token)
    message = r"set the environment variable CLBENCH_POLICY_TOKEN to the token that its serve\(token=\.\.\.\)"
    with guarded(token="secret") as place, pytest.raises(InputError, match=message) as caught:
        ServedPolicy(f"ws://{place}")
    assert "wrong" not in str(caught.value)


@pytest.mark.parametrize(
    ("address", "token", "message"),
    [
        ("ws://localhost:1", "two words", "CLBENCH_POLICY_TOKEN: A token must be printable ASCII"),
        ("ws://localhost:1", "", "CLBENCH_POLICY_TOKEN: A token must be printable ASCII"),
        ("ws://user:words@localhost:1", "secret", "has a password, and CLBENCH_POLICY_TOKEN is set"),
    ],
)
def test_a_token_that_cannot_be_sent_is_refused_and_not_shown(
    address: str, token: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CLBENCH_POLICY_TOKEN", token)
    with pytest.raises(InputError, match=message) as caught:
        ServedPolicy(address)
    assert "secret" not in str(caught.value)
    assert "words" not in str(caught.value)


@pytest.mark.parametrize(
    ("address", "shown"),
    [
        ("ws://user:sekret@localhost:1", "ws://localhost:1"),
        ("ws://user:sek@ret@localhost:1/path", "ws://localhost:1/path"),
        ("ws://user:sek/ret@localhost:1", "ws://localhost:1"),
        ("ws://sekret@localhost:1", "ws://localhost:1"),
        ("user:sekret@localhost:1", "localhost:1"),
        ("http://user:sekret@localhost:1", "http://localhost:1"),
        ("ws://user:sekret@localhost:1/x#y", "ws://localhost:1/x#y"),
        ("ws://sekret:pa%ff@localhost:1", "ws://localhost:1"),
    ],
)
def test_no_message_shows_the_password_of_an_address(
    address: str, shown: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("CLBENCH_POLICY_TOKEN", raising=False)
    with pytest.raises(InputError) as caught:
        ServedPolicy(address, patience=0.3)
    told = str(caught.value) + caplog.text
    assert shown in told
    assert not any(secret in told for secret in ("user:", "sek", "ret@"))


@pytest.mark.parametrize(
    "address",
    ["localhost:8000", "http://localhost", "ws://", "ws://host:port", "ws://my..host:1", f"ws://{'x' * 64}"],
)
def test_another_address_is_refused(address: str) -> None:
    with pytest.raises(InputError, match=r"The address of a policy is ws://host:port, not "):
        ServedPolicy(address, patience=0.1)


def greet(connection: ServerConnection) -> None:
    connection.send(pack({}))


def sending(reply: Any) -> Callable[[ServerConnection], None]:
    def handle(connection: ServerConnection) -> None:
        greet(connection)
        for _ in connection:
            connection.send(reply)

    return handle


TRACEBACK = 'Traceback (most recent call last):\n  File "policy.py", line 1, in act\n    return state\n'


FRAME = '  File "policy.py", line 2, in deeper\n    return act(state)\n'


def silent(connection: ServerConnection) -> None:
    greet(connection)
    for _ in connection:
        time.sleep(0.4)


def ending(connection: ServerConnection) -> None:
    greet(connection)
    connection.recv()
    connection.close(1001)


@pytest.mark.parametrize(
    ("handle", "message"),
    [
        (sending(f"{TRACEBACK}KeyError: 'st\x1bate'\n"), r"failed: KeyError: 'st\\x1bate'"),
        (
            sending(f"{TRACEBACK}RuntimeError: sizes differ:\n\tsize 3\nnot 4\n"),
            "failed: RuntimeError: sizes differ: size 3 not 4",
        ),
        (
            sending(f"{TRACEBACK}KeyError: 1\n\nDuring it:\n\n{TRACEBACK}ValueError: no\nkey\n"),
            "failed: ValueError: no key",
        ),
        (sending(pack({"action": np.zeros(2)})), r"array of numbers called actions; it sent: action"),
        (sending(pack({"actions": [[0.0]]})), "it sent: actions, with actions of the type list"),
        (sending(pack({"actions": np.array([["left"]])})), r"it sent: actions of the type <U4, \(1, 1\)"),
        (sending(pack([1])), "array of numbers called actions; it sent: list"),
        (sending(pack(dict.fromkeys(map(str, range(999))))), r"it sent: 0, .*, 19, and 979 more\.$"),
        (sending(pack({"x" * 10**6: 1})), r"it sent: x{500} \[\.\.\. the reply has the rest\]\.$"),
        (sending(f"{TRACEBACK}{'x' * 10**6}"), r"failed: x{500} \[\.\.\. the output of the server has"),
        (sending(f"{TRACEBACK}{FRAME * 3000}KeyError: 1\n"), r"failed: KeyError: 1$"),
        (sending(b"\xc1"), "does not speak openpi's protocol"),
        (silent, r"did not answer within 0\.2 seconds\. Set a larger --timeout .*clients"),
        (ending, "ended the connection 5 times during one request"),
    ],
)
def test_a_reply_that_is_no_reply_is_an_error(handle: Callable[..., None], message: str) -> None:
    with answering(handle) as address:
        served = ServedPolicy(address, timeout=0.2)
        with pytest.raises(InputError, match=message):
            served(OBSERVATIONS)
        served.close()


@pytest.mark.parametrize(
    "extra", [pack({"actions": np.ones((2, 1, 4))}), f"{TRACEBACK}KeyError: 1\n"], ids=["reply", "error"]
)
def test_a_message_that_no_request_asked_for_is_not_taken_for_a_reply(extra: str | bytes) -> None:
    arrived = threading.Event()

    def handle(connection: ServerConnection) -> None:
        greet(connection)
        connection.send(extra)
        for _ in range(2):  # the client reads the second ping after all that came with the first
            connection.ping().wait()
        arrived.set()
        for _ in connection:
            connection.send(pack({"actions": np.zeros((2, 1, 4))}))

    with answering(handle) as address:
        served = ServedPolicy(address)
        assert arrived.wait(60)
        with pytest.raises(InputError, match=r"that no request asked for.*one reply to each request"):
            served(OBSERVATIONS)


def test_a_reply_that_comes_too_late_is_not_taken_for_the_next_one() -> None:
    given_up, numbers = threading.Event(), iter((1, 2))

    def handle(connection: ServerConnection) -> None:
        greet(connection)
        number = next(numbers)
        for _ in connection:
            if number == 1:
                given_up.wait(60)
            connection.send(pack({"actions": np.full((2, 1, 4), number)}))

    with answering(handle) as address:
        served = ServedPolicy(address, timeout=0.5)
        with pytest.raises(InputError, match=r"did not answer within 0\.5 seconds"):
            served(OBSERVATIONS)
        given_up.set()
        assert (served(OBSERVATIONS) == 2).all()
        served.close()


@pytest.mark.parametrize(
    ("first", "message"),
    [
        (pack([1, 2]), "must first send a dictionary of metadata"),
        (b"\xc1", "does not speak openpi's protocol"),
        ("no model is loaded", "failed: no model is loaded"),
    ],
)
def test_a_server_without_metadata_is_an_error(first: Any, message: str) -> None:
    with (
        answering(lambda connection: connection.send(first)) as address,
        pytest.raises(InputError, match=message),
    ):
        ServedPolicy(address)


def test_a_server_that_refuses_for_another_reason_than_the_token_is_waited_for() -> None:
    with (
        answering(
            greet, process_request=lambda connection, _: connection.respond(503, "loading\n")
        ) as address,
        pytest.raises(InputError, match=r"No policy answers at .*HTTP 503"),
    ):
        ServedPolicy(address, patience=0.1)


def test_a_program_that_speaks_before_the_handshake_is_no_server_of_a_policy() -> None:
    with socket.create_server(("localhost", 0)) as listener:

        def speak() -> None:
            with listener.accept()[0] as connection:
                connection.sendall(b"SSH-2.0-OpenSSH_9.6\r\n")
                connection.recv(4096)

        thread = threading.Thread(target=speak, daemon=True)
        thread.start()
        with pytest.raises(InputError, match="No policy answers at"):
            ServedPolicy(f"ws://localhost:{listener.getsockname()[1]}", patience=0.1)


def test_what_websockets_asserts_of_such_a_program_is_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def connect(*_: Any, **__: Any) -> None:
        raise AssertionError

    monkeypatch.setattr("clbench.serving.client.connect", connect)
    message = r"^No policy answers at ws://localhost:1: .*it sent something before the handshake"
    with pytest.raises(InputError, match=message):
        ServedPolicy("ws://localhost:1", patience=0.1)


def test_a_server_that_never_sends_metadata_is_an_error() -> None:
    with (
        answering(lambda connection: time.sleep(0.5)) as address,
        pytest.raises(InputError, match=r"did not answer within 0\.1 seconds"),
    ):
        ServedPolicy(address, timeout=0.1)
