"""What surrounds a command: bars where somebody watches, streams, signals and limits that become no traceback."""

import contextlib
import os
import pty
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_runner import BOX, QUICK, refusal_of, spawned

from modeler.cli import main
from modeler.cli.console import Console, Interrupt, as_options, endable
from modeler.cli.convert import Info
from modeler.cli.reading import reading
from modeler.composition.compose import check_region
from modeler.composition.options import ObjectOptions
from modeler.sequences import bundled, open_sequence
from modeler.sequences.opening import END
from modeler.types import (
    Failed,
    Fusing,
    Outcome,
    PriorRefused,
    Reason,
    Refining,
    Searching,
    Segmentation,
    Solution,
    Step,
)
from modeler.verdict.advice import outcome_advice

COMMAND = [sys.executable, "-m", "modeler"]
FEW = Outcome.TOO_FEW_POINTS


def test_parameters_that_a_message_names_are_printed_as_options() -> None:
    """Those of commands and of groups of options; other words in backticks stay as they are."""
    assert as_options("give `roi` and `max_depth_m`: `purpose` print") == "give --roi and --max-depth-m: --for print"
    assert as_options("write `fx fy cx cy`, run `modeler`") == "write `fx fy cx cy`, run `modeler`"


def test_a_watched_sequence_is_the_same_without_a_bar_where_stderr_is_no_terminal(
    capfd: pytest.CaptureFixture[str],
) -> None:
    whole = open_sequence(bundled("tube")).select(frames=slice(0, 2))
    with reading() as watched:
        same = watched(whole, "reading")
        assert (same.indices, same.name, same.sensor()) == (whole.indices, whole.name, whole.sensor())
        for one, other in zip(same, whole, strict=True):
            np.testing.assert_array_equal(one.depth_m, other.depth_m)
    with Console(25, None) as console:
        console(Searching(12))
    assert capfd.readouterr() == ("", "")


def given(outcomes: Iterable[tuple[int, Reason | None]], capfd: pytest.CaptureFixture[str]) -> list[str]:
    """Return the lines that are said of frames, by number, that end so."""
    frame = next(iter(open_sequence(bundled("tube"))))
    nothing = Segmentation(np.zeros_like(frame.depth_m, dtype=bool), None, FEW)
    lost = Step(frame, nothing, None, (), (), None, Solution())
    with Console(99, None) as console:
        for number, outcome in outcomes:
            console(replace(lost, frame=replace(frame, index=number), left_out=outcome))
    return capfd.readouterr().err.splitlines()


def test_a_frame_left_out_is_reported_once_and_so_is_that_it_was_placed(capfd: pytest.CaptureFixture[str]) -> None:
    left_out, placed = given([(0, Failed(FEW)), (0, Failed(FEW)), (0, None)], capfd)
    assert left_out.startswith(f"modeler: frame 0 is left out: {FEW.label}")
    assert placed.startswith("modeler: frame 0 is placed")


def test_what_to_do_about_frames_left_out_is_reported_once(capfd: pytest.CaptureFixture[str]) -> None:
    unsure = Outcome.UNSURE_MASK
    refusals = [PriorRefused(f"frames {frame} and 2 show no plane; show it") for frame in (3, 4)]
    said = given(enumerate([Failed(FEW), Failed(FEW), Failed(unsure), *refusals]), capfd)
    few, doubtful = (as_options(outcome_advice(outcome)) for outcome in (FEW, unsure))
    assert [(few in line, doubtful in line, "show it" in line) for line in said] == [
        (True, False, False), (False, False, False), (False, True, False), (False, False, True), (False, False, False)
    ]  # fmt: skip
    for words, line in zip((FEW.label, FEW.label, unsure.label), said, strict=False):
        assert words in line


def test_frames_that_are_left_out_in_a_row_are_reported_together(capfd: pytest.CaptureFixture[str]) -> None:
    lost = Failed(FEW)
    said = given(enumerate([None, *[lost] * 8, None, lost, lost]), capfd)
    assert [line.partition(" left out")[0] for line in said] == [
        *(f"modeler: frame {number} is" for number in (1, 2, 3, 4)),
        "modeler: frames 5 to 8 are",
        *(f"modeler: frame {number} is" for number in (10, 11)),
    ]


def on_a_terminal(
    act: Callable[[], object], monkeypatch: pytest.MonkeyPatch, heard: Callable[[bytes], object] = bytes
) -> str:
    """Return what is written to a terminal that is stderr while something is done; `heard` gets it as it grows."""
    ours, theirs = pty.openpty()
    said = list[bytes]()

    def listen() -> None:
        with contextlib.suppress(OSError):  # the other end is closed
            while piece := os.read(ours, 4096):
                said.append(piece)
                heard(b"".join(said))

    listening = threading.Thread(target=listen)
    listening.start()
    with monkeypatch.context() as patch, open(theirs, "w") as terminal:
        for name, value in (("TERM", "xterm"), ("COLUMNS", "100")):
            patch.setenv(name, value)
        patch.setattr(sys, "stderr", terminal)
        act()
    listening.join()
    os.close(ours)
    return b"".join(said).decode()


@pytest.mark.skipif(sys.platform != "linux", reason="a terminal of Linux")
def test_a_terminal_sees_which_frame_is_tried_again_and_what_follows_the_last(monkeypatch: pytest.MonkeyPatch) -> None:
    def shown() -> None:
        for events in ([Searching(12)], [Fusing(), *(Refining(done, 7) for done in range(8))]):
            with Console(25, None) as console:
                for event in events:
                    console(event)

    said = on_a_terminal(shown, monkeypatch)
    assert "frame 12" in said
    assert "7/7" in said


@pytest.mark.skipif(sys.platform != "linux", reason="a terminal of Linux")
def test_a_terminal_sees_how_far_it_is_and_how_long_it_takes(
    scene: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    said = on_a_terminal(lambda: main(["info", str(scene)]), monkeypatch)
    assert "3/3" in said
    assert "0:00:0" in said  # gone by, and to go
    assert "box" not in said  # data goes to stdout
    assert "box" in capfd.readouterr().out


@pytest.mark.skipif(sys.platform != "linux", reason="a terminal of Linux")
def test_a_terminal_sees_what_to_do_next_while_frames_come(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    growing = shutil.copytree(scene, tmp_path / "box")
    command = [*COMMAND, "build", str(growing), "--watch", "--idle-s", "100", "--out", str(tmp_path / "run"), *QUICK]

    def end_once_advised(said: bytes) -> None:
        if b"next: turn by " in said:
            (growing / END).touch()

    on_a_terminal(lambda: subprocess.run(command, stderr=sys.stderr, check=True), monkeypatch, end_once_advised)
    assert (growing / END).exists()


# Streams, signals and limits.


@pytest.mark.parametrize(
    ("closed", "arguments", "status"),
    [
        ("2>&-", ("view", "/nowhere"), 2),
        ("<&- >&- 2>&-", ("info", "SCENE"), 0),
        ("<&- >&- 2>&-", ("view", "/nowhere"), 2),
    ],
)
def test_a_stream_that_is_closed_changes_no_status(
    scene: Path, closed: str, arguments: tuple[str, ...], status: int
) -> None:
    command = [scene if argument == "SCENE" else argument for argument in arguments]
    ended = spawned(*command, shell="", after=closed)
    assert ended.status == status
    assert "Traceback" not in ended.err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_messages_that_cannot_be_written_change_no_status(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    statuses = 0, 0
    with contextlib.suppress(OSError), Path("/dev/full").open("w") as full:  # which cannot be closed either
        ended = subprocess.run([*COMMAND, "biuld"], stdout=subprocess.DEVNULL, stderr=full, check=False, timeout=120)
        monkeypatch.setattr(sys, "stderr", full)
        statuses = ended.returncode, main(["convert", str(scene), "--out", str(tmp_path / "out")])
    assert statuses == (2, 0)
    capfd.readouterr()


@pytest.mark.parametrize(
    ("name", "value"), [("NUMBA_NUM_THREADS", "0"), ("NUMBA_NUM_THREADS", "many"), ("NUMBA_DISABLE_JIT", "1")]
)
def test_settings_under_which_nothing_can_be_computed_are_said(
    name: str, value: str, monkeypatch: pytest.MonkeyPatch, refusal: Callable[..., str]
) -> None:
    monkeypatch.setenv(name, value)
    assert name in refusal("info", BOX)


@pytest.mark.parametrize(
    ("after_s", "number"), [*((after_s, signal.SIGINT) for after_s in (0.05, 0.4)), (0.4, signal.SIGTERM)]
)
def test_a_signal_during_imports_leaves_no_traceback(after_s: float, number: signal.Signals) -> None:
    with subprocess.Popen([*COMMAND, "info", BOX], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        time.sleep(after_s)
        process.send_signal(number)
        _, said = process.communicate(timeout=120)
    if process.returncode in (128 + number, -number, 0) and b"<frozen runpy>" not in said:
        assert said in (b"", b"modeler: interrupted\n")
    else:  # Python itself was not ready to be asked, and had not come to our code
        assert b"modeler/cli" not in said


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("can't start new thread"),
        OSError(12, "x"),
        ImportError("libarrow.so: failed to map segment from shared object"),
    ],
    ids=repr,
)
def test_exhausted_memory_or_threads_are_said_in_one_line(
    error: Exception, monkeypatch: pytest.MonkeyPatch, refusal: Callable[..., str]
) -> None:
    def exhausted(_: Info) -> None:
        raise error

    monkeypatch.setattr(Info, "run", exhausted)
    assert "memory or threads" in refusal("info", "x")


def test_a_program_that_calls_a_command_handles_its_signals_again(
    scene: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    def mine(number: int, frame: object) -> None:
        raise AssertionError(number)

    before = {number: signal.signal(number, mine) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        for arguments, status in ((["info", str(scene)], 0), (["info", "/nowhere"], 2), (["info"], 2)):
            with pytest.raises(SystemExit) if len(arguments) < 2 else contextlib.nullcontext():
                assert main(arguments) == status
            assert all(signal.getsignal(number) is mine for number in before)
        with Interrupt() as interrupt:
            os.kill(os.getpid(), signal.SIGINT)
            assert interrupt.asked
        assert signal.getsignal(signal.SIGINT) is mine
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    capfd.readouterr()


@pytest.mark.slow
def test_settings_for_developers_of_libraries_change_nothing(
    scene: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    settings = {"OPT": "9", "CPU_NAME": "nonsense", "THREADING_LAYER": "nonsense", "DEBUG": "1", "DUMP_IR": "1"}
    (tmp_path / ".numba_config.yaml").write_text("disable_jit: 1\nnum_threads: nonsense\n")
    command = ["register", str(scene), "0", "1", *QUICK]
    nonsense = {**{f"NUMBA_{name}": value for name, value in settings.items()}, "RERUN": "nonsense"}
    ended = spawned(*command, cwd=tmp_path, settings=nonsense)
    assert (ended.status, main(command)) == (0, 0)
    said = capfd.readouterr()
    assert [re.sub(r'"seconds": .*|[0-9.]+ s', "", text) for text in (ended.out, ended.err)] == [
        re.sub(r'"seconds": .*|[0-9.]+ s', "", text) for text in (said.out, said.err)
    ]


def test_too_few_files_are_said_in_one_line() -> None:
    assert "ulimit -n" in refusal_of(spawned("info", BOX, shell="ulimit -n 8; exec"))


@pytest.mark.parametrize("words", ["info LONG", "report LONG", "build BOX --out LONG", "batch BOX --out LONG"])
def test_paths_longer_than_the_system_takes_are_refused(words: str, refusal: Callable[..., str]) -> None:
    long = "/".join(["folder"] * 700)
    refusal(*({"LONG": long, "BOX": BOX}.get(word, word) for word in words.split()))


ENDINGS = [
    (signal.SIGINT, KeyboardInterrupt, None),
    (signal.SIGTERM, SystemExit, 143),
    (signal.SIGHUP, SystemExit, 129),
]


@pytest.mark.parametrize(("number", "kind", "status"), ENDINGS)
def test_a_signal_that_a_library_turns_into_another_error_ends_the_command(
    number: int, kind: type[BaseException], status: int | None
) -> None:
    def load() -> None:
        try:
            os.kill(os.getpid(), number)
            time.sleep(10.0)
        except BaseException:
            raise RuntimeError("the library failed") from None

    with pytest.raises(kind) as ending, endable():
        load()
    assert getattr(ending.value, "code", None) == status


@pytest.mark.parametrize(("number", "kind", "status"), ENDINGS)
def test_a_signal_where_nothing_can_be_raised_ends_the_command(
    number: int, kind: type[BaseException], status: int | None, capfd: pytest.CaptureFixture[str]
) -> None:
    class Dropped:
        def __del__(self) -> None:
            os.kill(os.getpid(), number)
            time.sleep(0.1)

    def drop() -> None:
        Dropped()
        time.sleep(10.0)

    with pytest.raises(kind), endable():
        drop()
    assert capfd.readouterr().err == ""


def test_a_terminal_that_closes_leaves_nothing_half_written(scene: Path, tmp_path: Path) -> None:
    """SIGHUP in the middle of writing."""
    program = (
        "import os, signal, sys; from modeler.cli import main; from modeler.sequences import image_files\n"
        "def hung_up(path, pixels): os.kill(os.getpid(), signal.SIGHUP); write(path, pixels)\n"
        "write, image_files.write_image = image_files.write_image, hung_up\n"
        "from modeler.sequences import bop; bop.write_image = hung_up\n"
        "sys.exit(main(['convert', sys.argv[1], '--out', sys.argv[2]]))"
    )
    ended = spawned("-c", program, scene, tmp_path / "out", timeout=60.0)
    assert (ended.status, ended.err) == (129, "")
    assert list(tmp_path.iterdir()) == []


def test_a_command_runs_in_any_thread(scene: Path, capfd: pytest.CaptureFixture[str]) -> None:
    statuses: list[int] = []
    thread = threading.Thread(target=lambda: statuses.append(main(["info", str(scene)])))
    thread.start()
    thread.join()
    assert statuses == [0], capfd.readouterr().err


def test_a_region_may_be_the_whole_image() -> None:
    check_region(ObjectOptions(roi=(0, 0, 640, 480)), open_sequence(Path(BOX)))


@pytest.mark.skipif(sys.platform != "linux", reason="limits as Linux has them")
@pytest.mark.parametrize("limit_mb", [200, 600])
def test_memory_that_does_not_suffice_for_libraries_is_said_in_one_line(limit_mb: int) -> None:
    ended = spawned("register", BOX, "0", "1", shell=f"ulimit -v {1024 * limit_mb}; exec", timeout=100)
    assert "memory or threads" in refusal_of(ended)


@pytest.mark.skipif(sys.platform != "linux", reason="limits as Linux has them")
@pytest.mark.parametrize("limit_mb", [1500, pytest.param(3500, marks=pytest.mark.slow)])
def test_memory_that_does_not_suffice_for_the_recording_is_said_in_one_line(
    scene: Path, tmp_path: Path, limit_mb: int
) -> None:
    build = ["build", str(scene), "--out", str(tmp_path / "run"), "--prior", "table"]
    ended = spawned(*build, shell=f"ulimit -v {1024 * limit_mb}; exec")
    said = [line for line in ended.err.splitlines() if "compiling kernels" not in line]
    assert (ended.status, ended.out, len(said)) == (2, "", 1)
    assert "memory or threads" in said[0]
    assert main([*build, "--resume", "--method", "icp"]) in (0, 3)


@pytest.mark.parametrize("name", ["\ud800", "a\0b"])
@pytest.mark.parametrize(
    "arguments",
    [
        ("info", "NAME"),
        ("build", BOX, "--out", "NAME"),
        ("build", BOX, "--out", "run", "--sensor", "NAME"),
        ("evaluate", BOX, "NAME", "--out", "errors"),
        ("render", "box", "--out", "NAME"),
    ],
)
def test_names_that_no_file_can_have_are_refused(
    name: str, arguments: tuple[str, ...], refusal: Callable[..., str]
) -> None:
    said = refusal(*(name if argument == "NAME" else argument for argument in arguments))
    assert "no file can have this name" in said


def test_what_is_wrong_with_an_option_is_said_in_any_encoding() -> None:
    ended = spawned("build", BOX, "--out", "run", "--sede", "3", settings={"PYTHONIOENCODING": "ascii"})
    said = refusal_of(ended)
    assert "--sede" in said
    assert "--seed" in said


@pytest.mark.slow
def test_what_was_compiled_ahead_is_all_that_a_run_needs(tmp_path: Path) -> None:
    settings = {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def kept() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in (tmp_path / "cache").rglob("kernels-*/*")}

    ahead = "from modeler.cli.console import say; from modeler.runs import compiling; compiling.compile_kernels(say)"
    done = spawned("-c", ahead, settings=settings)
    counts = re.findall(r"compiling kernels, once on this machine: (\d+) of (\d+)", done.err)
    assert counts == [(str(k + 1), str(len(counts))) for k in range(len(counts))]
    assert counts
    compiled = kept()
    again = spawned("-c", ahead, settings=settings)
    assert (again.status, again.err) == (0, "")
    built = spawned("build", BOX, "--frames", ":3", "--prior", "table", "--out", tmp_path / "run", settings=settings)
    assert built.status == 0
    assert kept() == compiled
