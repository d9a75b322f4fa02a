"""Serve a policy over a websocket, so that `clbench score` can evaluate it from another environment.

Copy this file next to your policy. It needs Python 3.10 or later, NumPy, websockets and msgpack, and nothing
else: neither clbench nor a simulator.

    from server import serve
    serve(act)  # on ws://localhost:8000

A policy is a function from the observations of B episodes to chunks of actions, (B, H, A): the next H actions
of each episode. Its observations are a dictionary:

- `state`: float32 (B, S), the numbers that the scenario's policies may see;
- `image`: uint8 (B, N, N, 3), only where the task has a camera;
- `pictures/<camera>`: uint8 (B, N, N, 3), upright, for each camera of `clbench score --pictures`;
- `instruction`: B texts;
- `seed`: int64 (B,), a seed for each episode, and `step`: int64 (B,), the steps taken in it. If you draw
  noise from these two alone, the outcomes repeat themselves.

Rows are independent: an episode has no fixed row, and unused rows repeat the first one. A policy with a
memory keeps it by `seed`, which names the episode, and returns one action at a time; `step` 0 begins an
episode.

The protocol is openpi's. The first message is the metadata of the server. Then each request is a dictionary
of observations, and each reply one with `actions`. All are msgpack, with arrays as in openpi's
`msgpack_numpy`. An error is sent as text, and ends the connection. `GET /healthz` answers OK. Unlike openpi's
own client, a client sends batches.

With `serve(act, token=...)` a client must send that token, as `Authorization: Bearer TOKEN`. `clbench score`
reads it from the environment variable CLBENCH_POLICY_TOKEN.
"""

from __future__ import annotations

import hmac
import math
import re
import socket
import sys
import threading
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

import msgpack
import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.protocol import State
from websockets.sync.server import Server, ServerConnection
from websockets.sync.server import serve as listen

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from websockets.http11 import Request, Response

Observations = dict[str, Any]
"""Observations of B episodes by name, see the module's docstring."""

Policy = Callable[[Observations], Any]
"""A function from observations to chunks of actions (B, H, A)."""

_WILDCARDS = ("", "0.0.0.0", "::")
"""Hosts that stand for all addresses of this machine."""

TOKEN = "CLBENCH_POLICY_TOKEN"
"""Environment variable in which `clbench score` looks for the token of a server."""

LARGEST_MESSAGE = 256 * 2**20
"""Size limit of a request in bytes: 40 episodes with pictures of 1,400 x 1,400 pixels."""

MOST_EMPTY_ROWS = 2**16
"""Largest number of rows of an array without values; a policy of openpi takes about 800 bytes for each."""

_DTYPE = re.compile(r"[<>=|]?[A-Za-z?]{1,16}\d{0,10}(?:\[\w{1,16}\])?", re.ASCII)
"""Form of the name of a type: NumPy takes 10 s to read a name of 50,000 parts that commas separate."""


# ---- the policies of other libraries -----------------------------------------------------------------------


def lerobot_policy(
    policy: Any,
    preprocess: Callable[[Any], Any],
    postprocess: Callable[[Any], Any],
    camera: str = "image",
    noise: tuple[int, int] | None = None,
) -> Policy:
    """Return a policy of LeRobot as a function of observations.

    The batch that `preprocess` receives has `observation.state`, float32 (B, S), `task`, a list of B texts,
    and with a camera `observation.images.<camera>`, float32 (B, 3, N, N) from 0 to 1, as for each camera of
    `clbench score --pictures`. Without a camera it has the state as `observation.environment_state`, too: ACT
    needs one of the two. `postprocess` receives the actions (B, A) of one step after another, as in
    LeRobot's own server. Without `noise`, a policy draws from PyTorch's generator, which is seeded before
    each call by all seeds and steps together: the same request has the same reply, but the noise of an
    episode depends on the other episodes in its request.

    Args:
        policy: A `PreTrainedPolicy` whose `predict_action_chunk` needs no earlier observations: ACT, or
            SmolVLA, pi0 and others, which were not tried, but not the diffusion policy with its history.
        preprocess: The preprocessor of `lerobot.policies.factory.make_pre_post_processors`.
        postprocess: The postprocessor of the same function.
        camera: Name of the camera in the policy's features, "image" in demonstrations that clbench exported.
        noise: Shape of the noise that `predict_action_chunk(batch, noise=...)` starts from, as for
            `openpi_policy`: `(policy.config.chunk_size, policy.config.max_action_dim)` for SmolVLA and pi0.
    """
    import torch  # LeRobot brings it

    def act(observations: Observations) -> NDArray[Any]:
        state = torch.from_numpy(observations["state"])
        batch = {"observation.state": state, "task": list(observations["instruction"])}
        seen = _pictures(observations)
        if "image" in observations:
            seen[camera] = observations["image"]
        for name, pictures in seen.items():
            colours_first = torch.from_numpy(pictures).permute(0, 3, 1, 2).contiguous()
            batch[f"observation.images.{name}"] = colours_first.float() / 255
        if not seen:
            batch["observation.environment_state"] = state
        torch.manual_seed(int(observations["seed"].sum() + observations["step"].sum()))
        drawn = {}
        if noise is not None:
            rows = zip(observations["seed"], observations["step"], strict=True)
            values = torch.from_numpy(np.stack([_noise(seed, step, noise) for seed, step in rows]))
            drawn["noise"] = values.to(next(policy.parameters()).device)
        with torch.no_grad():
            chunks = policy.predict_action_chunk(preprocess(batch), **drawn)
            # LeRobot executes this many actions of a chunk before the policy acts again
            executed = getattr(policy.config, "n_action_steps", chunks.shape[1])
            steps = [postprocess(chunks[:, step]) for step in range(min(executed, chunks.shape[1]))]
            actions: NDArray[Any] = torch.stack(steps, dim=1).float().cpu().numpy()
        return actions

    return act


def _noise(seed: Any, step: Any, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return the noise from which a chunk of an episode starts."""
    return np.random.default_rng([int(seed), int(step)]).standard_normal(shape, np.float32)


def _pictures(observations: Observations) -> dict[str, Any]:
    """Return the pictures of `clbench score --pictures` by camera."""
    names = [name for name in observations if name.startswith("pictures/")]
    return {name.partition("/")[2]: observations[name] for name in names}


def _openpi_observation(row: Observations) -> Observations:
    """Return one observation with names as in openpi's examples."""
    image = {"observation/image": row["image"]} if "image" in row else {}
    pictures = {f"observation/{name}": picture for name, picture in _pictures(row).items()}
    return {"observation/state": row["state"], **image, **pictures, "prompt": row["instruction"]}


def openpi_policy(
    policy: Any,
    observation: Callable[[Observations], Observations] = _openpi_observation,
    noise: tuple[int, int] | None = None,
) -> Policy:
    """Return a policy that takes one observation at a time, such as openpi's, as a function of observations.

    openpi need not be installed. The state is the scenario's, and the policy's input transform must not need
    more than it gets: openpi's `LiberoInputs` also needs a picture of the wrist, which `clbench score
    --pictures` gives under the camera's name.

    Args:
        policy: A policy whose `infer(observation)` returns a dictionary with `actions`, (H, A).
        observation: Function from one row of the observations to what the policy expects. By default
            `observation/state`, `prompt`, with a camera `observation/image`, and `observation/<camera>` for
            each camera of `--pictures`.
        noise: Shape of the noise that `infer(observation, noise=...)` starts from: the horizon and the size
            of an action inside the model. It is drawn from seed and step, so that outcomes repeat themselves.
            None lets the policy draw its own.

    Returns:
        A function that raises TypeError if `infer` returns something else.
    """

    def infer(row: Observations) -> Any:
        drawn = {} if noise is None else {"noise": _noise(row["seed"], row["step"], noise)}
        found = policy.infer(observation(row), **drawn)
        if not isinstance(found, Mapping) or "actions" not in found:
            what = (
                f"one with {', '.join(map(str, found))}"
                if isinstance(found, Mapping)
                else type(found).__name__
            )
            raise TypeError(f"infer() must return a dictionary with `actions`, (H, A), not {what}.")
        return found["actions"]

    def act(observations: Observations) -> NDArray[Any]:
        count = len(observations["state"])
        rows = [{name: values[row] for name, values in observations.items()} for row in range(count)]
        keys = [pack(row) for row in rows]  # unused rows repeat the first one, and need no inference
        found = {key: np.asarray(infer(row)) for key, row in dict(zip(keys, rows, strict=True)).items()}
        return np.stack([found[key] for key in keys])

    return act


# ---- the server --------------------------------------------------------------------------------------------


def serve(
    policy: Policy,
    host: str = "localhost",
    port: int = 8000,
    metadata: Mapping[str, Any] | None = None,
    token: str | None = None,
) -> None:
    """Serve a policy until the program is interrupted.

    Programs on this machine can use the policy, but web pages in a browser cannot.

    Args:
        policy: The policy. It is called by one request at a time, in another thread: settings of one thread
            alone, such as `torch.inference_mode()` and `torch.autocast()`, belong inside it.
        host: Address to listen on. "0.0.0.0" lets any machine that reaches this one use the policy.
        port: Port to listen on; 0 lets the system choose one, which is printed.
        metadata: Texts and numbers that clients receive first, for example the name of a checkpoint.
        token: Secret that a client must send; None serves every client.

    Raises:
        ValueError: The token is empty, or has spaces or characters outside ASCII.
        SystemExit: The server cannot listen on the address, for example because another program does.
    """
    try:
        server = open_server(policy, host, port, metadata, token)
    except OSError as error:
        raise SystemExit(f"Cannot listen on {host or 'any address'}, port {port}: {error}.") from error
    with server:
        name = socket.gethostname() if host in _WILDCARDS else f"[{host}]" if ":" in host else host
        sys.stdout.write(f"Serving a policy on ws://{name}:{server.socket.getsockname()[1]}\n")
        sys.stdout.flush()
        with suppress(KeyboardInterrupt):
            server.serve_forever()


def open_server(
    policy: Policy,
    host: str = "localhost",
    port: int = 8000,
    metadata: Mapping[str, Any] | None = None,
    token: str | None = None,
) -> Server:
    """Return a server that listens, for a thread of your own: it has `serve_forever` and `shutdown`.

    The arguments are those of `serve`.
    """
    expected = None if token is None else bearer(token)
    greeting, lock = pack(dict(metadata or {})), threading.Lock()

    def handle(connection: ServerConnection) -> None:
        with suppress(ConnectionClosed):
            connection.send(greeting)
            for message in connection:
                try:
                    with lock:
                        # the request waited for others: if its client has given up, nobody reads the reply
                        if connection.protocol.state is not State.OPEN:
                            return
                        reply = _answer(policy, message)
                except (Exception, SystemExit):  # whatever the policy raises: the client shows it
                    traceback.print_exc()
                    connection.send(traceback.format_exc())
                    connection.close(1011, "The policy failed: the last message says why.")
                    return
                connection.send(reply)

    return listen(
        handle,
        sock=socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET),
        compression=None,
        max_size=LARGEST_MESSAGE,
        origins=[None],  # a page in a browser reaches localhost, too; browsers name its origin
        process_request=partial(_answer_without_policy, expected),
    )


def _answer(policy: Policy, message: str | bytes) -> bytes:
    """Return the reply to a request."""
    observations = None if isinstance(message, str) else unpack(message)
    if not isinstance(observations, dict):
        raise ValueError("A request must be a dictionary of observations, packed by msgpack.")
    if np.ndim(observations.get("state", 0)) != 2:
        names = ", ".join(map(str, observations))
        raise ValueError(
            "A request must hold a batch: `state` (B, S) and the other observations that server.py lists, "
            f"not {names}."
        )
    actions = policy(observations)
    if not hasattr(actions, "__array__") and not isinstance(actions, (list, tuple)):
        hint = ": return its 'actions'" if isinstance(actions, Mapping) else ""
        kind = type(actions).__name__
        raise TypeError(f"The policy must return an array (B, H, A), not a value of the type {kind}{hint}.")
    numbers = np.asarray(actions)
    if numbers.dtype.kind not in "fiub":
        raise TypeError(f"The policy must return numbers, not {numbers.shape} of the type {numbers.dtype}.")
    return pack({"actions": numbers})


def _answer_without_policy(
    expected: str | None, connection: ServerConnection, request: Request
) -> Response | None:
    """Answer a health check, and refuse a client without the token."""
    if request.path == "/healthz":
        return connection.respond(HTTPStatus.OK, "OK\n")
    # as bytes: a header may hold characters that compare_digest refuses in a text
    given = "".join(request.headers.get_all("Authorization")).encode(errors="surrogateescape")
    if expected is None or hmac.compare_digest(given, expected.encode()):
        return None
    refusal = connection.respond(HTTPStatus.UNAUTHORIZED, f"This policy needs a token: set {TOKEN}.\n")
    refusal.headers["WWW-Authenticate"] = "Bearer"
    return refusal


def bearer(token: str) -> str:
    """Return the value of the header that carries a token.

    Raises:
        ValueError: The token is empty, or has characters that a header cannot hold.
    """
    if not re.fullmatch("[!-~]+", token):  # the message does not tell the secret
        raise ValueError("A token must be printable ASCII characters without spaces, at least one.")
    return f"Bearer {token}"


# ---- messages ----------------------------------------------------------------------------------------------


def pack(values: Any) -> bytes:
    """Return a message: msgpack, with NumPy arrays and scalars as openpi encodes them.

    Raises:
        TypeError: A value has a type that msgpack cannot hold.
        ValueError: A value is an array of objects, structures or complex numbers.
    """
    message: bytes = msgpack.packb(values, default=_encode)
    return message


def unpack(message: bytes) -> Any:
    """Return the content of a message; its arrays are copies that may be written to.

    Raises:
        ValueError: The message is damaged, or holds an array of objects, structures or complex numbers.
    """
    try:
        return msgpack.unpackb(message, object_hook=_decode)
    except (ValueError, TypeError, KeyError, OverflowError, msgpack.exceptions.UnpackException) as error:
        raise ValueError(f"This is not a valid message: {str(error) or type(error).__name__}") from error


def _encode(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        shape, data = value.shape, value.tobytes()
        return {b"__ndarray__": True, b"data": data, b"dtype": _plain_dtype(value.dtype).str, b"shape": shape}
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": _plain_dtype(value.dtype).str}
    raise TypeError(f"A message cannot hold a {type(value).__name__}.")


def _decode(values: dict[Any, Any]) -> Any:
    if b"__ndarray__" in values:
        dtype = _dtype(values[b"dtype"])
        shape, data = values[b"shape"], values[b"data"]
        if min(shape, default=0) < 0:  # NumPy would choose a size for it
            raise ValueError(f"An array cannot have the shape {shape}.")
        array = np.frombuffer(data, dtype).reshape(shape)
        # rows without values take no bytes, so that a short message may have any number of them
        if not array.size and math.prod(max(size, 1) for size in array.shape) > MOST_EMPTY_ROWS:
            raise ValueError(f"An array cannot have the shape {shape}.")
        return array.copy()
    if b"__npgeneric__" in values:
        dtype, data = _dtype(values[b"dtype"]), values[b"data"]
        if dtype.kind == "S" and not isinstance(data, bytes):  # of a number n, NumPy would make n bytes
            raise ValueError(f"A scalar of the type {dtype} must be bytes, not {type(data).__name__}.")
        return dtype.type(data)
    return values


def _dtype(name: Any) -> np.dtype[Any]:
    """Return the type of a name such as "<f4"."""
    if not (isinstance(name, str) and _DTYPE.fullmatch(name)):
        raise ValueError("A message must name types as NumPy does, such as <f4.")
    return _plain_dtype(np.dtype(name))


def _plain_dtype(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """Return a type, but refuse one of objects, structures or complex numbers, as openpi does."""
    if dtype.kind in "OVc":
        raise ValueError(f"A message cannot hold values of the type {dtype}.")
    return dtype
