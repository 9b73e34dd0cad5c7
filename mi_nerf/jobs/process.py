"""What runs in a process of :class:`mi_nerf.jobs.local.LocalWorkers`, and how both sides talk.

Requests come through the standard input, replies leave through what was the standard output, each
a pickle with its length before it. The input ends when the other side is gone, whatever ended it:
then this process ends, too, even in the middle of a job.
"""

from __future__ import annotations

import os
import pickle
import queue
import signal
import struct
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import Future
from typing import IO, Any

_LENGTH = struct.Struct("<Q")
_TURN = threading.Lock()


class JobError(RuntimeError):
    """A job cannot be done, not for its own fault; the message names it, or what is missing."""


class WorkerDiedError(RuntimeError):
    """A process ended in the middle of a job; the message says how."""


class RemoteError(Exception):
    """Where an exception was raised in another process, as text."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


def perform(function: Callable[..., Any], *arguments: Any) -> Any:
    """Calls a job's function. Those of one process take turns, in whichever threads they are."""
    with _TURN:
        return function(*arguments)


def send(stream: IO[bytes], message: bytes) -> None:
    """Writes a message.

    Raises:
        OSError: if nobody reads.
    """
    stream.write(_LENGTH.pack(len(message)) + message)
    stream.flush()


def call(function: Callable[..., Any], arguments: tuple[Any, ...], heard: bool = True) -> bytes:
    """A request to call a function; ``heard``: and to reply."""
    return pickle.dumps((pickle.dumps((function, arguments)), heard))


def receive(stream: IO[bytes]) -> bytes:
    """Reads a message.

    Raises:
        EOFError: if the other side is gone.
    """
    head = stream.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        raise EOFError
    length: int = _LENGTH.unpack(head)[0]
    message = stream.read(length)
    if len(message) < length:
        raise EOFError
    return message


def serve(replies: int) -> None:
    """Does what the standard input asks for until it ends.

    Args:
        replies: descriptor of the file that replies go to.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a job may want it, else the other side decides
    requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(requests,), daemon=True).start()
    with os.fdopen(replies, "wb") as stream:
        while True:
            request, heard = pickle.loads(requests.get())
            reply = _reply(request)
            if heard:
                send(stream, reply)


def _listen(requests: queue.SimpleQueue[bytes]) -> None:
    """Passes requests on, unread: what they import belongs in the main thread."""
    with os.fdopen(os.dup(0), "rb") as stream:
        try:
            while True:
                requests.put(receive(stream))
        except (EOFError, OSError):
            os._exit(0)


def _reply(request: bytes) -> bytes:
    """What has come of a request, see :func:`outcome`."""
    try:
        function, arguments = pickle.loads(request)
    except BaseException as error:
        return _raised(error)
    return outcome(function, arguments)


def outcome(function: Callable[..., Any], arguments: tuple[Any, ...]) -> bytes:
    """Calls a function; what has come of it is for :func:`pass_on`, elsewhere."""
    try:
        return pickle.dumps((True, function(*arguments)))
    except BaseException as error:
        return _raised(error)


def _raised(error: BaseException) -> bytes:
    text = traceback.format_exc()
    try:
        reply = pickle.dumps((False, (error, text)))
        pickle.loads(reply)  # some exceptions can be written and not read
    except Exception:
        reply = pickle.dumps((False, (RuntimeError(f"{type(error).__name__}: {error}"), text)))
    return reply


def pass_on(reply: bytes, future: Future[Any]) -> None:
    """Tells those who wait for a job what :func:`outcome` says of it."""
    try:
        good, result = pickle.loads(reply)
    except Exception as unknown:  # of a kind that is not known here
        future.set_exception(unknown)
        return
    if good:
        future.set_result(result)
        return
    failure, text = result
    failure.__cause__ = RemoteError(text)
    future.set_exception(failure)
