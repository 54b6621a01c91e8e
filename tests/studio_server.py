"""`modeler studio` in a process of its own, and a browser that looks at it."""

import http.client
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class Server:
    """A server that runs, and its address."""

    def __init__(self, capture: Path, out: Path) -> None:
        command = [sys.executable, "-m", "modeler", "studio", str(capture), "--out", str(out)]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=out.parent)
        for line in self.process.stderr:
            if (found := re.search(r"open (http://127\.0\.0\.1:(\d+)/\?token=(\S+)) in", line)) is not None:
                self.address, self.port, self.token = found[1], int(found[2]), found[3]
                return
        raise AssertionError("the server did not start")

    def get(self, path: str, **headers: str) -> tuple[int, bytes]:
        """Return status and body of the answer to a request with the token's cookie, unless headers say otherwise."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        given = {"Host": f"127.0.0.1:{self.port}", "Cookie": f"modeler-studio-{self.port}={self.token}", **headers}
        connection.putrequest("GET", path, skip_host=True, skip_accept_encoding=True)
        for name, value in given.items():
            connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        content = answer.status, answer.read()
        connection.close()
        return content

    def kill(self) -> None:
        """End it without notice."""
        self.process.kill()
        self._wait()

    def interrupt(self) -> int:
        """End it as Ctrl-C does, and return its status."""
        self.process.send_signal(signal.SIGINT)
        return self._wait()

    def _wait(self) -> int:
        self.process.stderr.close()
        return self.process.wait(30)


@contextmanager
def served(capture: Path, out: Path) -> Iterator[Server]:
    """Serve a capture until the end of the block."""
    server = Server(capture, out)
    try:
        yield server
    finally:
        if server.process.poll() is None:
            server.interrupt()


def end(pid: int | None) -> None:
    """End a command that has outlived its server."""
    if pid is not None:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            return
