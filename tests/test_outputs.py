"""No command writes into or over what it reads, and nothing is replaced unless asked for."""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from command_runner import Run
from run_builders import META, made_up_steps

from modeler.export import RunFolder


@pytest.fixture
def places(scene: Path, tmp_path: Path) -> Path:
    """Return a folder with a sequence S, a run R of it, a run Q, and other names of them."""
    shutil.copytree(scene, tmp_path / "S")
    for name, seed in (("R", 3), ("Q", 4)):
        folder = RunFolder.open(tmp_path / name)
        for step in made_up_steps():
            folder.write(step, replace(META, sequence=str(tmp_path / "S"), seed=seed))
        folder.finish()
    (tmp_path / "link").symlink_to("S")
    (tmp_path / "linked-run").symlink_to("R")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("somebody's own")
    os.link(tmp_path / "R" / "model.ply", tmp_path / "hard.ply")
    for name in ("mine.ply", "mine.mtl", "noise.json", "page.html", "poses.txt"):
        (tmp_path / name).write_text("somebody's own")
    return tmp_path


def contents(folder: Path) -> dict[str, bytes | None]:
    """Return every file, folder and link below a folder, with what it holds."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


READ = "which is only read; choose another --out"
NO_RUN = "not empty, and not the folder of a run"


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("build S --out S", READ),
        ("build S --out S --resume", READ),
        ("build S --out S --overwrite", READ),
        ("build S --out S/depth/.. --overwrite", READ),
        ("build S --out S/depth --overwrite", READ),
        ("build S --out S/run", READ),
        ("build S --out link/run", READ),
        ("build link --out S --overwrite", READ),
        ("build S --out other --resume", NO_RUN),
        ("build S --out other --overwrite", NO_RUN),
        ("build S --out R", "give --overwrite or --resume"),
        ("build S --out mine.ply --overwrite", "Not a directory"),
        ("join R Q --out R --overwrite", READ),
        ("join R Q --out Q --overwrite", READ),
        ("join R Q --out linked-run --overwrite", READ),
        ("join R Q --out S --overwrite", READ),
        ("join R Q --out other --overwrite", NO_RUN),
        ("export R --out R/model.ply --triangles 100", READ),
        ("export R --out R/model.ply --overwrite", READ),
        ("export R --out linked-run/new.ply", READ),
        ("export R --out S/model.ply --overwrite", READ),
        ("export R --out hard.ply --overwrite", "is only read"),
        ("export R --out mine.ply", "mine.ply: exists already"),
        ("export R --out mine.obj --texture", "mine.mtl: exists already"),
        ("export R --out mine.ply --bop", "mine.ply: exists already"),
        ("export R --out other --overwrite", "unknown mesh format|no suffix"),
        ("report R --out page.html", "page.html: exists already"),
        ("report R --out R/trajectory.txt --overwrite", READ),
        ("report R --out S/page.html", READ),
        ("report R --out other --overwrite", "is a folder"),
        ("report R --out /dev/null --overwrite", "not a regular file"),
        ("convert R --out poses.txt", "poses.txt: exists already"),
        ("convert R --out R/trajectory.txt --overwrite", READ),
        ("convert R --out S/scene_gt.json --overwrite", READ),
        ("convert S --out S/new", READ),
        ("convert S --out link/new", READ),
        ("convert S --out other", "exists already"),
        ("calibrate-sensor S --out noise.json", "noise.json: exists already"),
        ("calibrate-sensor S --out S/sequence.json --overwrite", READ),
        ("evaluate S --out S", READ),
        ("evaluate R --out R", READ),
        ("evaluate R --out S", READ),
    ],
)
def test_what_is_read_and_what_is_there_stays_as_it_is(
    refusal: Callable[..., str], places: Path, command: str, says: str
) -> None:
    before = contents(places)
    words = [str(places / word) if (places / word.split("/")[0]).exists() and "--" not in word else word
             for word in command.split()]  # fmt: skip
    place = words.index("--out") + 1
    words[place] = os.path.join(places, command.split()[place])
    said = refusal(*words)
    assert any(part in said for part in says.split("|")), said
    assert contents(places) == before


@pytest.mark.parametrize("kind", ["sensor", "camera"])
def test_the_calibration_of_a_run_is_only_read(refusal: Callable[..., str], places: Path, kind: str) -> None:
    report = json.loads((places / "R" / "report.json").read_bytes())
    report["settings"][kind] = str(places / "calibration.json")
    (places / "R" / "report.json").write_text(json.dumps(report))
    (places / "calibration.json").write_text("measured")
    assert READ in refusal("calibrate-camera", places / "R", "--out", places / "calibration.json", "--overwrite")
    assert (places / "calibration.json").read_text() == "measured"


@pytest.mark.parametrize(("name", "more"), [("mine.ply", ()), ("mine.ply", ("--bop",)), ("mine.stl", ())])
def test_a_file_is_replaced_where_that_is_asked_for(cli: Run, places: Path, name: str, more: tuple[str, ...]) -> None:
    (places / name).write_text("somebody's own")
    assert cli("export", places / "R", "--out", places / name, *more).status == 2
    assert cli("export", places / "R", "--out", places / name, *more, "--overwrite").status == 0
    assert (places / name).read_bytes() != b"somebody's own"


def test_poses_and_results_are_replaced_where_that_is_asked_for(
    cli: Run, refusal: Callable[..., str], places: Path
) -> None:
    assert cli("convert", places / "R", "--out", places / "poses.txt", "--overwrite").status == 0
    assert (places / "poses.txt").read_bytes() == (places / "R" / "trajectory.txt").read_bytes()
    (places / "results.csv").write_text("somebody's own")
    said = refusal("evaluate", places / "S", "--out", places, "--methods", "icp")
    assert "results.csv: exists already" in said


def test_a_link_that_leads_nowhere_is_not_replaced(cli: Run, places: Path) -> None:
    (places / "dangling.ply").symlink_to("nowhere")
    assert cli("export", places / "R", "--out", places / "dangling.ply", "--overwrite").status == 2
    assert (places / "dangling.ply").is_symlink()
