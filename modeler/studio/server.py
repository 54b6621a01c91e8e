"""The server of the page, and of the pictures and files that it shows."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import logging
import re
import secrets
import shutil
import socket
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import parse_qs, quote
from urllib.request import urlopen

import nicegui
import uvicorn
from fastapi import FastAPI, HTTPException
from fastapi.responses import FileResponse, Response
from nicegui import ui

from modeler.batch.models import thumbnail_of
from modeler.export import RunFolder
from modeler.studio.jobs import POLL_S
from modeler.studio.page import Page
from modeler.studio.scan import Scan
from modeler.studio.state import Studio
from modeler.studio.widgets import jpeg, thumbnail
from modeler.system.regular_files import check_regular, read_regular
from modeler.types import InputError
from modeler.viz.viewer import PATIENCE_S, Viewer, is_loopback, start_web

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send


MOST_BYTES: Final = 1 << 20  # of a request or a message: strokes and choices have a few kilobytes
_POLICY: Final = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; worker-src 'self' blob:; object-src 'none'; base-uri 'self'; "
    "connect-src 'self' data: blob: http://127.0.0.1:*; form-action 'self'; frame-ancestors 'self'; frame-src 'self'"
)
"""For browsers: nothing is loaded from elsewhere, nothing reported. Rerun's viewer, which we hand on, asks its makers
for fonts and news, and reports to them; what a running build sends it takes from a port of its own. The libraries
beneath compile their templates in the page."""
_HEADERS: Final = (
    (b"content-security-policy", _POLICY.encode()),
    (b"referrer-policy", b"no-referrer"),
    (b"x-content-type-options", b"nosniff"),
)
_SAFE: Final = ("GET", "HEAD")


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
        await send({"type": "websocket.close", "code": 4403})
        return
    words = f"{status.value} {status.phrase}: open the address that modeler studio has printed\n".encode()
    headers = [(b"content-type", b"text/plain"), (b"content-length", str(len(words)).encode()), *_HEADERS]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": words})


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


HOST: Final = "127.0.0.1"
_OF_RUN: Final = ("report.html", "recording.rrd")
_ELSEWHERE: Final = re.compile(rb"<link[^>]*https://[^>]*>")


@dataclass
class Viewers:
    """The Rerun viewer that pages embed: of the build that runs, or of a finished run."""

    server: str
    """Address of our server."""
    token: str
    """For the viewer, which asks for recordings without cookies."""
    live: str = ""
    """The run folder of the build that it shows."""
    _viewer: Viewer | None = field(default=None, repr=False)
    _files: dict[str, tuple[bytes, str]] = field(default_factory=dict, repr=False)

    def sink(self, run: str) -> str:
        """Return where the build of a run folder is to send its recording: to a viewer of its own."""
        self.stop()
        self._viewer, self.live = start_web(), run
        return self._viewer.sink

    def address(self, scan: Scan | None) -> str:
        """Return the address of the viewer with the build that runs, else with the latest run of a scan."""
        source = self._started().sink
        awaited = self.live and not Path(self.live).exists()  # of a build that has not made its folder yet
        if scan is not None and scan.run is not None and self.live != str(scan.run) and not awaited:
            run = scan.run.name
            source = f"{self.server}/runs/{quote(scan.name)}/{quote(run)}/recording.rrd?token={self.token}"
        return f"/viewer/?url={quote(source, safe='')}&renderer=webgl"

    def file(self, name: str) -> tuple[bytes, str] | None:
        """Return one of the files of which the viewer is made, and its kind; None if there is no such file.

        They are handed on under our address, so that our policy holds for them.
        """
        if name not in self._files:
            page = self._started().address.partition("?")[0]
            try:
                with urlopen(f"{page}/{name}", timeout=PATIENCE_S) as answer:
                    content, kind = answer.read(), answer.headers.get_content_type()
            except OSError:
                return None
            self._files[name] = _ELSEWHERE.sub(b"", content) if kind == "text/html" else content, kind
        return self._files[name]

    def stop(self) -> None:
        """End the viewer."""
        if self._viewer is not None:
            self._viewer.stop()
        self._viewer, self.live = None, ""

    def _started(self) -> Viewer:
        if self._viewer is None or self._viewer.process.poll() is not None:
            self._viewer, self.live = start_web(), ""
        return self._viewer


def serve(studio: Studio, port: int, announce: Callable[[str], None]) -> None:
    """Serve the page on 127.0.0.1 until the user ends it; builds that run then make the model of the frames so far."""
    listening = _listening(port)
    port, token = int(listening.getsockname()[1]), secrets.token_urlsafe(24)
    address = f"http://{HOST}:{port}"
    viewers = Viewers(address, token)
    app = _application(studio, viewers)
    guarded = Guard(app, token, port)
    nicegui.app.timer(POLL_S, studio.queue.advance)
    logging.getLogger("nicegui").setLevel(logging.ERROR)  # it warns of slow machines
    config = uvicorn.Config(
        guarded,
        log_level="critical",
        access_log=False,
        lifespan="on",
        ws_max_size=MOST_BYTES,
        timeout_graceful_shutdown=2,  # for open connections
        server_header=False,
    )
    try:
        _Server(config, lambda: announce(f"{address}/?token={token}")).run(sockets=[listening])
    finally:
        studio.queue.stop()
        studio.release()
        viewers.stop()


class _Server(uvicorn.Server):
    """One that says when it answers, and ends in order also if it is asked to while it starts."""

    def __init__(self, config: uvicorn.Config, announce: Callable[[], None]) -> None:
        uvicorn.Server.__init__(self, config)
        self.announce = announce

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start; what has been started ends before the server does."""
        await uvicorn.Server.startup(self, sockets)
        if self.should_exit:
            await self.shutdown(sockets)
        else:
            asyncio.get_running_loop().call_soon(self.announce)


def _listening(port: int) -> socket.socket:
    """Return a socket of the port, so that the address is right before anybody asks."""
    listening = socket.socket()
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((HOST, port))
        listening.listen()
    except (OSError, OverflowError) as error:
        listening.close()
        raise InputError(f"`port` {port}: cannot be used ({error}); give another one, or none") from error
    return listening


def _application(studio: Studio, viewers: Viewers) -> FastAPI:
    """Return the application: pictures and files by their names, and the page."""
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

    @app.get("/frames/{name}/{frame}.jpg")
    def of_frame(name: str, frame: int) -> Response:
        return _picture(jpeg(_scan(studio, name, frame).sequence.frame(frame)))

    @app.get("/thumbnails/{name}/{frame}.jpg")
    def of_mask(name: str, frame: int) -> Response:
        scan = _scan(studio, name, frame)
        return _picture(thumbnail(scan.sequence.frame(frame), scan.mask(frame)))

    @app.get("/capture/newest.jpg")
    def newest() -> Response:
        source = studio.recorder or studio.capture
        frame = None if source is None else source.frame
        if frame is None:
            raise HTTPException(HTTPStatus.NOT_FOUND)
        return _picture(jpeg(frame))

    @app.get("/models/{name}/{run}.jpg")
    def of_model(name: str, run: str) -> Response:
        folder = _run(studio, name, run)
        drawn = folder.with_name(f"{run}.jpg")
        with contextlib.suppress(InputError, OSError):
            thumbnail_of(folder, drawn)
            return _picture(read_regular(drawn))
        raise HTTPException(HTTPStatus.NOT_FOUND)

    @app.get("/runs/{name}/{run}/{file}")
    def of_run(name: str, run: str, file: str) -> Response:
        if file not in _OF_RUN:
            raise HTTPException(HTTPStatus.NOT_FOUND)
        return _file(_run(studio, name, run) / file)

    @app.get("/viewer/{name}")
    @app.get("/viewer/")
    def of_viewer(name: str = "") -> Response:
        found = viewers.file(name) if re.compile(r"[\w.-]{0,64}").fullmatch(name) else None
        if found is None:
            raise HTTPException(HTTPStatus.NOT_FOUND)
        return Response(found[0], media_type=found[1])

    @app.get("/take-away/{name}/{file}")
    def taken(name: str, file: str) -> Response:
        folder = next((folder for folder in studio.folders() if folder.name == name), None)
        entries = {} if folder is None else {path.name: path for path in (folder / "take-away").glob("*")}
        if file in entries and entries[file].is_file():
            return _file(entries[file], download=file)
        whole = entries.get(file.removesuffix(".zip"))
        if whole is None or not whole.is_dir():
            raise HTTPException(HTTPStatus.NOT_FOUND)
        with tempfile.TemporaryDirectory() as place:
            packed = shutil.make_archive(str(Path(place) / "packed"), "zip", whole.parent, whole.name)
            headers = {"content-disposition": f"attachment; filename*=UTF-8''{quote(file)}"}
            return Response(Path(packed).read_bytes(), media_type="application/zip", headers=headers)

    @ui.page("/")
    def show() -> None:
        Page(studio, viewers).show()

    ui.run_with(app, title="modeler studio", favicon="🧊", show_welcome_message=False, reconnect_timeout=30)
    return app


def _scan(studio: Studio, name: str, frame: int) -> Scan:
    """Return the scan of a name that has a frame."""
    scan = studio.known(name)
    if scan is None or frame not in scan.sequence.indices:
        raise HTTPException(HTTPStatus.NOT_FOUND)
    return scan


def _run(studio: Studio, name: str, run: str) -> Path:
    """Return a run folder by its names."""
    folder = next((folder for folder in studio.folders() if folder.name == name), None)
    runs = {} if folder is None else {path.name: path for path in folder.glob("run-*")}
    if run not in runs or not RunFolder(runs[run]).is_run:
        raise HTTPException(HTTPStatus.NOT_FOUND)
    return runs[run]


def _file(path: Path, download: str | None = None) -> Response:
    try:
        check_regular(path)
    except InputError:
        raise HTTPException(HTTPStatus.NOT_FOUND) from None
    return FileResponse(path, headers={"cache-control": "no-store"}, filename=download)


def _picture(content: bytes) -> Response:
    return Response(content, media_type="image/jpeg", headers={"cache-control": "no-cache"})
