"""README and guide: every command is understood, and what they tell a reader to do works, in their order."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_runner import FILES
from pages import DOCS, PAGES, Command, File, commands, steps
from source_trees import ROOT

from modeler import sequences
from modeler.cli import main, parsed
from modeler.sequences import bundled, write_bop
from modeler.types import Frame, Outcome
from studies.__main__ import STUDIES
from studies.formats.image_folders import small_frames, small_truth

NOT_HERE = {
    r"--view\b|modeler view": "opens a window",
    r"--web\b": "serves until Ctrl-C",
    r"modeler studio": "serves until Ctrl-C",
    r"realsense:": "needs a camera",
    r"dask:": "needs a cluster",
    r"--device cuda": "needs a GPU",
}
"""What commands ask for that a test has not: they are only understood."""
QUICK = ("README",)
SEQUENCES = "sequences/bundled/box sequences/bundled/tube turned poked carried shelf/cup shelf/tin".split()
CONTRIBUTING = ROOT / "CONTRIBUTING.md"
WITH_COMMANDS = (*PAGES.values(), DOCS / "measurements.md", DOCS / "results.md", CONTRIBUTING)
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
TARGETS = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)


@pytest.mark.parametrize("line", sorted({line for page in WITH_COMMANDS for line in commands(page)}))
def test_every_command_is_understood(line: str) -> None:
    words = shlex.split(line)
    if words[0] == "modeler":
        assert parsed(words[1:]).run.__doc__
    elif words[0] == "make":
        assert {word for word in words[1:] if "=" not in word} <= set(TARGETS)
    elif words[:3] == [".venv/bin/python", "-m", "studies"]:
        assert set(words[3:4]) <= set(STUDIES)
    elif words[:3] == [".venv/bin/pip", "install", "-c"]:
        assert words[3:5] == ["constraints.txt", "-e"]
        assert words[5][2:-1] in EXTRAS
    else:
        assert line == ". .venv/bin/activate"


def test_every_study_that_a_page_names_exists() -> None:
    named = {
        name for page in DOCS.rglob("*.md") for name in re.findall(r"python -m studies ([\w.]+)", page.read_text())
    }
    assert named
    assert named <= set(STUDIES)


def test_every_place_that_contributors_are_referred_to_exists() -> None:
    places = set(re.findall(r"`((?:modeler|sequences|viz|tests|studies|docs)/[\w./]*)`", CONTRIBUTING.read_text()))
    assert len(places) > 20
    assert [place for place in sorted(places) if not (ROOT / place).exists()] == []


class Desk:
    """A folder in which a reader works, with small sequences where the pages have theirs."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.done = folder, set[str]()

    def run(self, line: str) -> None:
        """Run a command once, in the current folder; none ends with 2."""
        if line in self.done or any(re.search(pattern, line) for pattern in NOT_HERE):
            return
        self.done.add(line)
        words = [
            word for given in shlex.split(line.replace("--idle-s 5", "--idle-s 1"))[1:] for word in _matching(given)
        ]
        try:
            status = main(words)
        except SystemExit as ending:
            status = ending.code
        assert status in (0, 3), line


def _matching(word: str) -> list[str]:
    return sorted(map(str, Path().glob(word))) if "*" in word else [word]


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Desk:
    folder = tmp_path_factory.mktemp("desk")
    frames, truth = small_frames(3), small_truth(3)
    for name in SEQUENCES:
        write_bop(folder / name, frames, truth, {"motion": {"kind": "table"}}, depth_scale_mm=1.0)
        shutil.copy(bundled("box") / "model.ply", folder / name)
    hand = [(index, *pose[:3, 3], *_quaternion(pose)) for index, pose in truth.items()]  # carries the object's frame
    (folder / "carried" / "robot.txt").write_text("".join(" ".join(map(str, line)) + "\n" for line in hand))
    for kind, suffix in (("depth", "png"), ("rgb", "jpg")):  # as a reader's own folder
        (folder / "scans" / kind).mkdir(parents=True)
        for number in range(3):
            shutil.copy(bundled("box") / kind / f"{number:06d}.{suffix}", folder / "scans" / kind)
    for step in steps(PAGES["README"]):
        if isinstance(step, File):
            written(folder, step)
    rng = np.random.default_rng(0)
    still = [_noisy(frames[0], number, rng) for number in range(5)]
    write_bop(folder / "still", still, depth_scale_mm=0.1)
    return Desk(folder)


def _quaternion(pose: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(pose[:3, :3]).as_quat()


def _noisy(frame: Frame, number: int, rng: np.random.Generator) -> Frame:
    depth_m = frame.depth_m + rng.normal(0.0, 1e-3, frame.depth_m.shape).astype(np.float32)
    return Frame(number, 0.1 * number, depth_m, frame.camera)


@pytest.fixture
def at_desk(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> Iterator[Desk]:
    """Work in the folder, in which the runs that pages go on from exist."""
    monkeypatch.chdir(desk.folder)
    monkeypatch.setattr(sequences, "bundled", lambda name: desk.folder / "sequences" / "bundled" / name)
    modules = set(sys.modules)
    desk.run("modeler build sequences/bundled/box --prior table --out runs/box")
    for name in {"demo", "upright", "lying"} - set(os.listdir("runs")):
        shutil.copytree("runs/box", f"runs/{name}")
    yield desk
    for name in set(sys.modules) - modules:
        if name.startswith("my_"):
            del sys.modules[name]


def written(folder: Path, file: File) -> None:
    path = folder / file.path
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(file.text)


def tried(desk: Desk, name: str) -> dict[str, Any]:
    """Do what a page says, in its order, and return the names of its Python."""
    names: dict[str, Any] = {}
    for step in steps(PAGES[name]):
        if isinstance(step, File):
            written(Path(), step)
        elif not isinstance(step, Command):
            exec(step.code, names)
        elif step.line.startswith("modeler "):
            desk.run(step.line)
    return names


OTHERS = [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in PAGES if name != "python"]


@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", OTHERS)
def test_what_a_page_says_works(at_desk: Desk, name: str) -> None:
    tried(at_desk, name)


def test_the_python_of_the_guide_works(at_desk: Desk) -> None:
    names = tried(at_desk, "python")
    assert names["posterior"].outcome is Outcome.CONVERGED
    own = names["frames"]
    assert [frame.index for frame in own()] == [0, 1, 2]
    assert (Path("runs/own-frames/report.json").exists(), Path("runs/box.rrd").exists()) == (True, True)
    assert set(names["smoother"].solution.trajectory) == {0, 1, 2}


def test_readme_and_guide_name_every_file_of_a_run_folder() -> None:
    for name in ("README", "files"):
        assert {file for file in re.findall(r"`(\w+\.\w+)`", PAGES[name].read_text()) if file in FILES} == FILES


def test_the_guide_describes_every_key_of_a_report_and_no_other(built: Path) -> None:
    described = {
        key
        for line in PAGES["files"].read_text().partition("## report.json")[2].splitlines()
        if line.startswith("| ")
        for key in re.findall(r"`([a-z_]+)`", line)
    } - {"null"}
    report = json.loads((built / "report.json").read_text())
    keys = set(report) | {key for name in ("loop", "camera") for key in report[name] or ()}
    for record in (*report["frames"], *report["edges"], *report["poses"], *report["evidence"].values()):
        keys |= set(record)
    keys |= {key for edge in report["edges"] for mode in edge["modes"] for key in mode}
    assert keys <= described
    source = "".join(path.read_text() for path in sorted((ROOT / "modeler").rglob("*.py")))
    assert [key for key in described if f'"{key}"' not in source and not re.search(rf"^    {key}:", source, re.M)] == []


@pytest.mark.slow  # as `.ci/run` runs `make docs`
def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="needs the extra docs")
    pytest.importorskip("mkdocstrings", reason="needs the extra docs")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    ended = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
    pages = {path.name: path.read_text() for path in (tmp_path / "site").glob("*.html")}
    assert {f"{path.stem}.html" for path in DOCS.glob("*.md")} - {"package.html"} <= set(pages)
    assert "--step-sigma-deg" in pages["commands.html"]
    assert "AbstractPrior" in pages["python.html"]
    assert "TurntablePrior" in pages["api.html"]
    for name, text in pages.items():
        fetched = re.findall(r'<(?:script|link|img)[^>]+(?:src|href)="(https?://[^"]+)"', text)
        assert fetched == [], name
