"""The Rerun viewer as a separate process, and `modeler view`."""

from __future__ import annotations

import atexit
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from modeler.system.regular_files import check_regular, open_regular
from modeler.types import InputError

_HOST: Final = "127.0.0.1"
_LOOPBACK: Final = (_HOST, "localhost")
PATIENCE_S: Final = 20.0  # until it listens, on a busy machine, or sends a byte
STOP_S: Final = 3.0  # until it has ended once asked to
# Runs the viewer so that Linux kills it when the process that started it ends, however that ends (prctl, option
# PR_SET_PDEATHSIG, survives exec). That process may have ended before the option was set.
_DIE_WITH_PARENT: Final = """\
import ctypes, os, signal, sys
ctypes.CDLL(None).prctl(1, int(signal.SIGKILL))
if os.getppid() == int(sys.argv[1]):
    os.execv(sys.argv[2], sys.argv[2:])
"""


@dataclass(frozen=True)
class Viewer:
    """A running viewer, reachable from this machine alone."""

    process: subprocess.Popen[bytes]
    """The viewer, or the server of the one in the browser."""
    sink: str
    """Where recordings are sent to."""
    address: str
    """Address for the user: the page of the viewer in the browser; the sink for a window."""
    lasting: bool
    """Whether it outlives this process: a window does, a page in the browser does not."""
    files: ThreadingHTTPServer | None = None
    """The server of the recording that the page loads."""

    def wait(self) -> None:
        """Return when the viewer is closed, or end it when the user interrupts or terminates this process."""
        before = None
        if threading.current_thread() is threading.main_thread():  # others may not, and get no signals
            before = signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            self.process.wait()
        except KeyboardInterrupt:
            pass
        finally:
            if before is not None:
                signal.signal(signal.SIGTERM, before)
            self.stop()

    def stop(self) -> None:
        """End the viewer, by force if it does not answer."""
        if self.files is not None:
            self.files.shutdown()
            self.files.server_close()
        self.process.terminate()
        try:
            self.process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def start_window(recordings: Sequence[Path] = ()) -> Viewer:
    """Open the viewer in a window that outlives this process, showing the given recordings.

    Raises:
        InputError: if there is no display, or the viewer does not start.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError(
            "cannot open the viewer: no display (DISPLAY is not set); use `web` and open the page that it prints"
        )
    port = _free_port()
    sink = _sink(port)
    arguments = ["--port", str(port), *map(str, recordings)]
    return Viewer(_start(arguments, port=port, lasting=True), sink, sink, lasting=True)


def start_web(recording: Path | None = None) -> Viewer:
    """Serve the viewer in the browser on 127.0.0.1 for as long as this process lives, showing the given recording.

    Raises:
        InputError: if the server does not start.
    """
    port, page = _free_port(), _free_port()
    arguments = ["--serve-web", "--port", str(port), "--web-viewer-port", str(page)]
    process = _start(arguments, port=page, lasting=False)
    source, files = _sink(port), None
    if recording is not None:
        # The page loads the recording itself: given a file, Rerun 0.41 forwards it from a thread that polls for more
        # for ever and takes a whole core (re_grpc_server::spawn_from_rx_set).
        files = _file_server(recording, f"http://{_HOST}:{page}")
        source = f"http://{_HOST}:{files.server_port}/{quote(recording.name)}"
    address = f"http://{_HOST}:{page}?url={quote(source, safe='')}"
    served = Viewer(process, _sink(port), address, lasting=False, files=files)
    atexit.register(served.stop)  # also where an error ends the run
    return served


def view(run: Path, *, web: bool = False) -> Viewer:
    """Show the recording of a run folder in the viewer, in a window or in the browser.

    Raises:
        InputError: if the folder has no recording, or the viewer does not start.
    """
    recording = run / "recording.rrd"
    try:
        os.lstat(recording)
    except PermissionError:
        pass  # it may be there, and the look at it says why it cannot be read
    except (OSError, ValueError):
        raise InputError(f"{run}: no recording.rrd here; give a run folder of `modeler build`") from None
    check_regular(recording)
    return start_web(recording) if web else start_window([recording])


def is_loopback(host: str) -> bool:
    """Return whether a request's header `Host`, a name and a port, is that of this machine."""
    return host.rpartition(":")[0] in _LOOPBACK


def reachable(sink: str) -> bool:
    """Return whether something listens where recordings are to be sent, `rerun+http://HOST:PORT/proxy`.

    Raises:
        InputError: if the address is not of that form.
    """
    scheme, _, rest = sink.partition("://")
    place, _, path = rest.partition("/")
    host, _, port = place.rpartition(":")
    if scheme not in ("rerun", "rerun+http", "rerun+https") or path != "proxy" or not host or not port.isdigit():
        raise InputError(f"`connect` {sink}: not the address of a viewer; give one like {_sink(9876)}")
    return _listens(host.strip("[]"), int(port), patience_s=1.0)


def _start(arguments: list[str], *, port: int, lasting: bool) -> subprocess.Popen[bytes]:
    """Start the viewer's executable and return once it listens on `port`; without `lasting` it ends with us."""
    from rerun_cli import __main__ as cli

    # The executable itself, for the script of that name only waits for it and does not pass signals on.
    executable = Path(cli.__file__).with_name(cli.add_exe_suffix("rerun"))
    command = [str(executable), "--bind", _HOST, *arguments]
    if not lasting and sys.platform == "linux":
        command = [sys.executable, "-I", "-S", "-c", _DIE_WITH_PARENT, str(os.getpid()), *command]
    process = _child_of_lasting_thread(command)
    deadline = time.monotonic() + PATIENCE_S
    while not _listens(_HOST, port, patience_s=0.2):
        if process.poll() is not None or time.monotonic() > deadline:
            process.kill()
            process.wait()
            raise InputError("the Rerun viewer did not start; start it by hand to see why: rerun")
        time.sleep(0.05)
    return process


def _child_of_lasting_thread(command: list[str]) -> subprocess.Popen[bytes]:
    """Start a process from a thread that lasts as long: Linux takes the thread that starts a process for its parent."""
    started: Future[subprocess.Popen[bytes]] = Future()

    def start() -> None:
        try:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,  # stdout is for data; the viewer chats
                stderr=subprocess.DEVNULL,
                env={**os.environ, "RERUN_APP_ONLY": "true"},
                start_new_session=True,  # Ctrl-C is for the run, which has more to send when it ends
            )
        except OSError as error:
            started.set_exception(error)
            return
        started.set_result(process)
        process.wait()

    threading.Thread(target=start, daemon=True).start()
    return started.result()


class _OneFile(BaseHTTPRequestHandler):
    """Answers every request with one file, for pages of one origin."""

    timeout = PATIENCE_S

    def __init__(self, *request: Any, file: Path, origin: str) -> None:
        self._file, self._origin = file, origin
        super().__init__(*request)

    def do_GET(self) -> None:
        """Send the file."""
        # Another name may be of a page elsewhere, which has it resolved to this machine to read what is here.
        if not is_loopback(self.headers.get("Host", "")):
            self.send_error(HTTPStatus.MISDIRECTED_REQUEST)
            return
        try:
            content = open_regular(self._file)
        except InputError:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        with content:
            self.send_response(HTTPStatus.OK)
            self.send_header("Access-Control-Allow-Origin", self._origin)
            self.send_header("Content-Type", "application/octet-stream")
            self.end_headers()
            shutil.copyfileobj(content, self.wfile)

    def log_message(self, format: str, *args: object) -> None:  # the name is that of the base class
        """Say nothing: stderr is for the run."""


class _FileServer(ThreadingHTTPServer):
    """A server of which a connection that breaks is no error."""

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing."""


def _file_server(file: Path, origin: str) -> ThreadingHTTPServer:
    """Serve one file on 127.0.0.1 to pages of an origin, from a thread that ends with this process."""
    server = _FileServer((_HOST, 0), partial(_OneFile, file=file, origin=origin))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server


def _sink(port: int) -> str:
    return f"rerun+http://{_HOST}:{port}/proxy"


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((_HOST, 0))
        return int(probe.getsockname()[1])


def _listens(host: str, port: int, *, patience_s: float) -> bool:
    """Return whether a connection to a port is accepted."""
    try:
        with socket.create_connection((host, port), timeout=patience_s):
            return True
    except (OSError, UnicodeError):  # of names that cannot be those of a host
        return False
