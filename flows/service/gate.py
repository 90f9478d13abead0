"""What every request passes before it is looked at: who asks, how much comes, for how long.

Works on the bare protocol (ASGI), because a form is read whole before any handler sees it.
"""

import asyncio
import contextlib
import time
from collections.abc import Iterator
from http import HTTPStatus
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from flows.service.limits import MIB
from flows.service.problems import Refusal, answer
from flows.service.queue import JobQueue, QueueFullError

RETRY_AFTER_S = 30
READING = frozenset({"GET", "HEAD", "OPTIONS"})


class Gate:
    """Wraps the service.

    Args:
        app: what is wrapped.
        queue: whose limits count, and in which an upload needs a place.
    """

    def __init__(self, app: ASGIApp, queue: JobQueue) -> None:
        self._app = app
        self._queue = queue

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request, or refuse it."""
        if scope["type"] != "http" or scope["method"] in READING:
            return await self._app(scope, receive, send)
        headers = Headers(scope=scope)
        try:
            _require_own_page(headers)
            self._require_small(headers)
            with self._place(scope):
                await self._app(scope, self._counted(receive), send)
        except Refusal as refusal:
            # Also raised while the body is read, but then the application answers.
            response = answer(refusal.status_code, refusal.problem, dict(refusal.headers or {}))
            await response(scope, receive, send)

    def _require_small(self, headers: Headers) -> None:
        """Believe a length that is too large; a false small one is found out by counting."""
        length = headers.get("content-length", "0")
        if (
            length.isascii()
            and length.isdecimal()
            and int(length) > self._queue.limits.upload_bytes
        ):
            raise self._too_large()

    def _too_large(self) -> Refusal:
        return Refusal(
            HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
            "upload_too_large",
            wanted=f"at most {self._queue.limits.upload_bytes / MIB:g} MiB in a request",
            came="more",
            todo="send a smaller picture, or fewer views",
        )

    @contextlib.contextmanager
    def _place(self, scope: Scope) -> Iterator[None]:
        if scope["method"] != "POST":
            yield
            return
        try:
            with self._queue.place():
                yield
        except QueueFullError as error:
            raise Refusal(
                HTTPStatus.SERVICE_UNAVAILABLE,
                "queue_full",
                wanted="a free place in the queue",
                came=f"{self._queue.limits.queue} jobs that wait",
                todo=f"try again in {RETRY_AFTER_S} s",
                headers={"Retry-After": str(RETRY_AFTER_S)},
            ) from error

    def _counted(self, receive: Receive) -> Receive:
        """The body, until it is too long or takes too long."""
        limits = self._queue.limits
        deadline = time.monotonic() + limits.upload_s
        received = 0

        async def counted() -> Message:
            nonlocal received
            try:
                message = await asyncio.wait_for(receive(), max(0.0, deadline - time.monotonic()))
            except TimeoutError as error:
                raise Refusal(
                    HTTPStatus.REQUEST_TIMEOUT,
                    "upload_too_slow",
                    wanted=f"a request that arrives within {limits.upload_s:g} s",
                    came="a slower one",
                    todo="send a smaller picture, or use a better line",
                    headers={"Connection": "close"},
                ) from error
            received += len(message.get("body", b""))
            if received > limits.upload_bytes:
                raise self._too_large()
            return message

        return counted


def _require_own_page(headers: Headers) -> None:
    """Refuse what a browser sends on behalf of another site's page: forms need no permission."""
    origin = headers.get("origin")
    if origin is not None and urlsplit(origin).netloc != headers.get("host"):
        raise Refusal(
            HTTPStatus.FORBIDDEN,
            "other_site",
            wanted="a request of a program, or of a page of this service",
            came="one of another site's page",
            todo="send it from a server of that site",
        )
