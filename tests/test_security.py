"""Inputs cannot make the program run their code, write where it was not asked to, or speak to the terminal."""

import ast
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from command_runner import QUICK, spawned
from source_trees import SOURCES, nodes

import modeler
from modeler.cli import main
from modeler.sequences import open_sequence, write_bop
from studies.formats.image_folders import small_frames, small_truth, write_open3d

EVIL = "../../../../evil <script>alert(1)</script>"
RUNS_CODE = {"pickle", "cPickle", "dill", "joblib", "marshal", "shelve", "torch", "yaml", "runpy", "code"}
OURS = {"cache": {"pickle"}}  # compiled code of ours, in files that nobody else can write


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.stem)
def test_nothing_is_unpickled_and_no_text_is_run(path: Path) -> None:
    for node in nodes(path):
        if isinstance(node, ast.Import):
            assert not {alias.name.split(".")[0] for alias in node.names} & (RUNS_CODE - OURS.get(path.stem, set()))
        if isinstance(node, ast.ImportFrom):
            assert (node.module or "").split(".")[0] not in RUNS_CODE
        if not isinstance(node, ast.Call):
            continue
        called = ast.unparse(node.func)
        assert called not in ("eval", "exec", "compile", "os.system", "os.popen")
        given = {word.arg: ast.unparse(word.value) for word in node.keywords}
        assert given.get("shell", "False") == "False"
        assert given.get("allow_pickle", "False") == "False"
        if called == "np.load":
            assert given["allow_pickle"] == "False"


def everything(root: Path, but: Path) -> set[Path]:
    """Return what lies below a folder, but for one folder in it."""
    return {path for path in root.rglob("*") if not path.is_relative_to(but)}


def test_outputs_stay_where_they_are_asked_to_be(tmp_path: Path) -> None:
    deep = tmp_path / "a" / "b" / "c" / "d" / "e"
    deep.mkdir(parents=True)
    source, out = deep / "in", deep / "out"
    write_bop(source, small_frames(2), small_truth(2), {"name": EVIL})
    out.mkdir()
    before = everything(tmp_path, out)
    assert main(["build", str(source), "--out", str(out / "run"), *QUICK]) == 0
    assert main(["report", str(out / "run"), "--out", str(out / "page.html")]) == 0
    assert main(["export", str(out / "run"), "--out", str(out / "m.obj")]) == 0
    assert main(["convert", str(source), "--out", str(out / "bop")]) == 0
    assert main(["convert", str(out / "run"), "--out", str(out / "scene_gt.json")]) == 0
    assert main(["evaluate", str(source), "--out", str(out / "figures"), "--methods", "icp", *QUICK[:2]]) == 0
    assert main(["info", str(source)]) == 0
    assert "<script>alert" not in (out / "page.html").read_text()
    assert everything(tmp_path, out) == before
    assert open_sequence(out / "bop").name == EVIL


@pytest.mark.parametrize("command", ["report", "batch"])
def test_python_files_in_the_current_folder_are_not_run(scene: Path, built: Path, tmp_path: Path, command: str) -> None:
    here = tmp_path / "here"
    here.mkdir()
    for name in ("numpy", "json", "pyarrow", "submitit", "rerun", "numba", "modeler"):
        (here / f"{name}.py").write_text(f"open({str(tmp_path / 'run')!r}, 'w').close(); raise SystemExit('it is run')")
    arguments = {
        "report": ["report", built, "--out", tmp_path / "page.html"],
        "batch": ["batch", scene, "--out", tmp_path / "many", *QUICK, "--workers", "1", "--frames", ":2"],
    }[command]
    program = f"import sys; sys.path.insert(0, {str(Path(modeler.__file__).parent.parent)!r}); "
    program += "from modeler.__main__ import main; sys.exit(main())"
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    ended = spawned("-P", "-c", program, *arguments, cwd=here, env=environment)  # as the console script does
    assert ended.status in (0, 3), ended.err
    assert not (tmp_path / "run").exists()
    if command == "report":
        assert "There are no pictures" not in (tmp_path / "page.html").read_text()


def test_python_files_in_the_current_folder_are_not_run_by_the_module(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "numpy.py").write_text("raise SystemExit('it is run')")
    ended = spawned("info", scene, cwd=tmp_path, settings={"PYTHONPATH": str(Path(modeler.__file__).parent.parent)})
    assert ended.status == 0, ended.err


def test_links_in_a_run_folder_are_replaced_and_not_followed(tmp_path: Path) -> None:
    outside, folder = tmp_path / "outside", tmp_path / "run"
    outside.mkdir()
    for name in ("model.ply", "report.json", "recording.rrd", "trajectory.txt"):
        (outside / name).write_text("precious")
    write_bop(tmp_path / "in", small_frames(2))
    command = ["build", str(tmp_path / "in"), "--out", str(folder), *QUICK]
    assert main(command) == 0
    report = json.loads((folder / "report.json").read_text())
    for flag in ("--overwrite", "--resume"):
        (folder / "report.json").write_text(json.dumps(report | {"complete": False}))
        for name in ("model.ply", "recording.rrd", "trajectory.txt"):
            (folder / name).unlink()
            (folder / name).symlink_to(outside / name)
        (folder / ".pairs").symlink_to(outside)
        assert main([*command, flag]) == 0
        assert not any(path.is_symlink() for path in folder.iterdir())
    assert {path.read_text() for path in outside.iterdir()} == {"precious"}
    assert len(list(outside.iterdir())) == 4


def linked(tmp_path: Path, inner: str) -> tuple[Path, Path]:
    """Return a sequence in which a file or folder is a link out of it, and what the link leads to."""
    folder, outside = tmp_path / "in", tmp_path / "elsewhere" / Path(inner).name
    write_bop(folder, small_frames(2), small_truth(2))
    outside.parent.mkdir()
    if (folder / inner).exists():
        (folder / inner).rename(outside)
    else:
        outside.write_text("precious")
    (folder / inner).symlink_to(outside)
    return folder, outside


@pytest.mark.parametrize("name", ["model.ply", "robot.txt", "sequence.json"])
def test_what_lies_beside_the_frames_may_be_refused_where_it_is_a_link_out(
    tmp_path: Path, refusal: Callable[..., str], name: str
) -> None:
    folder, _ = linked(tmp_path, name)
    assert "leads out of the sequence" in refusal("convert", folder, "--out", tmp_path / "out", "--strict-paths")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("inner", ["depth", "depth/000000.png", "scene_camera.json"])
def test_nothing_is_written_where_a_link_of_a_sequence_leads(
    tmp_path: Path, refusal: Callable[..., str], inner: str
) -> None:
    folder, outside = linked(tmp_path, inner)
    assert main(["build", str(folder), "--out", str(tmp_path / "run"), *QUICK]) == 0
    held = {path: path.read_bytes() for path in (tmp_path / "elsewhere").rglob("*") if path.is_file()}
    out = outside / "000000.png" if outside.is_dir() else outside
    assert "only read" in refusal("report", tmp_path / "run", "--out", out, "--overwrite")
    if outside.is_dir():
        refusal("convert", folder, "--out", outside / "new")
        refusal("build", folder, "--out", outside / "new", *QUICK)
    assert {path: path.read_bytes() for path in (tmp_path / "elsewhere").rglob("*") if path.is_file()} == held


def test_what_is_said_does_not_steer_the_terminal(tmp_path: Path, refusal: Callable[..., str]) -> None:
    write_open3d(tmp_path / "in", small_frames(2))
    (tmp_path / "in" / "sequence.json").write_text(json.dumps({"name": "\x1b[2Jcup"}))
    said = refusal("info", tmp_path / "in")
    assert "printable" in said
    (tmp_path / "in" / "sequence.json").unlink()
    (tmp_path / "in" / "depth" / "\x1b[2J.png").write_text("")
    said += refusal("info", tmp_path / "in") + refusal("info", tmp_path / "\x1b[2J")
    assert said.replace("\n", "").isprintable()


def test_names_that_are_no_text_are_refused(tmp_path: Path, refusal: Callable[..., str]) -> None:
    """A path on Linux is bytes; what is not UTF-8 in it comes as lone surrogates, which the viewer does not take."""
    write_bop(tmp_path / "in", small_frames(2))
    out = ("--out", tmp_path / "run \udcff")
    for command in (("info", tmp_path / "cup \udcff"), ("build", tmp_path / "in", *out, *QUICK)):
        said = refusal(*command)
        assert "is not UTF-8; rename" in said
        assert "\\udcff" in said
    assert [path.name for path in tmp_path.iterdir()] == ["in"]
