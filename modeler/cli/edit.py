"""`modeler edit`: a finished run without some of its frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from modeler.cli.console import say
from modeler.composition.options import default


@dataclass(frozen=True)
class Edit:
    """Take frames out of a finished run, and optimise and fuse the rest without registering again."""

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Run folder of `modeler build` or `modeler join`."""
    drop: Annotated[str | None, tyro.conf.arg(metavar="N,..."), default("none")] = None
    """Numbers of the frames to take out: 7,12 or ranges 7:10, the end not included."""
    keep: Annotated[str | None, tyro.conf.arg(metavar="N,..."), default("all")] = None
    """Numbers of the frames to keep, instead."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="RUN2"), default("RUN itself, which is replaced")] = None
    """Run folder to create."""
    overwrite: bool = False
    """Replace the results of an earlier run in RUN2."""

    def run(self) -> int:
        """Edit the run; status 3 if the result cannot be trusted; report.json has the reasons.

        Raises:
            InputError: if the run cannot be read, or the frames are not in it.
        """
        from modeler.export import RunFolder, poses_of
        from modeler.runs.editing import edit
        from modeler.runs.outputs import check_run_folder, run_inputs
        from modeler.types import InputError

        if (self.drop is None) == (self.keep is None):
            raise InputError("give the frames to take out with --drop, or those to keep with --keep")
        frames = sorted(poses_of(RunFolder(self.run_folder).result()))
        chosen = _numbers(self.drop or self.keep or "", frames)
        dropped = chosen if self.keep is None else [frame for frame in frames if frame not in chosen]
        out = self.out or self.run_folder
        if out.resolve() != self.run_folder.resolve():
            check_run_folder(out, run_inputs([self.run_folder]), overwrite=self.overwrite)
        if not dropped:
            raise InputError(
                f"{self.run_folder}: no frame would be taken out; name some of {frames[0]} to {frames[-1]}"
            )
        done = edit(self.run_folder, dropped, out, overwrite=self.overwrite)
        left = len(done.report["poses"])
        say(f"{len(dropped)} of {len(frames)} frames taken out, {left} left: {out}")
        if done.unconnected:
            names = ", ".join(map(str, done.unconnected))
            say(f"left out, too, as nothing else joins them to the rest: {names}")
        if done.verdict.reasons:
            say(f"not to be trusted: {done.verdict.reasons[0]}")
        return 0 if done.verdict.trustworthy else 3


def _numbers(text: str, frames: Sequence[int]) -> list[int]:
    """Return the numbers that a list names, those in ranges only where they are frames."""
    from modeler.types import InputError

    found: list[int] = []
    for part in text.split(","):
        first, colon, end = (piece.strip() for piece in part.partition(":"))
        if not all(piece.isdecimal() or (colon and not piece) for piece in ((first, end) if colon else (first,))):
            raise InputError(f"{text[:99]!r} is no list of frames; write numbers and ranges, such as 7,12 or 7:10,15")
        if colon:
            low, high = int(first or frames[0]), int(end or frames[-1] + 1)
            found += [frame for frame in frames if low <= frame < high]
        else:
            found.append(int(first))
    return found
