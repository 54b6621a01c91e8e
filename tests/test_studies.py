"""The programs that measure: each is listed and starts, and none relies on tests."""

import subprocess
import sys
from pathlib import Path

import pytest
from source_trees import ROOT, imported

from studies.__main__ import STUDIES, main

PROGRAMS = {path: path.read_text() for path in sorted((ROOT / "studies").rglob("*.py"))}


def test_every_program_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    unlisted = {"studies", "studies.kills.child"}  # this one runs within kills
    unlisted |= {f"studies.formats.recorded.{name}" for name in ("foxglove", "kinect", "realsense")}  # by themselves
    started = {_module(path) for path, text in PROGRAMS.items() if 'if __name__ == "__main__":' in text}
    assert started - unlisted == {f"studies.{name}" for name in STUDIES}
    assert main([]) == 0
    listed = capsys.readouterr().out
    assert [name for name in STUDIES if f"    {name} " not in listed] == []


def test_an_unknown_study_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trusst"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_study_takes_its_own_options() -> None:
    command = [sys.executable, "-m", "studies", "trust", "--runs", "0"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2
    assert "--runs and --jobs take whole numbers" in done.stderr
    assert "python -m studies trust" in done.stderr


def test_no_study_imports_a_test_or_its_fixtures() -> None:
    fixtures = {path.stem for path in (ROOT / "tests").glob("*.py")}
    assert {(str(path), name) for path in PROGRAMS for name in imported(path) if name in fixtures} == set()


def _module(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] in ("__main__", "__init__") else parts)
