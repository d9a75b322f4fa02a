"""The server of a policy: its messages, and its adapters for policies of other libraries."""

import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgpack
import numpy as np
import pytest
import torch
from served import SERVER
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from clbench.serving.server import lerobot_policy, open_server, openpi_policy, pack, serve, unpack

ARRAYS = [
    np.array([[1.5, np.nan], [np.inf, -0.0]], np.float32),
    np.arange(24, dtype=np.float64).reshape(2, 3, 4)[:, ::2],
    np.asfortranarray(np.arange(6, dtype=np.int16).reshape(2, 3)),
    np.arange(4, dtype=">i4"),
    np.zeros((0, 3), np.uint8),
    np.array(7, np.int64),
    np.array([True, False]),
    np.array(["left", "höher"]),
    np.array([1, 2], np.float16),
]


@pytest.mark.parametrize("array", ARRAYS, ids=lambda one: f"{one.dtype.str}{one.shape}")
def test_an_array_comes_back_with_its_type_its_shape_and_its_bytes(array: Any) -> None:
    found = unpack(pack({"a": [array]}))["a"][0]
    assert (found.dtype, found.shape, found.tobytes()) == (array.dtype, array.shape, array.tobytes())
    assert found.flags.writeable


@pytest.mark.parametrize("scalar", [np.float32(0.1), np.int64(-3), np.bool_(True), np.uint8(255)])
def test_a_scalar_comes_back_with_its_type(scalar: Any) -> None:
    found = unpack(pack(scalar))
    assert (found, found.dtype) == (scalar, scalar.dtype)


def test_plain_values_come_back_as_they_are() -> None:
    values = {"text": "go left", "list": ["a", 1, 2.5, None, True], "bytes": b"\x00\xff", "none": {}}
    assert unpack(pack(values)) == values


def test_arrays_are_encoded_as_openpi_encodes_them() -> None:
    array = np.array([[1, 2]], np.int16)
    assert msgpack.unpackb(pack(array)) == {
        b"__ndarray__": True,
        b"data": array.tobytes(),
        b"dtype": "<i2",
        b"shape": [1, 2],
    }
    assert msgpack.unpackb(pack(np.float32(2))) == {b"__npgeneric__": True, b"data": 2.0, b"dtype": "<f4"}


@pytest.mark.parametrize(
    ("value", "error"),
    [
        (np.array([{}], object), "type object"),
        (np.zeros(2, [("a", "f4")]), "cannot hold values of the type"),
        (np.complex64(1), "type complex64"),
        ({1, 2}, "cannot hold a set"),
    ],
)
def test_what_a_message_cannot_hold_is_refused_before_it_is_sent(value: Any, error: str) -> None:
    with pytest.raises((TypeError, ValueError), match=error):
        pack({"a": value})


@pytest.mark.parametrize(
    "message",
    [
        b"",
        b"\xc1",
        pack({"a": np.zeros(4)})[:-3],
        msgpack.packb({b"__ndarray__": True}),
        msgpack.packb({b"__ndarray__": True, b"data": b"\0" * 8, b"dtype": "|O", b"shape": [1]}),
        msgpack.packb({b"__ndarray__": True, b"data": b"\0" * 8, b"dtype": "<f8", b"shape": [1000]}),
        msgpack.packb({b"__ndarray__": True, b"data": b"\0" * 8, b"dtype": "<f8", b"shape": [-1]}),
        msgpack.packb({b"__ndarray__": True, b"data": b"", b"dtype": "<f8", b"shape": [0, 2**63]}),
        msgpack.packb({b"__ndarray__": True, b"data": b"", b"dtype": "nonsense", b"shape": [0]}),
        msgpack.packb({b"__npgeneric__": True, b"data": "x", b"dtype": "<f8"}),
        msgpack.packb({b"__ndarray__": True, b"data": b"", b"dtype": "(1,,2)f8", b"shape": [0]}),
        msgpack.packb({b"__npgeneric__": True, b"data": 1, b"dtype": None}),
    ],
)
def test_a_damaged_message_is_refused(message: bytes) -> None:
    with pytest.raises(ValueError, match="not a valid message"):
        unpack(message)


def test_a_type_with_a_long_name_is_refused_before_numpy_reads_it() -> None:
    message = msgpack.packb({b"__ndarray__": True, b"data": b"", b"dtype": "f8," * 10_000, b"shape": [0]})
    with pytest.raises(ValueError, match="must name types as NumPy does, such as <f4"):
        unpack(message)


def test_the_file_alone_imports_neither_clbench_nor_pytorch_nor_a_simulator() -> None:
    code = f"""
import runpy, sys
runpy.run_path({str(SERVER)!r})
print(sorted({{"clbench", "torch", "gymnasium", "mujoco"}} & set(sys.modules)))
"""
    done = subprocess.run(
        [sys.executable, "-I", "-c", code], capture_output=True, text=True, check=True, cwd=Path("/")
    )
    assert done.stdout == "[]\n"


@contextmanager
def connected(policy: Callable[..., Any], **options: Any) -> Iterator[tuple[ClientConnection, int]]:
    """Serve a policy from a thread, and yield a bare connection and the port."""
    with open_server(policy, port=0, **options) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        port = server.socket.getsockname()[1]
        try:
            with connect(f"ws://localhost:{port}", compression=None, proxy=None) as connection:
                yield connection, port
        finally:
            server.shutdown()
            thread.join()


def received(connection: ClientConnection) -> Any:
    message = connection.recv()
    assert isinstance(message, bytes)
    return unpack(message)


def twice(observations: dict[str, Any]) -> Any:
    if "fail" in observations:
        raise KeyError("this policy fails")
    return 2 * observations["state"][:, None]


def test_the_metadata_come_first_and_each_request_has_a_reply() -> None:
    with connected(twice, metadata={"checkpoint": "step-100"}) as (connection, port):
        assert received(connection) == {"checkpoint": "step-100"}
        for count in (1, 40):
            state = np.random.default_rng(count).random((count, 3), np.float32)
            connection.send(pack({"state": state}))
            assert np.array_equal(received(connection)["actions"], 2 * state[:, None])
        with urllib.request.urlopen(f"http://localhost:{port}/healthz") as answer:
            assert answer.read() == b"OK\n"


def test_a_request_whose_client_has_gone_while_it_waited_is_not_computed() -> None:
    begun, may_end, calls = threading.Event(), threading.Event(), list[float]()

    def slow(observations: dict[str, Any]) -> Any:
        calls.append(float(observations["state"][0, 0]))
        begun.set()
        may_end.wait(60)
        return observations["state"][:, None]

    def ask(connection: ClientConnection, number: int) -> None:
        assert received(connection) == {}
        connection.send(pack({"state": np.full((1, 3), number, np.float32)}))

    with connected(slow) as (first, port):
        ask(first, 1)
        assert begun.wait(60)
        with connect(f"ws://localhost:{port}", proxy=None) as impatient:
            ask(impatient, 2)
            time.sleep(0.2)  # until its request waits for the policy
        with connect(f"ws://localhost:{port}", proxy=None) as patient:
            ask(patient, 3)
            may_end.set()
            assert received(patient)["actions"].tolist() == [[[3.0] * 3]]
        assert received(first)["actions"].tolist() == [[[1.0] * 3]]
    assert calls == [1, 3]


@pytest.mark.parametrize("sent", [None, "", "Bearer", "Bearer no", "secret", "Basic secret", "Bearer sécret"])
def test_a_server_with_a_token_refuses_clients_without_it(sent: str | None) -> None:
    headers = {} if sent is None else {"Authorization": sent}
    with open_server(twice, port=0, token="secret") as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        port = server.socket.getsockname()[1]
        with pytest.raises(InvalidStatus, match="HTTP 401") as caught:
            connect(f"ws://localhost:{port}", proxy=None, additional_headers=headers)
        assert caught.value.response.body == b"This policy needs a token: set CLBENCH_POLICY_TOKEN.\n"
        with urllib.request.urlopen(f"http://localhost:{port}/healthz") as answer:
            assert answer.read() == b"OK\n"
        right = {"Authorization": "Bearer secret"}
        with connect(f"ws://localhost:{port}", proxy=None, additional_headers=right) as connection:
            assert received(connection) == {}
        server.shutdown()
        thread.join()


@pytest.mark.parametrize("token", ["", "two words", "secret\n", "sécret"])
def test_a_token_that_no_header_can_hold_is_refused_and_not_shown(token: str) -> None:
    with pytest.raises(ValueError, match="printable ASCII characters without spaces") as caught:
        open_server(twice, port=0, token=token)
    assert not token or token not in str(caught.value)


def test_a_page_in_a_browser_cannot_use_a_policy() -> None:
    with connected(twice) as (connection, port):
        with pytest.raises(InvalidStatus, match="HTTP 403"):
            connect(f"ws://localhost:{port}", origin=Origin("https://example.com"), proxy=None)
        assert received(connection) == {}


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        (pack({"velocity": 1}), "and the other observations that server.py lists, not velocity"),
        (pack({"state": np.zeros(4, np.float32)}), "must hold a batch"),
        (pack({"state": np.zeros((1, 4)), "fail": 1}), "KeyError: 'this policy fails'"),
        (pack([1, 2]), "must be a dictionary of observations"),
        ("state", "must be a dictionary of observations"),
        (b"\xc1", "not a valid message"),
    ],
)
def test_an_error_is_printed_sent_as_text_and_ends_the_connection_alone(
    request_: Any, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with connected(twice) as (connection, port):
        assert received(connection) == {}
        connection.send(request_)
        found = connection.recv()
        assert isinstance(found, str)
        assert "Traceback" in found
        assert message in found
        assert found in capsys.readouterr().err
        with pytest.raises(ConnectionClosedError, match="1011"):
            connection.recv()
        with connect(f"ws://localhost:{port}", proxy=None) as another:
            assert received(another) == {}


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ({"actions": np.zeros((1, 8, 2))}, "not a value of the type dict: return its 'actions'."),
        (None, "not a value of the type NoneType."),
        ("left", "not a value of the type str."),
        ([["left"]], "must return numbers, not (1, 1) of the type <U4."),
    ],
)
def test_a_policy_that_returns_no_array_of_numbers_is_told_so(actions: Any, message: str) -> None:
    with connected(lambda _: actions) as (connection, _):
        received(connection)
        connection.send(pack({"state": np.zeros((1, 4), np.float32)}))
        assert message in str(connection.recv())


def has_ipv6() -> bool:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        return False
    return True


@pytest.mark.parametrize(
    ("host", "name"),
    [
        ("localhost", "localhost"),
        ("0.0.0.0", socket.gethostname()),
        pytest.param("::1", "[::1]", marks=pytest.mark.skipif(not has_ipv6(), reason="needs IPv6")),
    ],
)
def test_the_address_that_is_printed_is_one_that_clients_can_use(host: str, name: str) -> None:
    program = f"from server import serve; serve(print, {host!r}, 0)"
    command = [sys.executable, "-c", program]
    with subprocess.Popen(command, cwd=SERVER.parent, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline().startswith(f"Serving a policy on ws://{name}:")
        finally:
            process.kill()


def test_an_address_that_cannot_be_listened_on_ends_the_program_with_one_line() -> None:
    with socket.create_server(("localhost", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(SystemExit, match=rf"^Cannot listen on localhost, port {port}: .*in use.*\.$"):
            serve(twice, port=port)
    with pytest.raises(SystemExit, match=r"Cannot listen on no-such-host\.invalid, port 0: "):
        serve(twice, "no-such-host.invalid", 0)


# ---- policies of other libraries ---------------------------------------------------------------------------

OBSERVATIONS: dict[str, Any] = {
    "state": np.arange(6, dtype=np.float32).reshape(2, 3),
    "image": np.arange(2 * 4 * 4 * 3, dtype=np.uint8).reshape(2, 4, 4, 3),
    "instruction": ["go left", "go up"],
    "seed": np.array([5, 6]),
    "step": np.array([0, 8]),
}


class LeRobotShaped:
    """Has the documented interface of LeRobot's policies, with normalisation in the processors."""

    def __init__(self, noise: float = 0.0, executed: int = 5) -> None:
        self.batches: list[dict[str, Any]] = []
        self.given: list[torch.Tensor] = []
        self.noise = noise
        self.config = SimpleNamespace(n_action_steps=executed)

    def preprocess(self, batch: dict[str, Any]) -> dict[str, Any]:
        self.batches.append(batch)
        return {**batch, "observation.state": batch["observation.state"] - 1}

    def parameters(self) -> Iterator[torch.Tensor]:
        yield torch.zeros(1)

    def predict_action_chunk(self, batch: dict[str, Any], **noise: torch.Tensor) -> torch.Tensor:
        assert not torch.is_grad_enabled()
        self.given += noise.values()
        state = batch["observation.state"][:, None, :2]
        chunks: torch.Tensor = state + torch.arange(5.0)[:, None] + self.noise * torch.randn(len(state), 5, 2)
        return chunks

    def postprocess(self, action: torch.Tensor) -> torch.Tensor:
        assert action.shape == (2, 2)
        return action * 10


def test_a_policy_of_lerobot_receives_its_batch_and_its_actions_are_processed_step_by_step() -> None:
    policy = LeRobotShaped()
    act = lerobot_policy(policy, policy.preprocess, policy.postprocess, camera="front")
    expected = (OBSERVATIONS["state"][:, None, :2] - 1 + np.arange(5, dtype=np.float32)[:, None]) * 10
    found = act(OBSERVATIONS)
    assert found.dtype == np.float32
    assert np.array_equal(found, expected)
    (batch,) = policy.batches
    assert set(batch) == {"observation.state", "observation.images.front", "task"}
    assert batch["task"] == ["go left", "go up"]
    picture = batch["observation.images.front"]
    assert (picture.shape, picture.dtype, picture.is_contiguous()) == ((2, 3, 4, 4), torch.float32, True)
    assert np.allclose(picture.numpy().transpose(0, 2, 3, 1) * 255, OBSERVATIONS["image"])
    act({name: values for name, values in OBSERVATIONS.items() if name != "image"})
    _, second = policy.batches
    assert set(second) == {"observation.state", "observation.environment_state", "task"}
    assert torch.equal(second["observation.environment_state"], second["observation.state"])


@pytest.mark.parametrize(("executed", "found"), [(3, 3), (9, 5)])
def test_of_a_chunk_of_lerobot_as_many_actions_are_executed_as_lerobot_executes(
    executed: int, found: int
) -> None:
    actions, every = (
        lerobot_policy(one, one.preprocess, one.postprocess)(OBSERVATIONS)
        for one in (LeRobotShaped(executed=executed), LeRobotShaped())
    )
    assert actions.shape == (2, found, 2)
    assert np.array_equal(actions, every[:, :executed])


def test_a_policy_of_lerobot_draws_the_same_noise_for_the_same_request() -> None:
    policy = LeRobotShaped(noise=1.0)
    act = lerobot_policy(policy, policy.preprocess, policy.postprocess)
    with torch.random.fork_rng():
        first, again = act(OBSERVATIONS), act(OBSERVATIONS)
        later = act({**OBSERVATIONS, "step": np.array([4, 8])})
    assert np.array_equal(first, again)
    assert not np.array_equal(first, later)


def test_noise_of_a_policy_of_lerobot_depends_on_the_seed_and_the_step_of_its_episode_alone() -> None:
    policy = LeRobotShaped()
    act = lerobot_policy(policy, policy.preprocess, policy.postprocess, noise=(5, 8))
    with torch.random.fork_rng():
        act(OBSERVATIONS)
        act({**OBSERVATIONS, "seed": np.array([7, 6])})  # another first episode
        act({**OBSERVATIONS, "step": np.array([0, 9])})
        act({**OBSERVATIONS, "seed": np.array([0, 6]), "step": np.array([5, 8])})
    first, beside, later, exchanged = policy.given
    assert (first.shape, first.dtype) == ((2, 5, 8), torch.float32)
    assert [first[row].equal(beside[row]) for row in (0, 1)] == [False, True]
    assert [first[row].equal(later[row]) for row in (0, 1)] == [True, False]
    assert not first[0].equal(exchanged[0])


class OpenpiShaped:
    """Has the documented interface of openpi's policies."""

    def __init__(self) -> None:
        self.seen: list[tuple[dict[str, Any], Any]] = []

    def infer(self, obs: dict[str, Any], *, noise: Any = None) -> dict[str, Any]:
        self.seen.append((obs, noise))
        return {"actions": np.tile(next(iter(obs.values()))[:2], (4, 1)), "policy_timing": {"infer_ms": 1.0}}


def test_a_policy_of_openpi_infers_one_episode_after_another() -> None:
    policy = OpenpiShaped()
    found = openpi_policy(policy)(OBSERVATIONS)
    assert np.array_equal(found, np.repeat(OBSERVATIONS["state"][:, None, :2], 4, axis=1))
    (first, _), (second, noise) = policy.seen
    assert set(first) == {"observation/state", "observation/image", "prompt"}
    assert (first["prompt"], second["prompt"], noise) == ("go left", "go up", None)
    assert np.array_equal(second["observation/image"], OBSERVATIONS["image"][1])


def test_pictures_of_cameras_reach_policies_under_the_names_of_their_cameras() -> None:
    wrist = 7 * np.ones((2, 4, 4, 3), np.uint8)
    observations = {**OBSERVATIONS, "pictures/wrist": wrist}
    shaped = LeRobotShaped()
    lerobot_policy(shaped, shaped.preprocess, shaped.postprocess)(observations)
    (batch,) = shaped.batches
    assert np.allclose(batch["observation.images.wrist"].numpy(), 7 / 255)
    assert "observation.images.image" in batch
    policy = OpenpiShaped()
    openpi_policy(policy)(observations)
    (shown, _), *_ = policy.seen
    assert np.array_equal(shown["observation/wrist"], wrist[0])
    assert "observation/image" in shown


def test_a_policy_of_openpi_may_have_other_names_and_noise_that_repeats_itself() -> None:
    policy = OpenpiShaped()
    act = openpi_policy(policy, lambda row: {"joints": row["state"]}, noise=(4, 8))
    act(OBSERVATIONS)
    act(OBSERVATIONS)
    assert all(set(shown) == {"joints"} for shown, _ in policy.seen)
    one, two, again, _ = (noise for _, noise in policy.seen)
    assert (one.shape, one.dtype) == ((4, 8), np.float32)
    assert np.array_equal(one, again)
    assert not np.array_equal(one, two)


def test_a_policy_of_openpi_infers_unused_rows_not_again() -> None:
    policy = OpenpiShaped()
    rows = [0, 1, 0, 0]
    padded = {name: [values[row] for row in rows] for name, values in OBSERVATIONS.items()}
    arrays = {name: values if name == "instruction" else np.array(values) for name, values in padded.items()}
    found = openpi_policy(policy)(arrays)
    assert len(policy.seen) == 2
    assert np.array_equal(found, openpi_policy(policy)(OBSERVATIONS)[rows])
