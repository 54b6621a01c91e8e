"""Batches on engines that are not always there: a Dask scheduler with two workers as processes, and submitit's jobs."""

import importlib.util
import os
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from command_runner import QUICK
from fake_builder import BOOK, book, sequence, started, wait_for

from modeler.batch.models import TABLE

HERE = Path(__file__).parent
PAIRS, SEQUENCES = 6, 6
with_dask = pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="distributed is not installed")
with_submitit = pytest.mark.skipif(importlib.util.find_spec("submitit") is None, reason="submitit is not installed")
pytestmark = pytest.mark.slow

WORKER = """
import sys
from modeler.batch import jobs
from distributed.cli.dask_worker import main
jobs.BUILDER = "fake_builder"
{more}
main()
"""
FULL_DISK = """
def full(job):
    raise OSError(28, "No space left on device")
jobs.run = full
"""


class Cluster:
    """A scheduler and workers, each a process."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.folder = folder
        self.processes: list[subprocess.Popen[bytes]] = []
        self.scheduler = self.schedule()

    @property
    def address(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    def start(self, *command: str) -> subprocess.Popen[bytes]:
        with open(self.folder / "cluster.log", "ab") as log:
            self.processes.append(subprocess.Popen([sys.executable, *command], stdout=log, stderr=log))
        return self.processes[-1]

    def schedule(self) -> subprocess.Popen[bytes]:
        where = ("--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard")
        return self.start("-m", "distributed.cli.dask_scheduler", *where)

    def work(self, more: str = "") -> subprocess.Popen[bytes]:
        where = ("--no-nanny", "--nthreads", "1", "--no-dashboard", "--local-directory", str(self.folder / "dask"))
        return self.start("-c", WORKER.format(more=more), self.address, *where)

    def end(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(HERE.parent), str(HERE)]))
    cluster = Cluster(tmp_path)
    try:
        yield cluster
    finally:
        cluster.end()


def sequences(folder: Path, pause_s: float) -> list[Path]:
    return [sequence(folder / f"s{k}", pairs=PAIRS, pause_s=pause_s) for k in range(SEQUENCES)]


def check_book(out: Path, losses: int) -> None:
    """Check that nothing is lost, and nothing done twice but the pairs that were under way at so many losses."""
    times = Counter(book(out))
    assert times.keys() == {(f"s{k}", pair) for k in range(SEQUENCES) for pair in range(PAIRS)}
    assert sum(times.values()) - len(times) <= losses
    assert pq.read_table(out / TABLE)["status"].to_pylist() == [0] * SEQUENCES


@with_dask
def test_a_worker_that_is_killed_loses_a_pair_at_most(cluster: Cluster, tmp_path: Path) -> None:
    workers = [cluster.work(), cluster.work()]
    out = tmp_path / "out"
    batch = started(*sequences(tmp_path, 0.3), "--out", out, "--executor", f"dask:{cluster.address}")
    wait_for(lambda: len(book(out)) >= 4)
    workers[0].kill()
    cluster.work()
    said = batch.communicate(timeout=120.0)[1]
    assert (batch.returncode, "Traceback" in said) == (0, False), said
    check_book(out, 1)


@with_dask
def test_a_scheduler_that_is_started_anew_loses_a_pair_of_each_worker_at_most(cluster: Cluster, tmp_path: Path) -> None:
    for _ in range(2):
        cluster.work()
    out = tmp_path / "out"
    batch = started(*sequences(tmp_path, 0.3), "--out", out, "--executor", f"dask:{cluster.address}")
    wait_for(lambda: len(book(out)) >= 4)
    cluster.scheduler.kill()
    cluster.scheduler.wait()
    time.sleep(1.0)
    cluster.schedule()
    for _ in range(2):  # those of before may have given up
        cluster.work()
    said = batch.communicate(timeout=200.0)[1]
    assert (batch.returncode, "Traceback" in said) == (0, False), said
    assert "waiting for it" in said
    check_book(out, 2)


@with_dask
def test_a_worker_without_room_on_its_disk_loses_nothing(cluster: Cluster, tmp_path: Path) -> None:
    full = cluster.work(FULL_DISK)
    out, folders = tmp_path / "out", sequences(tmp_path, 0.0)
    command = (*folders, "--out", out, "--executor", f"dask:{cluster.address}")
    batch = started(*command)
    said = batch.communicate(timeout=120.0)[1]
    assert batch.returncode == 3
    assert said.count("No space left on device") == SEQUENCES
    assert not book(out)
    full.kill()
    cluster.work()
    again = started(*command)
    assert again.communicate(timeout=120.0)[1].count("\n") == 2
    assert again.returncode == 0
    check_book(out, 0)


@with_dask
def test_a_scheduler_that_is_not_there_is_said_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(HERE.parent), str(HERE)]))
    for address in ("tcp://127.0.0.1:9", "nonsense://x"):
        batch = started(sequence(tmp_path / address[:3]), "--out", tmp_path / "out", "--executor", f"dask:{address}")
        said = batch.communicate(timeout=120.0)[1]
        assert (batch.returncode, said.count("\n")) == (2, 1), said
        assert "no scheduler answers there" in said


@with_submitit
def test_a_job_of_submitit_that_is_killed_loses_a_pair_at_most(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(HERE.parent), str(HERE)]))
    (tmp_path / "sitecustomize.py").write_text("from modeler.batch import jobs; jobs.BUILDER = 'fake_builder'")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ["PYTHONPATH"]]))
    out, jobs = tmp_path / "out", tmp_path / "jobs"
    batch = started(*sequences(tmp_path, 0.3), "--out", out, "--executor", f"slurm:{jobs}", "--workers", "2")
    wait_for(lambda: book(out))
    first = int((out / BOOK).read_text().split()[2])
    os.kill(int(Path(f"/proc/{first}/stat").read_text().rpartition(")")[2].split()[1]), signal.SIGKILL)
    said = batch.communicate(timeout=240.0)[1]
    assert batch.returncode == 0, said
    check_book(out, 2)


@with_submitit
def test_jobs_of_submitit_run_here_where_there_is_no_slurm(
    scene: Path, built: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(HERE.parent))
    command = [sys.executable, "-m", "modeler", "batch", str(scene), "--out", str(tmp_path / "out"), *QUICK]
    jobs = tmp_path / "jobs"
    ended = subprocess.run([*command, "--executor", f"slurm:{jobs}"], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout) == (0, ""), ended.stderr
    assert "Traceback" not in ended.stderr
    assert (tmp_path / "out" / "box" / "model.ply").read_bytes() == (built / "model.ply").read_bytes()
    assert list(jobs.iterdir())
