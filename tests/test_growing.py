"""A model that a second recording goes on with: its frames are placed on the model, and one graph has them all."""

from pathlib import Path

import numpy as np
import pytest
from test_join import COUNT, FIGURE, rendered, true_run

from modeler import se3
from modeler.cli import main
from modeler.export import RunFolder
from modeler.runs.reopening import reopened
from modeler.sequences import write_bop
from modeler.types import Array


@pytest.fixture(scope="module")
def grown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[int, Array]]:
    """Return a run that goes on with another, and the true object_from_camera but for the object frame, by number."""
    folder = tmp_path_factory.mktemp("grown")
    first, second = rendered("first", FIGURE, 3), rendered("second", FIGURE, 5)
    true_run(first, folder / "first", folder / "run")
    write_bop(folder / "second", second, None, {})
    words = (
        "build",
        str(folder / "second"),
        "--model",
        str(folder / "run"),
        "--out",
        str(folder / "both"),
        "--every",
        "3",
    )
    assert main(words) in (0, 3)  # the spin of such a figure is uncertain by 2.5 degrees, as the verdict says
    poses = {k: se3.inverse(pose) for k, pose in first.truth().items()}
    return folder / "both", poses | {COUNT + k: se3.inverse(pose) for k, pose in second.truth().items()}


def test_frames_of_another_recording_find_their_places_on_a_model(grown: tuple[Path, dict[int, Array]]) -> None:
    report = RunFolder(grown[0]).report()
    new = [COUNT + k for k in range(0, COUNT, 3)]
    assert [frame["id"] for frame in report["frames"]] == [*range(COUNT), *new]
    assert (np.diff([frame["timestamp"] for frame in report["frames"]]) > 0.0).all()
    poses = {pose["id"]: np.reshape(pose["object_from_camera"], (4, 4)) for pose in report["poses"]}
    assert [*poses] == [*range(COUNT), *new]
    base = poses[0] @ se3.inverse(grown[1][0])
    for pose in report["poses"]:
        error_rad = se3.rotation_angle(se3.inverse(base @ grown[1][pose["id"]]) @ poses[pose["id"]])
        sigma_rad = np.sqrt(np.linalg.eigvalsh(np.reshape(pose["covariance"], (6, 6))[:3, :3])[-1])
        assert error_rad < np.radians(1.0) + 2.0 * sigma_rad
    across = [edge for edge in report["edges"] if edge["source"] in new and edge["target"] < COUNT and edge["accepted"]]
    assert len(across) >= len(new)
    assert {edge["kind"] for edge in across} == {"closure"}


def test_a_run_that_goes_on_with_another_is_opened_again(grown: tuple[Path, dict[int, Array]]) -> None:
    again = reopened(grown[0])
    assert [part.offset for part in again.parts] == [0, COUNT]
    assert [*again.views] == [*range(COUNT), *(COUNT + k for k in range(0, COUNT, 3))]


def test_options_of_a_build_from_nothing_are_refused(
    grown: tuple[Path, dict[int, Array]], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = grown[0].parent
    words = ["build", str(folder / "second"), "--model", str(folder / "run"), "--out", str(folder / "other")]
    assert main([*words, "--prior", "table"]) == 2
    assert "leave out --resume, --watch and --prior" in capsys.readouterr().err
    assert not (folder / "other").exists()
