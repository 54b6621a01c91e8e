"""`modeler report`: a run as one page."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from modeler.types import Array


@dataclass(frozen=True)
class Report:
    """Write one HTML page about a run: model, trajectory, uncertainty, errors, pairs, settings. It needs no network.

    Errors and coverage are shown where the sequence is still where it was, and has ground truth.
    """

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Run folder, as `modeler build` makes it."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE.html", help_behavior_hint="(default: RUN/report.html)")] = (
        None
    )
    """Page to write."""
    sequence: Annotated[
        Path | None, tyro.conf.arg(metavar="SEQUENCE", help_behavior_hint="(default: as the run says)")
    ] = None
    """Where the sequence is now."""

    def run(self) -> int:
        """Write the page."""
        from modeler.cli.compose import open_sequence
        from modeler.export import RunFolder
        from viz.report import write_page

        out = self.run_folder / "report.html" if self.out is None else self.out
        report = RunFolder(self.run_folder).report()
        truth = _truth(Path(report["sequence"])) if self.sequence is None else open_sequence(self.sequence).truth()
        write_page(self.run_folder, out, truth)
        print(f"modeler: open {out} in a browser", file=sys.stderr)
        return 0


def _truth(path: Path) -> Mapping[int, Array] | None:
    """Return the true camera_from_model by frame number; None where there is none, or no sequence any more."""
    from modeler.cli.compose import open_sequence
    from modeler.types import InputError

    try:
        return open_sequence(path).truth()
    except InputError:
        return None
