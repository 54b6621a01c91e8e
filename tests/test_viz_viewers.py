"""No viewer, frozen, closed or absent, can stop a run or outlive it."""

import json
import logging
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import unquote

import pytest
from command_runner import spawned
from rerun_recordings import read, record
from slow_cases import quick_first
from turning_box import COUNT

from modeler.types import Step
from modeler.viz import entities, viewer
from modeler.viz.stream import RecordingFile, RerunStream, Shown, open_stream


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_run_that_is_killed_leaves_a_readable_recording(run: list[Step], tmp_path: Path) -> None:
    stream = open_stream("box", save=tmp_path / "r.rrd")
    stream(run[0])
    stream(run[1])
    stream.recording.flush()
    time.sleep(0.2)  # until what is in the pipe is copied
    (tmp_path / "cut.rrd").write_bytes((tmp_path / "r.rrd").read_bytes())
    stream.close()
    assert set(read(tmp_path / "cut.rrd")[entities.NOW]) == {0, 1}


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_what_is_written_leaves_nothing_in_memory(run: list[Step], tmp_path: Path) -> None:
    """A list of all pieces, for the end of the file, would take 25 kB each: 0.5 MB for each of these steps."""

    def held_mib() -> float:
        status = Path("/proc/self/status").read_text()
        return int(status.partition("RssAnon:")[2].split()[0]) / 1024.0

    stream, held = open_stream("box", save=tmp_path / "r.rrd"), []
    for number in range(90):
        stream(run[number % len(run)])
        stream.recording.flush()
        held.append(held_mib())
    stream.close()
    assert held[-1] - held[30] < 20.0


def listeners(process: subprocess.Popen[bytes]) -> set[str]:
    """Return the local addresses, as the kernel writes them, on which a process listens."""
    inodes = set()
    for descriptor in Path(f"/proc/{process.pid}/fd").iterdir():
        link = os.readlink(descriptor)
        if link.startswith("socket:["):
            inodes.add(link[8:-1])
    lines = [
        line.split() for name in ("tcp", "tcp6") for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]
    ]
    return {line[1].partition(":")[0] for line in lines if line[3] == "0A" and line[9] in inodes}


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_the_page_is_served_on_this_machine_alone(run: list[Step], tmp_path: Path) -> None:
    stream = open_stream("box", save=tmp_path / "r.rrd", web=True)
    stream(run[0])
    assert stream.address.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(str(stream.address), timeout=5.0) as page:
        assert b"<html" in page.read()
    (server,) = stream.viewers
    assert listeners(server.process) == {"0100007F"}
    stream.close()
    assert server.process.poll() is not None


def test_a_viewer_lasts_beyond_the_thread_that_starts_it() -> None:
    served: list[viewer.Viewer] = []
    thread = threading.Thread(target=lambda: served.append(viewer.start_web()))
    thread.start()
    thread.join()
    try:
        time.sleep(0.5)  # a signal at the thread's end would have come by now
        assert served[0].process.poll() is None
    finally:
        served[0].stop()
    assert served[0].process.poll() is not None


@pytest.mark.parametrize(("number", "says"), [(signal.SIGKILL, "the viewer was closed"), (signal.SIGSTOP, "")])
def test_a_viewer_that_dies_or_freezes_does_not_stop_the_run(
    run: list[Step],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    number: int,
    says: str,
) -> None:
    monkeypatch.setattr("modeler.viz.stream._PATIENCE_S", 0.5)
    monkeypatch.setattr("modeler.viz.viewer.STOP_S", 0.2)
    stream = open_stream("box", save=tmp_path / "r.rrd", web=True)
    stream(run[0])
    stream.viewers[0].process.send_signal(number)
    for step in run[1:]:
        stream(step)
    stream.close()
    assert says in caplog.text
    assert set(read(tmp_path / "r.rrd")[entities.NOW]) == set(range(COUNT))


def test_a_viewer_that_is_already_open_may_be_closed_while_the_run_goes_on(run: list[Step], tmp_path: Path) -> None:
    served = viewer.start_web()
    stream = open_stream("box", save=tmp_path / "r.rrd", connect=served.sink)
    assert stream.viewers == ()  # it is not ours to end
    stream(run[0])
    assert served.process.poll() is None
    served.stop()
    for step in run[1:]:
        stream(step)
    stream.close()
    assert set(read(tmp_path / "r.rrd")[entities.NOW]) == set(range(COUNT))


_STREAM = """\
import os, resource, signal, socket, sys, threading
from modeler.cli.console import endable
import modeler.viz.stream
from turning_box import steps
from pathlib import Path

silent = socket.create_server(("127.0.0.1", 0))
watched = f"rerun+http://127.0.0.1:{silent.getsockname()[1]}/proxy" if sys.argv[3:] else None
modeler.viz.stream._PATIENCE_S = 30.0 if sys.argv[4:] else 0.2
stream = modeler.viz.stream.open_stream("box", save=Path(sys.argv[1]), connect=watched)
most = int(sys.argv[2]) or resource.RLIM_INFINITY
resource.setrlimit(resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY))
for step in steps(2):
    stream(step)
if sys.argv[4:]:
    threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGHUP)).start()
with endable():
    stream.close()
"""


def streamed(path: Path, *options: str, status: int = 0) -> str:
    """Stream a run to a file in a process of its own, and return what that says."""
    settings = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    ended = spawned("-c", _STREAM, path, *options, settings=settings, timeout=60.0)
    assert ended.status == status, ended.err
    return ended.err


@pytest.mark.parametrize("short", quick_first([0.99, 0.9, 0.5]))
def test_a_disk_that_fills_at_any_piece_does_not_hold_the_process(
    run: list[Step], tmp_path: Path, short: float
) -> None:
    path = tmp_path / "r.rrd"
    assert "is truncated" not in streamed(path, "0")
    most = int(short * path.stat().st_size)
    assert f"{path}: is truncated (File too large)" in streamed(path, str(most))
    assert path.stat().st_size == most


def test_a_viewer_that_accepts_and_stays_silent_does_not_hold_the_process(tmp_path: Path) -> None:
    streamed(tmp_path / "r.rrd", "0", "watched")
    assert set(read(tmp_path / "r.rrd")[entities.NOW]) == {0, 1}


@pytest.mark.slow
def test_a_signal_while_a_silent_viewer_is_waited_for_ends_the_process(tmp_path: Path) -> None:
    began_s = time.monotonic()
    streamed(tmp_path / "r.rrd", "0", "watched", "ended", status=128 + signal.SIGHUP)
    assert time.monotonic() - began_s < 25.0


def test_a_viewer_that_is_far_behind_is_left_out(caplog: pytest.LogCaptureFixture, monkeypatch: Any) -> None:
    released, unregistered = threading.Event(), threading.Event()
    monkeypatch.setattr("rerun.unregister_shutdown", unregistered.set)
    monkeypatch.setattr("modeler.viz.viewer.STOP_S", 0.2)
    recording: Any = SimpleNamespace(disconnect=lambda: None)
    shown, begun = Shown(recording), threading.Event()
    shown.put(lambda _: (begun.set(), released.wait()))
    assert begun.wait(10.0)
    for _ in range(200):
        shown.put(lambda _: None)
    assert caplog.text.count("takes no data any more") == 1
    shown.close(lambda: None)
    assert unregistered.is_set()
    released.set()


def test_a_disk_that_hangs_does_not_hold_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    unregistered, released = threading.Event(), threading.Event()
    monkeypatch.setattr("rerun.unregister_shutdown", unregistered.set)
    monkeypatch.setattr("modeler.viz.stream._DISK_PATIENCE_S", 0.2)
    recording: Any = SimpleNamespace(disconnect=released.wait, set_sinks=lambda sink: None)
    file = RecordingFile(tmp_path / "r.rrd")
    file.attach(recording)
    file.close(recording)
    assert unregistered.is_set()
    assert "r.rrd: is truncated (the disk does not answer)" in caplog.text
    released.set()


@pytest.mark.parametrize("replaced", [False, True])
def test_a_recording_that_is_moved_meanwhile_is_written_again_unless_something_else_is_there(
    run: list[Step], tmp_path: Path, caplog: pytest.LogCaptureFixture, replaced: bool
) -> None:
    path, moved = tmp_path / "r.rrd", tmp_path / "moved"
    stream = open_stream("box", save=path)
    path.rename(moved)
    if replaced:
        path.write_bytes(b"other")
    stream(run[0])
    stream.close()
    assert path.read_bytes() == (b"other" if replaced else moved.read_bytes())
    assert f"{path}: was moved or removed" in caplog.text
    assert ("File exists" in caplog.text) == replaced


def closed_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_a_viewer_that_is_not_there_is_reported_and_left_out(
    run: list[Step], tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    address = f"rerun+http://127.0.0.1:{closed_port()}/proxy"
    with caplog.at_level(logging.WARNING):
        stream: RerunStream = open_stream("box", save=tmp_path / "r.rrd", spawn=True, connect=address)
    assert address in caplog.text
    assert "no display" in caplog.text
    assert stream.address is None
    stream(run[0])
    stream.close()
    assert set(read(tmp_path / "r.rrd")[entities.NOW]) == {0}


def test_a_stream_to_nowhere_takes_steps(run: list[Step]) -> None:
    stream = open_stream("box", save=None)
    stream(run[0])
    stream.close()
    assert stream.address is None


@pytest.mark.parametrize("address", ["localhost", "http://127.0.0.1:9876", "rerun+http://127.0.0.1:x/proxy"])
def test_a_wrong_address_is_refused(address: str) -> None:
    with pytest.raises(viewer.InputError, match=r"`connect` .*rerun\+http://127\.0\.0\.1:9876/proxy"):
        open_stream("box", save=None, connect=address)


@pytest.mark.parametrize("place", [f"{'a' * 300}:9876", "localhost:99999", "no such host:9876"])
def test_nobody_listens_where_nobody_can(place: str) -> None:
    assert not viewer.reachable(f"rerun+http://{place}/proxy")


def test_a_recording_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(viewer.InputError, match=r"r\.rrd"):
        open_stream("box", save=tmp_path / "missing" / "r.rrd")


def test_viewing_a_folder_without_a_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(viewer.InputError, match=r"no recording\.rrd .*modeler build"):
        viewer.view(tmp_path)


def test_a_recording_is_viewed_in_the_browser(run: list[Step], tmp_path: Path) -> None:
    record(tmp_path / "recording.rrd", run[:2])
    served = viewer.view(tmp_path, web=True)
    with urllib.request.urlopen(served.address, timeout=5.0) as page:
        assert b"<html" in page.read()
    page_address, _, source = served.address.partition("?url=")
    with urllib.request.urlopen(unquote(source), timeout=5.0) as answer:
        assert answer.read() == (tmp_path / "recording.rrd").read_bytes()
        assert answer.headers["Access-Control-Allow-Origin"] == page_address  # to no other page
    served.stop()
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(unquote(source), timeout=5.0)


def answer(port: int, request: bytes, *, reset: bool = False) -> bytes:
    """Return what a server on this machine answers to bytes; nothing where the connection is reset at once."""
    with socket.create_connection(("127.0.0.1", port), timeout=5.0) as connection:
        connection.sendall(request)
        if reset:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            return b""
        return b"".join(iter(lambda: connection.recv(1 << 16), b""))


def test_a_recording_is_served_to_this_machine_alone_and_quietly(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    recording = tmp_path / "recording.rrd"
    recording.write_bytes(bytes(50_000_000))
    server = viewer._file_server(recording, "http://127.0.0.1:1")
    port = server.server_port
    for host, status in ((f"127.0.0.1:{port}", b"200"), (f"evil.example:{port}", b"421"), ("evil.example", b"421")):
        got = answer(port, f"GET /recording.rrd HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
        assert got.split()[1] == status
        assert (len(got) > 50_000_000) == (status == b"200")
    assert answer(port, b"GET / HTTP/1.0\r\n\r\n").split()[1] == b"421"
    named = f"GET / HTTP/1.1\r\nHost: localhost:{port}\r\n\r\n".encode()
    answer(port, named, reset=True)
    answer(port, b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(200) + b"\r\n\r\n")
    recording.unlink()
    assert answer(port, named).split()[1] == b"404"
    os.mkfifo(recording)
    assert answer(port, named).split()[1] == b"404"
    server.shutdown()
    server.server_close()
    assert capfd.readouterr() == ("", "")


@contextmanager
def command(program: str, path: Path) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """Run a program of Python in a process of its own; yield that and the number of the server's, which it prints."""
    arguments = [sys.executable, "-c", program, str(path)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, env=environment) as process:
        yield process, int(process.stdout.readline())


@pytest.mark.parametrize("number", quick_first([signal.SIGINT, signal.SIGTERM]))
def test_the_server_ends_with_the_command_that_waits_for_it(run: list[Step], tmp_path: Path, number: int) -> None:
    record(tmp_path / "recording.rrd", run[:1])
    program = (
        "import sys, pathlib, signal; from modeler.viz import viewer;"
        "signal.signal(signal.SIGINT, signal.default_int_handler);"
        "served = viewer.view(pathlib.Path(sys.argv[1]), web=True);"
        "print(served.process.pid, flush=True); served.wait()"
    )
    with command(program, tmp_path) as (process, server):
        time.sleep(0.2)  # from the line to the wait
        process.send_signal(number)
        assert process.wait(timeout=10.0) == 0
    with pytest.raises(ProcessLookupError):
        os.kill(server, 0)


@pytest.mark.skipif(sys.platform != "linux", reason="Linux ends a process with its parent")
def test_the_server_ends_with_its_parent_however_that_ends(run: list[Step], tmp_path: Path) -> None:
    record(tmp_path / "recording.rrd", run[:1])
    program = (
        "import sys, pathlib, time; from modeler.viz import viewer;"
        "print(viewer.view(pathlib.Path(sys.argv[1]), web=True).process.pid, flush=True); time.sleep(60)"
    )
    with command(program, tmp_path) as (process, server):
        assert b"rerun" in Path(f"/proc/{server}/cmdline").read_bytes()
        process.kill()
    deadline = time.monotonic() + 10.0
    while running(server):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def running(process: int) -> bool:
    """Return whether a process runs: one that has ended stays a zombie where nobody waits for it."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_an_idle_server_takes_no_processor_time(run: list[Step], tmp_path: Path) -> None:
    record(tmp_path / "recording.rrd", run)
    served = viewer.view(tmp_path, web=True)
    streamed = open_stream("box", save=None, web=True)
    streamed(run[0])
    servers = (served, *streamed.viewers)
    time.sleep(0.5)
    before_s = [processor_s(server.process.pid) for server in servers]
    time.sleep(1.0)
    for server, start_s in zip(servers, before_s, strict=True):
        assert processor_s(server.process.pid) - start_s < 0.1
    served.stop()
    streamed.close()


def processor_s(process: int) -> float:
    """Return the processor time that a process has taken."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def test_a_run_that_is_terminated_leaves_a_whole_recording_and_no_server(tmp_path: Path) -> None:
    program = (
        "import sys, pathlib, time; from modeler.cli.console import endable; from turning_box import steps;"
        "from modeler.viz.stream import open_stream\n"
        "with endable():\n"
        "    stream = open_stream('box', save=pathlib.Path(sys.argv[1]), web=True)\n"
        "    try:\n"
        "        stream(next(steps(1)))\n"
        "        print(stream.viewers[0].process.pid, flush=True)\n"
        "        time.sleep(60)\n"
        "    finally:\n"
        "        stream.close()\n"
    )
    with command(program, tmp_path / "r.rrd") as (process, server):
        process.terminate()
        assert process.wait(timeout=20.0) == 128 + signal.SIGTERM
    with pytest.raises(ProcessLookupError):
        os.kill(server, 0)
    assert set(read(tmp_path / "r.rrd")[entities.NOW]) == {0}


def test_rerun_is_not_imported_before_it_is_needed() -> None:
    program = "import sys; from modeler.viz import entities, stream, viewer; sys.exit('rerun' in sys.modules)"
    assert spawned("-c", program).status == 0


@pytest.mark.slow
def test_the_notebook_runs_and_embeds_the_viewer(monkeypatch: pytest.MonkeyPatch) -> None:
    display = pytest.importorskip("IPython.display")
    shown: list[Any] = []
    monkeypatch.setattr(display, "display", shown.append)
    notebook = json.loads((Path(__file__).parents[1] / "docs" / "watch.ipynb").read_text())
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    whole = 'open_sequence(bundled("box"))'
    assert sum(whole in cell for cell in cells) == 1
    names: dict[str, Any] = {}
    for cell in cells:
        exec(cell.replace(whole, f"{whole}.select(frames=slice(0, 3))"), names)
    (frame,) = shown
    assert frame.src.startswith("http://127.0.0.1:")
    assert len(names["result"].solution.trajectory) == 3
    assert names["stream"].viewers[0].process.poll() is not None
