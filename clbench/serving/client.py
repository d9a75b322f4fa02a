"""The client of a served policy: it reconnects when the connection is lost, and limits waiting times."""

from __future__ import annotations

import logging
import math
import os
import re
import socket
import threading
import time
from contextlib import ExitStack, suppress
from http import HTTPStatus
from itertools import dropwhile, islice
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus, InvalidURI
from websockets.sync.client import ClientConnection, connect
from websockets.uri import parse_uri

from clbench.base.errors import InputError
from clbench.base.text import printable, shortened
from clbench.serving.server import LARGEST_MESSAGE, TOKEN, Observations, bearer, pack, unpack

LOG = logging.getLogger("clbench")

ATTEMPTS = 5
"""Most connections that one request may lose: a request that crashes the server would do so forever."""

REMINDER_SECONDS = 60.0
"""Seconds between two messages about a server that does not answer."""

LONGEST_ERROR = 100_000
"""Most characters to read of an error from the server, which may send 256 MB."""

MOST_NAMES = 20
"""Most entries of a reply that a message names."""

_LOST = (ConnectionClosed, InvalidHandshake, OSError)
"""Errors of a connection that may not recur at the next attempt; a late handshake is an OSError."""


class ServedPolicy:
    """A policy that a server offers, as a function from observations to chunks of actions.

    An interrupted request is sent again: a reply depends on its request alone. The environment variable
    CLBENCH_POLICY_TOKEN holds the token that a server asks for.

    Args:
        address: Address of the server, for example "ws://localhost:8000".
        timeout: Seconds that a reply may take; the first one may include compilation.
        patience: Seconds to wait for a server that cannot be reached; loading a large policy takes minutes.

    Raises:
        InputError: The address is invalid, no server answers in time, the server speaks another protocol, or
            the token is missing, wrong or invalid.
    """

    def __init__(self, address: str, timeout: float = 300.0, patience: float = 600.0) -> None:
        self.address, self._timeout, self._patience = _without_password(address), timeout, patience
        """Address of the server, without user and password: messages show it."""
        if not _is_address(address):
            raise InputError(f"The address of a policy is ws://host:port, not {self.address!r}.")
        self._full_address, self._headers = address, _headers(address)
        self._connection: ClientConnection | None = None
        self._opened = ExitStack()
        self._greeting: dict[Any, bytes] | None = None
        self.metadata: dict[str, Any] = {}
        """Metadata that the server has sent about itself."""
        self._connected()

    def __call__(self, observations: Observations) -> NDArray[Any]:
        """Return chunks of actions (B, H, A) for the observations of B episodes.

        Raises:
            InputError: The request is too large, or the policy failed, took too long, returned no actions,
                sent more than one reply to a request, or cannot be reached any more.
        """
        request = pack(observations)
        if len(request) > LARGEST_MESSAGE:
            raise InputError(
                f"The pictures of one request take {math.ceil(len(request) / 2**20)} MB, and the limit is "
                f"{LARGEST_MESSAGE // 2**20} MB: choose a smaller --picture-size, or fewer --pictures."
            )
        for _ in range(ATTEMPTS):
            connection = self._connected()
            try:
                self._check_silent(connection)
                self._send(connection, request)
                reply = self._receive(connection)
            except _LOST as error:
                LOG.warning("The connection to the policy at %s was lost: %s", self.address, _reason(error))
                self.close()
            else:
                return self._actions(reply)
        raise InputError(
            f"The policy at {self.address} ended the connection {ATTEMPTS} times during one request: "
            "see what its server prints."
        )

    def close(self) -> None:
        """End the connection; the next request opens a new one."""
        self._connection = None
        self._opened.close()

    def _connected(self) -> ClientConnection:
        """Return the connection; if there is none, make one as soon as the server can be reached."""
        begin, pause, reminder = time.monotonic(), 0.1, 0.0
        while self._connection is None:
            try:
                self._connection = self._connect()
            except _LOST as error:
                waited = time.monotonic() - begin
                if waited + pause > self._patience:
                    raise InputError(
                        f"No policy answers at {self.address}: {_reason(error)}. Start its server, for "
                        "example with serve() of clbench/serving/server.py."
                    ) from error
                if waited >= reminder:
                    LOG.warning(
                        "Waiting for the policy at %s, for %.0f of %.0f seconds: %s",
                        *(self.address, waited, self._patience, _reason(error)),
                    )
                    reminder += REMINDER_SECONDS
                time.sleep(pause)
                pause = min(2 * pause, 2.0)
        return self._connection

    def _connect(self) -> ClientConnection:
        """Return a new connection whose server has sent its metadata."""
        try:
            opening = connect(
                self._full_address,
                additional_headers=self._headers,
                compression=None,
                max_size=LARGEST_MESSAGE,
                ping_interval=None,  # openpi's server answers none while its policy computes, or compiles
                close_timeout=1,
                proxy=None,  # a policy is on this machine or a near one, which proxies seldom reach
            )
        except AssertionError as error:  # of websockets, where the other side speaks first, as SSH does
            raise InvalidHandshake("it sent something before the handshake") from error
        except InvalidStatus as error:
            if error.response.status_code != HTTPStatus.UNAUTHORIZED:
                raise
            raise InputError(
                f"The server at {self.address} refuses this client: set the environment variable {TOKEN} to "
                "the token that its serve(token=...) was given."
            ) from error
        with ExitStack() as opened:
            connection = opened.enter_context(opening)
            metadata = self._receive(connection)
            if not isinstance(metadata, dict):
                raise InputError(f"The server at {self.address} must first send a dictionary of metadata.")
            greeting = {name: pack(value) for name, value in metadata.items()}
            if self._greeting is not None and greeting != self._greeting:
                changed = sorted(str(name) for name, _ in greeting.items() ^ self._greeting.items())
                raise InputError(
                    f"The server at {self.address} is not the one that the stage began with: its metadata "
                    f"differ in {printable(', '.join(dict.fromkeys(changed)))}. A stage needs one "
                    "checkpoint: serve that checkpoint, and score the stage again."
                )
            self._greeting = greeting
            self.metadata, self._opened = metadata, opened.pop_all()
        return connection

    def _check_silent(self, connection: ClientConnection) -> None:
        """Refuse a message that no request asked for: it would count as the reply to the next request.

        Raises:
            InputError: There is such a message.
        """
        try:
            message = connection.recv(timeout=0)
        except TimeoutError:
            return
        self.close()
        text = f" ({_error_of(message)})" if isinstance(message, str) else ""
        raise InputError(
            f"The server at {self.address} sent a message that no request asked for{text}: it must send its "
            "metadata once, and one reply to each request."
        )

    def _send(self, connection: ClientConnection, request: bytes) -> None:
        """Send a request in limited time: a server that never reads it would make the program wait forever.

        Raises:
            InputError: The server does not read the request in time.
        """
        ended = threading.Event()

        def end() -> None:
            ended.set()
            with suppress(OSError):
                connection.socket.shutdown(socket.SHUT_RDWR)

        timer = threading.Timer(self._timeout, end)
        timer.daemon = True
        timer.start()
        try:
            connection.send(request)
        except _LOST as error:
            if not ended.is_set():
                raise
            self.close()
            raise self._late() from error
        finally:
            timer.cancel()

    def _late(self) -> InputError:
        return InputError(
            f"The policy at {self.address} did not answer within {self._timeout:g} seconds. Set a larger "
            "--timeout if the policy is slow or answers other clients first."
        )

    def _receive(self, connection: ClientConnection) -> Any:
        """Return the next message of the server.

        Raises:
            InputError: The message is an error of the policy, cannot be read, or does not arrive in time.
        """
        try:
            message = connection.recv(timeout=self._timeout)
        except TimeoutError as error:
            self.close()
            raise self._late() from error
        if isinstance(message, str):  # openpi's servers send their traceback, and end the connection
            self.close()
            raise InputError(f"The policy at {self.address} failed: {_error_of(message)}")
        try:
            return unpack(message)
        except ValueError as error:
            raise InputError(
                f"The server at {self.address} does not speak openpi's protocol: {error}"
            ) from error

    def _actions(self, reply: Any) -> NDArray[Any]:
        """Return the actions of a reply."""
        actions = reply.get("actions") if isinstance(reply, dict) else None
        if not isinstance(actions, np.ndarray) or actions.dtype.kind not in "fiub":
            if isinstance(actions, np.ndarray):
                found = f"actions of the type {actions.dtype}, {actions.shape}"
            else:
                found = _names(reply) if isinstance(reply, dict) else type(reply).__name__
                if actions is not None:
                    found += f", with actions of the type {type(actions).__name__}"
            raise InputError(
                f"The policy at {self.address} must reply with a dictionary that has an array of numbers "
                f"called actions; it sent: {printable(found)}."
            )
        return actions


def _is_address(text: str) -> bool:
    """Return whether websockets accepts an address; its own error would show the password."""
    try:
        uri = parse_uri(text)
        uri.host.encode("idna")  # as the socket does
        return uri.port != 0
    except (InvalidURI, ValueError):  # an impossible host or port, or a password that is not UTF-8
        return False


def _without_password(address: str) -> str:
    """Return an address without user and password, even a damaged one: passwords may hold any character."""
    return re.sub(r"^(\w+://)?.*@", r"\1", address, flags=re.DOTALL)


def _headers(address: str) -> dict[str, str]:
    """Return the headers of a connection: the token from the environment variable, if it is set.

    Raises:
        InputError: A header cannot hold the token, or the address has a password for the same header.
    """
    token = os.environ.get(TOKEN)
    if token is None:
        return {}
    if urlsplit(address).username is not None:
        raise InputError(
            f"The address of the policy has a password, and {TOKEN} is set: a server reads only one of them. "
            "Remove one."
        )
    try:
        return {"Authorization": bearer(token)}
    except ValueError as error:
        raise InputError(f"{TOKEN}: {error}") from error


def _reason(error: BaseException) -> str:
    return printable(str(error).rstrip(".")) or type(error).__name__


def _names(reply: dict[Any, Any]) -> str:
    """Return the names of a reply's entries, only the first ones if there are many."""
    names = [shortened(str(name)[:LONGEST_ERROR], "the reply") for name in islice(reply, MOST_NAMES)]
    more = len(reply) - len(names)
    return ", ".join([*names, f"and {more:,} more"] if more else names)


def _error_of(text: str) -> str:
    """Return the error that a traceback ends with, with its name and all lines of its message."""
    last = text.rpartition("Traceback (most recent call last):")[2]
    if len(last) > LONGEST_ERROR:  # many frames before the error, or an error of one long line
        last = last[-LONGEST_ERROR:].partition("\n")[2] or last[:LONGEST_ERROR]
    lines = last.splitlines()
    shown = " ".join(line.strip() for line in dropwhile(lambda line: not line or line[0] == " ", lines))
    return shortened(printable(shown or text[:LONGEST_ERROR].strip()), "the output of the server")
