"""Shared fixtures."""

import os
import shutil
import signal
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as commands do: matrices are small, and NumPy asks once
os.environ.setdefault("RUST_LOG", "warn,re_log_encoding=off")  # as modeler.viz does: Rerun asks as it is imported
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # without bytecode, each command that a test starts takes 2 s more
if (
    signal.getsignal(signal.SIGINT) is signal.SIG_IGN
):  # as a shell starts what runs in the background; commands inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:  # as nohup starts what it runs
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

import numpy as np
import pytest
from command_runner import QUICK, Run, refusal_of, runner
from hypothesis import settings
from turning_box import COUNT, LOST, steps

from modeler.cli import main
from modeler.sequences import bundled, write_bop
from modeler.sequences.calibrated import flat_shares
from modeler.sequences.colour_alignment import misalignment
from modeler.system import processes
from modeler.types import Frame, Step
from studies.formats.image_folders import WRITERS, small_frames, small_truth, write_bundlesdf, write_open3d, write_tum

settings.register_profile("tests", deadline=None)  # however loaded the machine is
settings.load_profile("tests")
survey: Any = sys.modules["modeler.sequences.survey"]  # the module, whose name in its package is its function's


@pytest.fixture
def rng():
    """Return a generator with a fixed seed."""
    return np.random.default_rng(0)


@pytest.fixture(autouse=True)
def no_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have reports written and live steps drawn every time, however slow disk and processor are."""
    monkeypatch.setattr(processes, "_NO_TIME_S", np.inf)


_FOUND: dict[Any, Any] = {}


def _once(look: Callable[[Sequence[Frame]], Any], frames: Sequence[Frame]) -> Any:
    """Return what is found in frames; in equal ones, what was found before."""
    key = look.__name__, tuple(map(survey._digest, frames))
    if key not in _FOUND:
        _FOUND[key] = look(frames)
    return _FOUND[key]


@pytest.fixture(autouse=True)
def _looked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Look for colour and planes in equal frames once: most tests read the same small ones."""
    for look in (misalignment, flat_shares):
        monkeypatch.setattr(survey, look.__name__, partial(_once, look))


@pytest.fixture
def cli(capfd: pytest.CaptureFixture[str]) -> Run:
    """Return what runs a command in this process, and tells how it ended and what it said."""
    return runner(capfd)


@pytest.fixture
def refusal(cli: Run) -> Callable[..., str]:
    """Return what runs a command that must refuse what it is given, and returns the line that it says."""
    return lambda *arguments: refusal_of(cli(*arguments))


@pytest.fixture(scope="session")
def frames() -> list[Frame]:
    """Return small frames of the bundled box."""
    return small_frames()


@pytest.fixture(scope="session")
def truth() -> dict[int, np.ndarray]:
    """Return camera_from_model (4, 4) of those frames."""
    return small_truth()


@pytest.fixture(params=WRITERS)
def folder(request: pytest.FixtureRequest, tmp_path: Path, frames: list[Frame], truth: dict[int, np.ndarray]) -> Path:
    """Return a folder of those frames, as one of other programs writes it."""
    path = tmp_path / request.param
    WRITERS[request.param](path, frames, truth)
    return path


@pytest.fixture(scope="session")
def run() -> list[Step]:
    """Return a made-up run, one frame of which is lost."""
    return list(steps(COUNT, lost=LOST))


@pytest.fixture(scope="session")
def recording(run: list[Step], tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[int, dict[str, Any]]]:
    """Return what is recorded of that run, as `rerun_recordings.read` has it."""
    from rerun_recordings import record  # and with it Rerun, which few tests need

    return record(tmp_path_factory.mktemp("viz") / "recording.rrd", run)


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of three small frames of the bundled box, their true poses and the true mesh: to be read only."""
    folder = tmp_path_factory.mktemp("scene") / "box"
    write_bop(folder, small_frames(3), small_truth(3), depth_scale_mm=1.0)
    shutil.copy(bundled("box") / "model.ply", folder)
    return folder


@pytest.fixture(scope="session")
def built(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run of `scene`, built by the command line as `QUICK` says: to be read only."""
    folder = tmp_path_factory.mktemp("built") / "run"
    assert main(["build", str(scene), "--out", str(folder), *QUICK]) == 0
    return folder


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with one intact sequence of each kind of folders of pictures: to be read only."""
    root, frames, truth = tmp_path_factory.mktemp("intact"), small_frames(3), small_truth(3)
    write_bop(root / "bop", frames, truth, depth_scale_mm=1.0)
    write_tum(root / "tum", frames, truth)
    write_open3d(root / "open3d", frames, truth)
    write_bundlesdf(root / "bundlesdf", frames, truth)
    return root
