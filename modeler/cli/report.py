"""`modeler report`: a run as one page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from modeler.cli.console import say
from modeler.cli.options import MovedOptions, default

if TYPE_CHECKING:
    from modeler.types import Array


@dataclass(frozen=True)
class Report:
    """Write one HTML page about a run: model, trajectory, uncertainty, errors, pairs, settings. It needs no network.

    Errors and coverage are shown if the sequence is available and has ground truth.
    """

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Run folder of `modeler build`."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE.html"), default("RUN/report.html")] = None
    """Page to write."""
    overwrite: bool = False
    """Replace an existing page."""
    moved: MovedOptions = field(default_factory=MovedOptions)

    def run(self) -> int:
        """Write the page."""
        from modeler.cli.outputs import check_files, run_inputs
        from modeler.export import RunFolder
        from modeler.export.run_folder import PAGE
        from modeler.types import InputError
        from modeler.viz.report import write_page

        out = self.run_folder / PAGE if self.out is None else self.out
        inputs = run_inputs([self.run_folder], self.moved.sequence)
        check_files([out], inputs[1:] if self.out is None else inputs, overwrite=self.overwrite)
        RunFolder(self.run_folder).result()  # refuses folders without a finished run
        try:
            truth = _truth(self.run_folder, self.moved.sequence)
        except InputError:
            if self.moved.sequence:
                raise
            truth = None
        write_page(self.run_folder, out, truth)
        say(f"open {out} in a browser")
        return 0


def _truth(run: Path, sequences: tuple[Path, ...]) -> Mapping[int, Array] | None:
    """Return the true camera_from_model by frame number; None if unknown.

    Raises:
        InputError: if a sequence is not to be found, or is another than the run was made from.
    """
    from modeler.cli.inputs import parts_of

    poses: dict[int, Array] = {}
    for part in parts_of(run, sequences):
        truth = part.truth()
        if truth is not None:
            part.check()
            poses |= truth
    return poses or None
