"""Runs the AWS stand-in, and writes down which calls the operator's programs make to it: `python -m labkit.aws_recorder LOG`.

Runs in the lab's virtual environment, which has ministack. The log is read by `awsrecorded`.
"""

import logging
import sys
from collections.abc import Awaitable, Callable, MutableMapping
from logging.handlers import RotatingFileHandler
from typing import Any

from . import awsrecorded, rights

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
App = Callable[[Message, Receive, Callable[[Message], Awaitable[None]]], Awaitable[None]]
# Most that the log may have before it is put aside; one old one is kept.
MOST_BYTES = 128 << 20


def recording(app: App, write: Callable[[str], None]) -> App:
    """The same application, of which each request of the operator's is written down once it is answered."""

    async def recorded(scope: Message, receive: Receive, send: Callable[[Message], Awaitable[None]]) -> None:
        if scope["type"] != "http":
            return await app(scope, receive, send)
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        body = bytearray()

        async def receive_and_keep() -> Message:
            message = await receive()
            # Those of other services are files.
            if "x-amz-target" in headers:
                body.extend(message.get("body", b""))
            return message

        try:
            await app(scope, receive_and_keep, send)
        finally:
            query = scope["query_string"].decode("latin-1")
            call = awsrecorded.call_of(scope["method"], scope["path"], query, headers, bytes(body))
            if call is not None:
                write(awsrecorded.line_of(call, rights.now()))

    return recorded


def main(log: str) -> None:
    # Only here, so that tests need no virtual environment.
    from ministack import app as stand_in  # noqa: PLC0415

    calls = logging.getLogger("leaderboard.calls")
    calls.propagate = False
    calls.setLevel(logging.INFO)
    calls.addHandler(RotatingFileHandler(log, maxBytes=MOST_BYTES, backupCount=1))
    stand_in.app = recording(stand_in.app, calls.info)
    # It has arguments of its own.
    del sys.argv[1:]
    stand_in.main()


if __name__ == "__main__":
    main(sys.argv[1])
