"""The server of the page, and of the pictures and files that it shows."""

from __future__ import annotations

import contextlib
import logging
import secrets
import shutil
import socket
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, final
from urllib.parse import quote

import nicegui
import uvicorn
from fastapi import FastAPI
from fastapi.responses import FileResponse, Response
from nicegui import ui

from modeler.batch.models import thumbnail_of
from modeler.export import RunFolder
from modeler.studio.guard import MOST_BYTES, Guard
from modeler.studio.pages import Page
from modeler.studio.pictures import jpeg, thumbnail
from modeler.studio.scan import Scan, Studio
from modeler.system.regular_files import check_regular
from modeler.types import InputError
from modeler.viz.viewer import Viewer, start_web

HOST: Final = "127.0.0.1"
_POLL_S: Final = 0.25  # between looks at the running command
_CLOSE_S: Final = 2  # for open connections when the server ends
_OF_RUN: Final = ("report.html", "recording.rrd")
_BACKLOG: Final = 128


@final
@dataclass
class Viewers:
    """The Rerun viewer that pages embed: of the build that runs, or of a finished run."""

    server: str
    """Address of our server."""
    token: str
    """With which the viewer, a page of another port, asks for recordings."""
    live: str = ""
    """The command line of the build that it shows."""
    _viewer: Viewer | None = field(default=None, repr=False)

    def sink(self, line: str) -> str:
        """Return where the build of a command line is to send its recording: to a viewer of its own."""
        self.stop()
        self._viewer, self.live = start_web(), line
        return self._viewer.sink

    def address(self, scan: Scan) -> str:
        """Return the address of the viewer with the latest run of a scan."""
        if self._viewer is None or self._viewer.process.poll() is not None:
            self._viewer, self.live = start_web(), ""
        if self.live:
            return f"{self._viewer.address}&renderer=webgl&hide_welcome_screen=1"
        run = "" if scan.run is None else scan.run.name
        recording = f"{self.server}/runs/{quote(scan.name)}/{quote(run)}/recording.rrd?token={self.token}"
        return f"{self.page}?url={quote(recording, safe='')}&renderer=webgl"

    @property
    def page(self) -> str:
        """Address of the viewer without a recording."""
        return "" if self._viewer is None else self._viewer.address.partition("?")[0]

    def stop(self) -> None:
        """End the viewer."""
        if self._viewer is not None:
            self._viewer.stop()
        self._viewer, self.live = None, ""


def serve(studio: Studio, port: int, announce: Callable[[str], None]) -> None:
    """Serve the page on 127.0.0.1 until the user ends it; builds that run then make the model of the frames so far.

    Args:
        studio: what is shown.
        port: where; 0: a free one.
        announce: receives the address.

    Raises:
        InputError: if the port cannot be had.
    """
    listening = _listening(port)
    port, token = int(listening.getsockname()[1]), secrets.token_urlsafe(24)
    address = f"http://{HOST}:{port}"
    viewers = Viewers(address, token)
    app = _application(studio, viewers)
    guarded = Guard(app, token, port)
    nicegui.app.timer(_POLL_S, studio.queue.advance)
    logging.getLogger("nicegui").setLevel(logging.ERROR)  # it tells of slow machines
    config = uvicorn.Config(
        guarded,
        log_level="critical",
        access_log=False,
        lifespan="on",
        ws_max_size=MOST_BYTES,
        timeout_graceful_shutdown=_CLOSE_S,
        server_header=False,
    )
    announce(f"{address}/?token={token}")
    try:
        uvicorn.Server(config).run(sockets=[listening])
    finally:
        studio.queue.stop()
        viewers.stop()


def _listening(port: int) -> socket.socket:
    """Return a socket of the port, so that the address is right before anybody asks.

    Raises:
        InputError: if the port cannot be had.
    """
    listening = socket.socket()
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((HOST, port))
        listening.listen(_BACKLOG)
    except (OSError, OverflowError) as error:
        listening.close()
        raise InputError(f"`port` {port}: cannot be used ({error}); give another one, or none") from error
    return listening


def _application(studio: Studio, viewers: Viewers) -> FastAPI:
    """Return the application: pictures and files by their names, and the page."""
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

    @app.get("/frames/{name}/{frame}.jpg")
    def of_frame(name: str, frame: int) -> Response:
        scan = studio.known(name)
        if scan is None or frame not in scan.sequence.indices:
            return Response(status_code=404)
        return _picture(jpeg(scan.sequence.frame(frame)))

    @app.get("/thumbnails/{name}/{frame}.jpg")
    def of_mask(name: str, frame: int) -> Response:
        scan = studio.known(name)
        if scan is None or frame not in scan.sequence.indices:
            return Response(status_code=404)
        return _picture(thumbnail(scan.sequence.frame(frame), scan.mask(frame)))

    @app.get("/models/{name}/{run}.jpg")
    def of_model(name: str, run: str) -> Response:
        folder = _run(studio, name, run)
        if folder is None:
            return Response(status_code=404)
        with tempfile.TemporaryDirectory() as place, contextlib.suppress(InputError):
            out = Path(place) / "model.jpg"
            thumbnail_of(folder, out)
            if out.exists():
                return _picture(out.read_bytes())
        return Response(status_code=404)

    @app.get("/runs/{name}/{run}/{file}")
    def of_run(name: str, run: str, file: str) -> Response:
        folder = _run(studio, name, run)
        if folder is None or file not in _OF_RUN:
            return Response(status_code=404)
        headers = {"access-control-allow-origin": viewers.page} if viewers.page and file == "recording.rrd" else {}
        return _file(folder / file, headers)

    @app.get("/take-away/{name}/{file}")
    def taken(name: str, file: str) -> Response:
        folder = next((folder for folder in studio.folders() if folder.name == name), None)
        entries = {} if folder is None else {path.name: path for path in (folder / "take-away").glob("*")}
        if file in entries and entries[file].is_file():
            return _file(entries[file], {}, download=file)
        whole = entries.get(file.removesuffix(".zip"))
        if whole is None or not whole.is_dir():
            return Response(status_code=404)
        with tempfile.TemporaryDirectory() as place:
            packed = shutil.make_archive(str(Path(place) / "packed"), "zip", whole.parent, whole.name)
            headers = {"content-disposition": f"attachment; filename*=UTF-8''{quote(file)}"}
            return Response(Path(packed).read_bytes(), media_type="application/zip", headers=headers)

    @ui.page("/")
    def show() -> None:
        Page(studio, viewers).show()

    ui.run_with(app, title="modeler studio", favicon="🧊", show_welcome_message=False, reconnect_timeout=30)
    return app


def _run(studio: Studio, name: str, run: str) -> Path | None:
    """Return a run folder by its names; None if there is none."""
    folder = next((folder for folder in studio.folders() if folder.name == name), None)
    runs = {} if folder is None else {path.name: path for path in folder.glob("run-*")}
    found = runs.get(run)
    return found if found is not None and RunFolder(found).is_run else None


def _file(path: Path, headers: dict[str, str], download: str | None = None) -> Response:
    """Send a regular file."""
    try:
        check_regular(path)
    except InputError:
        return Response(status_code=404)
    return FileResponse(path, headers={"cache-control": "no-store", **headers}, filename=download)


def _picture(content: bytes) -> Response:
    return Response(content, media_type="image/jpeg", headers={"cache-control": "no-cache"})
