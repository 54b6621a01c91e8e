"""Many sequences: what is done, resumed, tried again and listed, by what is on the disk; and two that are built."""

import json
import os
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from command_runner import QUICK, Run, refusal_of
from fake_builder import PATIENCE_S, book, run_here, sequence, started, wait_for
from slow_cases import quick_first

from modeler.batch import engines, jobs
from modeler.batch.jobs import NOTES, Job, fingerprint, standing
from modeler.batch.models import TABLE, models_in, write_models
from modeler.cli import parsed
from modeler.cli.manifest import Row, named, read_manifest
from modeler.types import InputError
from studies.kills.trials import SAME

HERE = Path(__file__).parent
_IN_PROCESSES = jobs.Processes.run


@pytest.fixture(autouse=True)
def _stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Build in this process, and in processes of their own where a batch is `started`."""
    monkeypatch.setattr(jobs.Processes, "run", run_here)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(HERE.parent), str(HERE)]))


def rows(out: Path) -> dict[str, dict[str, Any]]:
    return {row["name"]: row for row in pq.read_table(out / TABLE).to_pylist()}


def test_each_sequence_is_built_once_and_its_status_is_kept(cli: Run, tmp_path: Path) -> None:
    out = tmp_path / "out"
    good, bad = sequence(tmp_path / "good"), sequence(tmp_path / "bad", status=3)
    worse = sequence(tmp_path / "worse", status=2)
    ended = cli("batch", good, bad, worse, "--out", out)
    assert (ended.status, ended.out) == (3, "")
    assert ended.err.count("worse failed:") == 1
    assert f"{worse}: cannot be built" in ended.err
    assert "1 of 3 models can be trusted, 1 cannot, 1 sequence failed" in ended.err
    assert Counter(book(out)) == Counter([(name, pair) for name in ("good", "bad", "worse") for pair in range(3)])
    stated = rows(out)
    assert {name: row["status"] for name, row in stated.items()} == {"good": 0, "bad": 3, "worse": 2}
    assert [stated[name]["tries"] for name in ("good", "bad", "worse")] == [0, 0, 2]
    assert stated["bad"]["reasons"] == ["made up"]
    assert stated["worse"]["failure"] == f"{worse}: cannot be built"
    assert stated["good"]["sequence"] == str(good)
    before = len(book(out))
    again = cli("batch", good, bad, worse, "--out", out)
    assert again.status == 3
    assert "2 done, 1 failed twice, 0 to be resumed, 0 to be built" in again.err
    assert len(book(out)) == before
    assert rows(out) == stated
    assert cli("batch", good, "--out", out).status == 0


STATES = {
    "deep": "[" * 100_000,
    "none": "[]",
    "large": '{"status": 1180591620717411303424}',
    "negative": '{"status": 0, "tries": -1}',
    "text": '{"status": "0"}',
    "arguments": '{"arguments": [3]}',
    "other": '{"something": {}}',
    "record": '{"status": 0, "record": {"frames": 1180591620717411303424}}',
    "frames": '{"status": 0, "record": {"frames": "three"}}',
}


@pytest.mark.parametrize("content", STATES)
def test_a_state_that_nobody_wrote_is_none(tmp_path: Path, content: str) -> None:
    (tmp_path / NOTES).mkdir()
    (tmp_path / NOTES / "a.json").write_text(STATES[content])
    write_models(tmp_path)
    (row,) = rows(tmp_path).values()
    assert {name: value for name, value in row.items() if value is not None} == {"name": "a", "tries": 0}
    job = Job("a", str(tmp_path / "s"), str(tmp_path))
    assert standing(job) == "new"


def test_logs_and_states_lead_nowhere_and_hold_nobody_up(cli: Run, tmp_path: Path) -> None:
    out, other = tmp_path / "out", tmp_path / "other"
    sequences = [sequence(tmp_path / name) for name in ("linked", "piped")]
    (out / NOTES).mkdir(parents=True)
    other.write_text("kept")
    for ending in ("log", "json"):
        (out / NOTES / f"linked.{ending}").symlink_to(other)
        os.mkfifo(out / NOTES / f"piped.{ending}")
    ended = cli("batch", *sequences, "--out", out)
    assert ended.status == 0, ended.err
    assert other.read_text() == "kept"


def test_what_fails_once_is_tried_again_and_goes_on_where_it_was(cli: Run, tmp_path: Path) -> None:
    out = tmp_path / "out"
    once, ever = sequence(tmp_path / "once", fails=1), sequence(tmp_path / "ever", fails=9)
    assert cli("batch", once, ever, "--out", out).status == 3
    assert {name: row["status"] for name, row in rows(out).items()} == {"once": 0, "ever": 128 + signal.SIGABRT}
    assert "was killed by signal 6" in rows(out)["ever"]["failure"]
    assert Counter(book(out)).most_common(1)[0][1] == 1
    (tmp_path / "out" / "ever" / "failed").write_text("x" * 9)
    assert cli("batch", once, ever, "--out", out).status == 3
    assert cli("batch", once, ever, "--out", out, "--again").status == 0
    assert Counter(book(out)).most_common(1)[0][1] == 1


def test_what_failed_is_tried_again_once_its_input_has_changed(cli: Run, tmp_path: Path) -> None:
    folder = sequence(tmp_path / "s", status=2)
    assert cli("batch", folder, "--out", tmp_path / "out").status == 3
    shutil.rmtree(folder)
    sequence(folder)
    assert cli("batch", folder, "--out", tmp_path / "out").status == 0


def test_models_are_built_anew_only_where_that_is_asked_for(
    cli: Run, refusal: Callable[..., str], tmp_path: Path
) -> None:
    out, folder = tmp_path / "out", sequence(tmp_path / "s")
    other = sequence(tmp_path / "t")
    assert cli("batch", folder, other, "--out", out).status == 0
    for change in (("--seed", "1"), ("--prior", "table")):
        assert "--overwrite" in refusal("batch", folder, other, "--out", out, *change)
    os.utime(folder / "given.json", (1, 1))
    assert cli("batch", folder, other, "--out", out).status == 0
    assert len(book(out)) == 6
    (folder / "given.json").write_text((folder / "given.json").read_text() + " ")
    ended = cli("batch", folder, other, "--out", out)
    assert ended.status == 0
    assert "the input of s has changed" in ended.err
    assert Counter(name for name, _ in book(out)) == {"s": 6, "t": 3}
    assert cli("batch", folder, other, "--out", out, "--overwrite").status == 0
    assert len(book(out)) == 9
    shutil.rmtree(out / "t")
    assert cli("batch", folder, other, "--out", out).status == 0
    assert Counter(name for name, _ in book(out)) == {"s": 6, "t": 6}


def test_names_do_not_collide_and_are_kept(cli: Run, tmp_path: Path) -> None:
    first, second, third = (sequence(tmp_path / name / "s") for name in ("a", "b", "c"))
    out = tmp_path / "out"
    assert cli("batch", first, second, "--out", out).status == 0
    names = {row["sequence"]: name for name, row in rows(out).items()}
    assert names[str(first)] == "s"
    assert len(set(names.values())) == 2
    assert cli("batch", third, second, first, "--out", out).status == 0
    after = {row["sequence"]: name for name, row in rows(out).items()}
    assert after.items() > names.items()
    assert len(set(after.values())) == 3
    assert len(book(out)) == 9


@pytest.mark.parametrize(
    ("name", "becomes"), [("a b", "a_b"), ("..x", "x"), ("models.parquet", "models.parquet_"), ("Größe", "Größe")]
)
def test_names_are_those_of_folders_and_differ_in_more_than_case(tmp_path: Path, name: str, becomes: str) -> None:
    first, second = named([Row(tmp_path / "a" / name, ""), Row(tmp_path / "b" / name.upper(), "")], tmp_path)
    assert first == becomes
    assert second.casefold() != first.casefold()


def manifest(folder: Path, text: str) -> Path:
    path = folder / "list.csv"
    path.write_text(text)
    return path


def test_rows_of_a_manifest_have_options_of_their_own(cli: Run, tmp_path: Path) -> None:
    for name in "ab":
        sequence(tmp_path / name)
    cells = f"{tmp_path / 'a'},cup,turntable,-24,1 2 3 4,no\n{tmp_path / 'b'},,,,,yes\n"
    path = manifest(tmp_path, f"sequence,name,prior,step_deg,roi,colour\n{cells}")
    assert cli("batch", "--manifest", path, "--out", tmp_path / "out", "--prior", "table").status == 0
    notes = {note.stem: json.loads(note.read_text()) for note in (tmp_path / "out" / NOTES).glob("*.json")}
    assert notes.keys() == {"cup", "b"}
    assert notes["b"]["arguments"] == ["--prior", "table"]
    build = parsed(["build", "S", "--out", "R", *notes["cup"]["arguments"]])
    settings = build.settings()  # type: ignore[union-attr]
    assert build.prior.prior == "turntable"  # type: ignore[union-attr]
    assert (settings["step_deg"], settings["roi"], settings["colour"]) == (-24.0, (1, 2, 3, 4), False)


FAULTS = {
    "no column": ("a,b\n1,2\n", "no column sequence"),
    "strange column": ("sequence,sku\ns,1\n", "column sku is not an option"),
    "column of another kind": ("sequence,resume\ns,yes\n", "column resume is not an option"),
    "column twice": ("sequence,step_deg,step-deg\ns,1,1\n", "twice"),
    "no sequence": ("sequence,prior\n,table\n", "row 2 names no sequence"),
    "too few cells": ("sequence,prior\ns\n", "row 2 has a different number of cells"),
    "too many cells": ("sequence\ns,1,2\n", "row 2 has a different number of cells"),
    "wrong value": ("sequence,step-deg\ns,1\ns,fast\n", "row 3: "),
    "no flag": ("sequence,colour\ns,perhaps\n", "write yes or no"),
    "sequence twice": ("sequence\ns\ns\n", "row 3: is the same sequence as"),
    "name twice": ("sequence,name\ns,a\nt,A\n", "the name A is given twice"),
    "name no folder": ("sequence,name\ns,../a\n", "is not a valid folder name"),
    "empty": ("", "no column sequence"),
    "no row": ("sequence\n", "no sequence to build"),
    "quotes": ('sequence\n"s"x\n', "not a CSV table"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_manifest_that_cannot_be_used_is_refused(refusal: Callable[..., str], tmp_path: Path, fault: str) -> None:
    text, says = FAULTS[fault]
    assert says in refusal("batch", "--manifest", manifest(tmp_path, text), "--out", tmp_path / "out")
    assert not list((tmp_path / "out").glob("*"))


def test_options_that_cannot_be_used_are_refused(cli: Run, refusal: Callable[..., str], tmp_path: Path) -> None:
    folder = sequence(tmp_path / "s")
    (tmp_path / "my_engines.py").write_text("def none(workers):\n    return workers\n")
    refusal("batch", "--out", tmp_path / "out")
    executors = [("--executor", name) for name in ("kubernetes", "dask:", "no_such_module:thing")]
    for options in (("--workers", "0"), (folder,), *executors):
        refusal("batch", folder, *options, "--out", tmp_path / "out")
    assert cli("batch", folder, "--out", folder / "out").status == 2
    assert cli("batch", folder, "--out", folder).status == 2
    assert sorted(path.name for path in folder.iterdir()) == ["given.json"]


LAGGING = """
import os, threading
from concurrent.futures import Future, Executor


class Lagging(Executor):  # what a machine elsewhere wrote is seen here a second later than it says so
    def submit(self, run, job):
        ended, note = Future(), job.note
        result = run(job)
        os.rename(note, f"{note}.hidden")
        threading.Timer(1.0, os.rename, (f"{note}.hidden", note)).start()
        ended.set_result(result)
        return ended


def make(workers):
    return Lagging()
"""


def test_an_executor_of_ones_own_is_a_callable(cli: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, out = sequence(tmp_path / "s"), tmp_path / "out"
    (tmp_path / "my_engine.py").write_text(
        "from concurrent.futures import ThreadPoolExecutor\n\n\n"
        "def make(workers):\n    return ThreadPoolExecutor(workers)\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    assert cli("batch", folder, "--out", out, "--executor", "my_engine:make").status == 0
    assert len(book(out)) == 3
    (tmp_path / "my_engine.py").write_text(LAGGING)
    sys.modules.pop("my_engine")
    late = sequence(tmp_path / "late")
    assert cli("batch", late, "--out", out, "--executor", "my_engine:make").status == 0
    assert {name: row["status"] for name, row in rows(out).items()} == {"s": 0, "late": 0}
    (tmp_path / "my_engine.py").write_text("def make(workers):\n    return workers\n")
    sys.modules.pop("my_engine")
    ended = cli("batch", folder, sequence(tmp_path / "t"), "--out", out, "--executor", "my_engine:make")
    assert ended.status == 2
    assert "returns no concurrent.futures.Executor" in ended.err


def test_an_engine_that_does_not_come_back_is_said(cli: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, out, opened = sequence(tmp_path / "s"), tmp_path / "out", list[str]()

    class Lost(Executor):
        def submit(self, run: Any, /, *_: Any, **__: Any) -> Future[Any]:
            ended = Future[Any]()
            ended.cancel()
            ended.set_running_or_notify_cancel()
            return ended

    @contextmanager
    def engine(name: str, workers: int | None) -> Iterator[Executor]:
        opened.append(name)
        if len(opened) > jobs_lost:
            raise InputError(f"`executor` {name}: no scheduler answers there; start one")
        yield Lost()

    jobs_lost = 4  # as often as an engine may lose a job, and once more
    monkeypatch.setattr(engines, "engine", engine)
    monkeypatch.setattr(engines, "_RETURNS_S", 0.1)
    ended = cli("batch", folder, "--out", out)
    assert ended.status == 3
    assert "the engine lost it (CancelledError" in ended.err
    jobs_lost, opened[:] = 1, []
    ended = cli("batch", sequence(tmp_path / "t"), "--out", out)
    assert (ended.status, ended.err.count("\n")) == (2, 3)
    assert "waiting for it" in ended.err
    assert "no scheduler answers there" in ended.err


def test_clocks_of_machines_may_differ(cli: Run, tmp_path: Path) -> None:
    """What is done follows from contents; times are those of whatever machine wrote a file."""
    folders, out = [sequence(tmp_path / name) for name in "ab"], tmp_path / "out"
    assert cli("batch", *folders, "--out", out).status == 0
    before = book(out)
    for place, path in enumerate(path for path in tmp_path.rglob("*") if path.is_file()):
        os.utime(path, (time.time() + (-1) ** place * 86400.0,) * 2)
    assert "2 done" in cli("batch", *folders, "--out", out).err
    assert book(out) == before


def test_a_disk_that_shows_late_what_others_wrote_is_waited_for(
    cli: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks, read = list[Path](), engines.read_note

    def late(path: Path) -> dict[str, Any]:
        looks.append(path)
        return {} if len(looks) < 3 else read(path)

    monkeypatch.setattr(engines, "read_note", late)
    assert cli("batch", sequence(tmp_path / "s"), "--out", tmp_path / "out").status == 0
    assert looks == [tmp_path / "out" / NOTES / "s.json"] * 3


def test_workers_fit_into_memory_and_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    assert 0 < engines.free_bytes() < 1 << 50
    monkeypatch.setattr(engines, "cores", lambda: 8)
    for free, workers in ((0, 1), (2 * engines.JOB_BYTES, 2), (100 * engines.JOB_BYTES, 8)):
        monkeypatch.setattr(engines, "free_bytes", lambda free=free: free)
        assert engines.usual_workers() == workers
        assert engines.threads_of("processes", workers) * workers == 8
    assert engines.threads_of("dask:x", 1) == 1


def alive(out: Path) -> set[int]:
    """Return which of the processes that wrote into the book of a batch are still there."""
    pids = {int(line.split()[2]) for line in (out / "book.txt").read_text().splitlines()}

    def running(pid: int) -> bool:
        try:
            return "fake_builder" in Path(f"/proc/{pid}/cmdline").read_text()
        except OSError:
            return False

    return set(filter(running, pids))


@pytest.mark.parametrize("how", quick_first([signal.SIGKILL, signal.SIGINT, signal.SIGTERM]))
def test_what_is_interrupted_loses_a_pair_of_each_sequence_at_most(
    cli: Run, tmp_path: Path, how: signal.Signals
) -> None:
    out = tmp_path / "out"
    folders = [sequence(tmp_path / f"s{k}", pairs=4, pause_s=0.3) for k in range(3)]
    process = started(*folders, "--out", out, "--workers", 2)
    wait_for(lambda: len(book(out)) >= 4)
    process.send_signal(how)
    said = process.communicate(timeout=PATIENCE_S)[1]
    assert process.returncode == {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -9}[how]
    assert "Traceback" not in said
    assert (out / TABLE).exists() is (how != signal.SIGKILL)
    wait_for(lambda: not alive(out))  # builds end with whoever started them
    before = len(book(out))
    assert before < 12
    assert cli("batch", *folders, "--out", out, "--workers", 2).status == 0
    times = Counter(book(out))
    assert times.keys() == {(f"s{k}", pair) for k in range(3) for pair in range(4)}
    assert all(sum(times[f"s{k}", pair] - 1 for pair in range(4)) <= 1 for k in range(3))


def test_a_folder_has_one_batch_at_a_time(cli: Run, tmp_path: Path) -> None:
    out, folder = tmp_path / "out", sequence(tmp_path / "s", pairs=20, pause_s=0.2)
    process = started(folder, "--out", out)
    wait_for(lambda: book(out))
    ended = cli("batch", folder, "--out", out)
    process.kill()
    process.communicate(timeout=PATIENCE_S)
    assert "another run is writing to it" in refusal_of(ended)


def test_who_works_on_a_sequence_is_waited_for(tmp_path: Path) -> None:
    """As where an engine takes a worker for dead that is not: the second finds the sequence done."""
    from concurrent.futures import ThreadPoolExecutor

    job = Job("s", str(sequence(tmp_path / "s", pairs=5, pause_s=0.1)), str(tmp_path / "out"))
    with ThreadPoolExecutor() as threads, jobs.PROCESSES.ended():
        ends = [future.result() for future in [threads.submit(jobs.run, job) for _ in range(2)]]
    assert [end is not None and end.status for end in ends] == [0, 0]
    assert book(tmp_path / "out") == [("s", pair) for pair in range(5)]


def test_the_input_is_recognised_by_its_content(tmp_path: Path) -> None:
    folder = sequence(tmp_path / "s")
    (folder / "circle").symlink_to(folder)
    calibration = tmp_path / "noise.json"
    calibration.write_text("1")
    job = Job("s", str(folder), str(tmp_path), ("--sensor", str(calibration)))
    contents = [fingerprint(job, content=True)]
    os.utime(folder / "given.json", (1, 1))
    assert fingerprint(job, content=True) == contents[0]
    for change in (
        lambda: calibration.write_text("2"),
        lambda: (folder / "more").write_text(""),
        lambda: (folder / "more").write_text("x"),
        lambda: (folder / "more").rename(folder / "other"),
    ):
        change()
        contents.append(fingerprint(job, content=True))
    assert len(set(contents)) == 5
    assert standing(job) == "new"


def test_a_manifest_may_come_from_a_spreadsheet_and_say_what_its_input_does_not(tmp_path: Path) -> None:
    path = tmp_path / "list.csv"
    path.write_bytes('\ufeffsequence,depth-scale-mm,along-ray\r\n"a, b",0.5,yes\r\n'.encode())
    options = ("--depth-scale-mm", "0.5", "--along-ray")
    assert read_manifest(path) == [Row(Path("a, b"), f"{path}: row 2", "", options)]


@pytest.fixture
def _builds(_stand_in: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jobs.Processes, "run", _IN_PROCESSES)


@pytest.mark.usefixtures("_builds")
def test_models_are_those_of_single_builds(cli: Run, scene: Path, built: Path, tmp_path: Path) -> None:
    """To the bit, though with other threads; what the list says is what the report says, and the mesh measures."""
    out = tmp_path / "out"
    assert cli("batch", scene, "--out", out, *QUICK).status == 0
    for file in SAME:
        assert (out / "box" / file).read_bytes() == (built / file).read_bytes()
    report = json.loads((out / "box" / "report.json").read_text())
    row = rows(out)["box"]
    assert (row["status"], row["trustworthy"], row["frames"], row["accepted"]) == (0, True, 3, 3)
    assert row["seconds"] == report["seconds"]["total"]
    assert row["prior"] == "table"
    assert json.loads(row["settings"]) == report["settings"]
    assert json.loads(row["versions"]) == report["versions"]
    assert 0.0 < row["rotation_error_deg"] < 5.0
    assert 0.0 < row["translation_error_m"] < 0.01
    assert 0.15 < row["height_m"] < 0.19  # the box is 130 x 75 x 180 mm
    assert 0.0004 < row["volume_m3"] < 0.0018
    assert 1e-5 < row["surface_sigma_m"] < 5e-3
    shutil.copytree(built, out / "by-hand")
    assert {row["name"]: row["status"] for row in models_in(out)} == {"box": 0, "by-hand": 0}


@pytest.mark.slow
@pytest.mark.usefixtures("_builds")
def test_pages_are_written_where_that_is_asked_for_and_linked(cli: Run, scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert cli("batch", scene, "--out", out, *QUICK, "--pages").status == 0
    assert "</html>" in (out / "box" / "report.html").read_text()
    assert cli("gallery", out).status == 0
    assert '"link":"box/report.html"' in (out / "gallery.html").read_text()
