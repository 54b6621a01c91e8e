"""Kills of every other command that writes: inputs stay as they are, and the command can simply be given again."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from modeler import sequences
from modeler.cli import main
from modeler.sequences import write_bop
from studies.formats import image_folders
from studies.kills.trials import environment

COMMANDS: Final[Mapping[str, tuple[str, ...]]] = {
    "convert": ("convert", "s", "--out", "made/out"),
    "render": ("render", "recipe.json", "--out", "made/out"),
    "export": ("export", "a", "--out", "made/out.obj"),
    "export of texture": ("export", "a", "--out", "made/out.obj", "--texture"),
    "export for a simulator": ("export", "a", "--for", "mujoco", "--out", "made/out"),
    "batch": ("batch", "s", "--out", "made/out", "--prior", "table", "--method", "icp", "--workers", "1"),
    "calibrate-sensor": ("calibrate-sensor", "still", "--out", "made/out.json"),
    "calibrate-camera": ("calibrate-camera", "a", "--out", "made/out.json"),
    "export of poses": ("convert", "a", "--out", "made/out.json"),
    "report": ("report", "a", "--out", "made/out.html"),
    "evaluate": ("evaluate", "rendered", "--methods", "icp", "--out", "made/out"),
    "join": ("join", "a", "b", "--out", "made/out"),
    "edit": ("edit", "a", "--drop", "2", "--out", "made/out"),
    "build on a model": ("build", "s", "--model", "a", "--out", "made/out"),
    "track": ("track", "a", "s", "--out", "made/out"),
    "gallery": ("gallery", "made/runs", "--out", "made/runs/gallery.html"),
}
"""Arguments; names are relative to the folder of the inputs."""
# Of others a folder appears whole or not at all.
_ASKS: Final = frozenset(COMMANDS) - {"convert", "render"}
_WRITES_BESIDE: Final[Mapping[str, str]] = {"gallery": "made/runs"}  # what it reads, where copies of runs are put first
_RECIPE: Final = (
    '{"object": {"kind": "box", "size_m": [0.1, 0.08, 0.06]}, "view": {"width": 80, "height": 60, "focal_px": 72},'
    ' "trajectory": {"kind": "tabletop", "frames": 3}}'
)
_TIMED: Final = (
    ".json",
    ".html",
    ".rrd",
    ".csv",
    ".md",
    ".parquet",
    ".log",
    ".pair",
)  # files that say how long something took
_LIMIT_S: Final = 400


def write_inputs(folder: Path) -> None:
    """Write a sequence, two runs of it, a recipe and its sequence, and frames of a scene that stands still."""
    write_bop(folder / "s", image_folders.small_frames(3), image_folders.small_truth(3), depth_scale_mm=1.0)
    (folder / "recipe.json").write_text(_RECIPE)
    assert main(["render", str(folder / "recipe.json"), "--out", str(folder / "rendered")]) == 0
    still = json.loads((Path(sequences.__file__).parent / "recipes" / "box.json").read_bytes())
    still["view"] = {"width": 480, "height": 360, "focal_px": 430.0}
    still["trajectory"] = {"kind": "tabletop", "frames": 4, "step_deg": 0.0, "step_sigma_deg": 0.0, "shift_m": 0.0}
    (folder / "still.json").write_text(json.dumps(still | {"colour": "none"}))
    assert main(["render", str(folder / "still.json"), "--out", str(folder / "still")]) == 0
    for name in ("mask_visib", "mask"):  # the whole scene is looked at
        shutil.rmtree(folder / "still" / name, ignore_errors=True)
    for run in ("a", "b"):
        arguments = ["build", str(folder / "s"), "--out", str(folder / run), "--prior", "table", "--method", "icp"]
        assert main(arguments) in (0, 3)


@dataclass(frozen=True)
class CommandTrials:
    """Kills one command before one change of the disk after the other."""

    inputs: Path
    """Folder of the inputs."""
    name: str
    """Key of `COMMANDS`."""

    def undisturbed(self) -> tuple[dict[Path, bytes], int]:
        """Return what the command writes, and in how many changes of the disk."""
        status, said, changes = self._run(0)
        assert status in (0, 3), said
        return contents(self._made), changes

    def fault(self, change: int, whole: Mapping[Path, bytes]) -> str:
        """Kill the command before a change, give it again, and return what is wrong then: nothing is "".

        Args:
            change: counted from 1.
            whole: what it must write.
        """
        before = {path: data for path, data in contents(self.inputs).items() if path.parts[0] != "made"}
        status, said, _ = self._run(change)
        if status != -signal.SIGKILL:
            return f"it had ended, with status {status}, before it was to be killed: {said}"
        after = {path: data for path, data in contents(self.inputs).items() if path.parts[0] != "made"}
        if before != after:
            return "an input is not what it was"
        # A kill between two files, or behind the last, leaves files that are there already.
        flags = ("--overwrite",) if self.name in _ASKS and any(self._made.iterdir()) else ()
        status, said, _ = self._run(0, *flags, keep=True)
        if status not in (0, 3):
            return f"given again, it ends with status {status}: {said}"
        made = contents(self._made)
        if made.keys() != whole.keys():
            return f"holds {', '.join(map(str, sorted(made.keys() ^ whole.keys())))}, or lacks it"
        differ = [str(path) for path in whole if path.suffix not in _TIMED and made[path] != whole[path]]
        return f"{differ[0]} differs from the undisturbed one's" if differ else ""

    @property
    def _made(self) -> Path:
        return self.inputs / "made"

    def _run(self, change: int, *flags: str, keep: bool = False) -> tuple[int, str, int]:
        """Run the command, and return its status, what it said, and how often it changed the disk."""
        if not keep:
            shutil.rmtree(self._made, ignore_errors=True)
            for run in ("a", "b") if self.name in _WRITES_BESIDE else ():
                shutil.copytree(self.inputs / run, self.inputs / _WRITES_BESIDE[self.name] / run)
        self._made.mkdir(exist_ok=True)
        log = self.inputs.with_name(f"{self.inputs.name}.log")
        log.unlink(missing_ok=True)
        command = [sys.executable, "-m", "studies.kills.child", str(log), str(change), *COMMANDS[self.name], *flags]
        ended = subprocess.run(
            command,
            cwd=self.inputs,
            env=environment(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            timeout=_LIMIT_S,
            check=False,
        )
        lines = log.read_text().splitlines() if log.exists() else []
        return ended.returncode, ended.stderr, sum(line.startswith("change") for line in lines)


def contents(folder: Path) -> dict[Path, bytes]:
    """Return the content of every file of a folder by its path there."""
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
