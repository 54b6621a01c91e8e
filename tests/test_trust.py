"""Whole runs: exit status 0 for a sound sequence, 3 for the same one with a single fault."""

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from command_runner import BOX, Run, runner

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]
SHUFFLED = [1, 10, 9, 5, 11, 2, 3, 7, 8, 4, 0, 12, 6, 13]
Matrix = list[float]


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Run:
    return runner(capfd)


def scaled(factor: float) -> Callable[[Matrix], Matrix]:
    """Change of a camera matrix: a focal length that is wrong by a factor."""
    return lambda matrix: [factor * matrix[0], *matrix[1:4], factor * matrix[4], *matrix[5:]]


def exchanged(matrix: Matrix) -> Matrix:
    """Return a camera matrix whose principal point has its coordinates exchanged."""
    return [*matrix[:2], matrix[5], *matrix[3:5], matrix[2], *matrix[6:]]


def spoilt(out: Path, order: Sequence[int], change: Callable[[Matrix], Matrix] = list) -> Path:
    """Write the bundled box with its frames in another order, or another camera matrix."""
    source = Path(BOX)
    cameras = json.loads((source / "scene_camera.json").read_text())
    for part in ("depth", "rgb"):
        (out / part).mkdir(parents=True)
        for number, frame in enumerate(order):
            (picture,) = (source / part).glob(f"{frame:06d}.*")
            shutil.copy(picture, out / part / f"{number:06d}{picture.suffix}")
    kept = {
        str(n): cameras[str(frame)] | {"cam_K": change(cameras[str(frame)]["cam_K"])} for n, frame in enumerate(order)
    }
    (out / "scene_camera.json").write_text(json.dumps(kept))
    facts = json.loads((source / "sequence.json").read_text())
    (out / "sequence.json").write_text(json.dumps({name: facts[name] for name in ("name", "sensor")}))
    return out


@pytest.mark.parametrize(
    ("order", "change", "options", "codes"),
    [
        (range(14), list, ("--prior", "table"), set()),
        ([0] * 10, list, ("--prior", "turntable", "--step-deg", "25"), {"no_motion", "prior_contradicted"}),
        (SHUFFLED, list, ("--prior", "table"), {"free_space_violations"}),
        (range(14), scaled(0.94), ("--prior", "table"), {"loop_open"}),
        (range(14), scaled(1.06), ("--prior", "table"), {"loop_open"}),
        (range(14), exchanged, ("--prior", "table"), {"prior_contradicted"}),
    ],
    ids=["sound", "still", "shuffled", "focal length 6 % short", "focal length 6 % long", "principal point"],
)
def test_one_fault_is_enough_for_status_3(
    order: Sequence[int],
    change: Callable[[Matrix], Matrix],
    options: Sequence[str],
    codes: set[str],
    run: Run,
    tmp_path: Path,
) -> None:
    ended = run("build", spoilt(tmp_path / "box", order, change), "--out", tmp_path / "run", *options)
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert ended.status == (3 if codes else 0)
    assert codes <= set(report["reason_codes"])
    assert bool(report["reason_codes"]) is bool(codes)
    assert "--step-deg 0" not in ended.err
    if "loop_open" in codes:
        assert "modeler calibrate-camera" in ended.err
