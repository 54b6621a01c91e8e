"""Who may ask: this machine's own browser, which knows the token, with requests of a reasonable size."""

from __future__ import annotations

import hmac
from collections.abc import Iterable
from dataclasses import dataclass
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING, Final, final
from urllib.parse import parse_qs

from modeler.viz.viewer import is_loopback

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

MOST_BYTES: Final = 1 << 20
"""Of a request or a message: strokes and choices have a few kilobytes."""
_POLICY: Final = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; worker-src 'self' blob:; object-src 'none'; base-uri 'self'; "
    "connect-src 'self' data: blob: http://127.0.0.1:*; form-action 'self'; frame-ancestors 'self'; frame-src 'self'"
)
"""For browsers: nothing is loaded from elsewhere, nothing told. Rerun's viewer, which we hand on, asks its makers for
fonts and news, and reports to them; what a running build sends it takes from a port of its own. The libraries beneath
compile their templates in the page."""
_HEADERS: Final = (
    (b"content-security-policy", _POLICY.encode()),
    (b"referrer-policy", b"no-referrer"),
    (b"x-content-type-options", b"nosniff"),
)
_CONFLICT: Final = 4403  # code of a refused web socket
_SAFE: Final = ("GET", "HEAD")


@final
@dataclass(frozen=True)
class Guard:
    """An application around another one, which sees only requests that may be answered."""

    app: ASGIApp
    """What is guarded."""
    token: str
    """What the address of the page ends with; a cookie keeps it from then on."""
    port: int
    """Where it is served: cookies of one machine are shared by all its ports."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        headers = [(name.lower(), value.decode("latin-1")) for name, value in scope["headers"]]
        given = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]
        refusal = self._refusal(scope, headers, given)
        if refusal is not None:
            await _refuse(scope, send, refusal)
        elif scope["type"] == "http" and scope["path"] == "/" and given:
            await self._enter(send)
        else:
            await self.app(scope, _Limited(receive), _with_headers(send) if scope["type"] == "http" else send)

    def _refusal(self, scope: Scope, headers: list[tuple[bytes, str]], given: str) -> HTTPStatus | None:
        """Return why a request is refused; None if it is not."""
        hosts, origins, lengths = (_values(headers, name) for name in (b"host", b"origin", b"content-length"))
        if len(hosts) != 1 or not is_loopback(hosts[0]):
            # Another name may be of a page elsewhere, which has it resolved to this machine.
            return HTTPStatus.MISDIRECTED_REQUEST
        asks = scope["type"] == "websocket" or scope["method"] not in _SAFE
        if asks and any(origin != f"http://{hosts[0]}" for origin in origins):
            return HTTPStatus.FORBIDDEN  # cookies come with requests of other pages, too
        if not (self._is_known(given) or any(map(self._is_known, self._kept(headers)))):
            return HTTPStatus.FORBIDDEN
        if any(not length.isdecimal() or len(length) > 9 or int(length) > MOST_BYTES for length in lengths):
            return HTTPStatus.REQUEST_ENTITY_TOO_LARGE
        return None

    def _is_known(self, token: str) -> bool:
        return hmac.compare_digest(token.encode("latin-1", "replace"), self.token.encode())

    def _kept(self, headers: list[tuple[bytes, str]]) -> Iterable[str]:
        """Yield the tokens of cookies."""
        for value in _values(headers, b"cookie"):
            try:
                cookies = SimpleCookie(value)
            except CookieError:
                continue
            if self._cookie in cookies:
                yield cookies[self._cookie].value

    async def _enter(self, send: Send) -> None:
        """Have the browser keep the token, and take it out of the address, which histories keep."""
        cookie = f"{self._cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/"
        headers = [(b"location", b"/"), (b"set-cookie", cookie.encode()), (b"content-length", b"0"), *_HEADERS]
        await send({"type": "http.response.start", "status": HTTPStatus.SEE_OTHER, "headers": headers})
        await send({"type": "http.response.body", "body": b""})

    @property
    def _cookie(self) -> str:
        return f"modeler-studio-{self.port}"


def _values(headers: list[tuple[bytes, str]], name: bytes) -> list[str]:
    return [value for key, value in headers if key == name]


async def _refuse(scope: Scope, send: Send, status: HTTPStatus) -> None:
    """Answer with a status alone."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": _CONFLICT})
        return
    words = f"{status.value} {status.phrase}: open the address that modeler studio has printed\n".encode()
    headers = [(b"content-type", b"text/plain"), (b"content-length", str(len(words)).encode()), *_HEADERS]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": words})


@final
class _Limited:
    """The body of a request, cut off where it becomes too large: its length need not be stated."""

    def __init__(self, receive: Receive) -> None:
        self._receive, self._taken = receive, 0

    async def __call__(self) -> Message:
        """Return the next piece; the end of the connection instead of too much."""
        message = await self._receive()
        if message["type"] == "http.request":
            self._taken += len(message.get("body", b""))
            if self._taken > MOST_BYTES:
                return {"type": "http.disconnect"}
        return message


def _with_headers(send: Send) -> Send:
    """Return what sends a response with our headers."""

    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            message = {**message, "headers": [*message.get("headers", ()), *_HEADERS]}
        await send(message)

    return sending
