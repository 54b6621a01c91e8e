"""`modeler view`, `report`, `gallery` and `studio`: runs in the viewer and in the browser."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from modeler.cli.console import bar, say
from modeler.cli.options import MovedOptions
from modeler.composition.options import default


@dataclass(frozen=True)
class View:
    """Open the recording of a run in the Rerun viewer."""

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Run folder of `modeler build`."""
    web: bool = False
    """Serve the viewer in the browser, on 127.0.0.1 only, until Ctrl-C."""

    def run(self) -> int:
        """Open the viewer; in the browser, wait until the user is done."""
        from modeler.viz import viewer

        opened = viewer.view(self.run_folder, web=self.web)
        if self.web:
            say(f"open {opened.address} in a browser; Ctrl-C ends it")
            opened.wait()
        return 0


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
        from modeler.export import RunFolder
        from modeler.export.run_folder import PAGE
        from modeler.runs.outputs import check_files, run_inputs
        from modeler.runs.reopening import parts_of, truth_of
        from modeler.types import InputError
        from modeler.viz.report import write_page

        out = self.run_folder / PAGE if self.out is None else self.out
        inputs = run_inputs([self.run_folder], self.moved.sequence)
        check_files([out], inputs[1:] if self.out is None else inputs, overwrite=self.overwrite)
        RunFolder(self.run_folder).result()  # refuses folders without a finished run
        truth, omitted = {}, ""
        try:
            parts = [part for part in parts_of(self.run_folder, self.moved.sequence) if part.truth()]
            for part in parts:
                part.check()
            truth = truth_of(parts)
        except InputError as error:
            if self.moved.sequence:
                raise
            omitted = f"errors against the truth are left out: {error}"
        write_page(self.run_folder, out, truth)
        if omitted:
            say(omitted)
        say(f"open {out} in a browser")
        return 0


@dataclass(frozen=True)
class Gallery:
    """Write one HTML page about the models in a folder: pictures and values, to sort and filter. It needs no network.

    Also updates the list DIR/models.parquet.
    """

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")]
    """Folder of run folders, from `modeler batch`."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE.html"), default("DIR/gallery.html")] = None
    """Page to write."""
    overwrite: bool = False
    """Replace an existing page."""

    def run(self) -> int:
        """Write the page."""
        import os
        from urllib.parse import quote

        from modeler.batch.jobs import NOTES
        from modeler.batch.models import TABLE, closed_in, models_in, thumbnail_of, write_gallery, write_table
        from modeler.runs.outputs import check_files
        from modeler.system.regular_files import read_regular
        from modeler.types import InputError

        out = self.folder / "gallery.html" if self.out is None else self.out
        check_files([out], [], overwrite=self.overwrite)
        rows = models_in(self.folder)
        if closed := closed_in(self.folder):
            say(f"{', '.join(closed)}: cannot be read (Permission denied), and left out; ask their owner")
        if not rows:
            raise InputError(f"{self.folder}: holds no run folder; give the --out of modeler batch")
        write_table(self.folder / TABLE, rows)
        pictures, links = {}, {}
        with bar() as progress:
            for row in progress.track(rows):
                name = row["name"]
                if row.get("triangles"):
                    picture = self.folder / NOTES / f"{name}.jpg"
                    thumbnail_of(self.folder / name, picture)
                    if picture.exists():  # not so where the model was removed
                        pictures[name] = read_regular(picture)
                pages = [self.folder / name / page for page in ("report.html", "report.json")]
                page = next((page for page in pages if page.exists()), None)
                if page is not None:
                    links[name] = quote(Path(os.path.relpath(page, out.parent)).as_posix())
        write_gallery(out, self.folder.absolute().name, rows, pictures, links)
        say(f"open {out} in a browser")
        return 0


@dataclass(frozen=True)
class Studio:
    """Make models in the browser: open captures, mark the object, build, check, export; on 127.0.0.1 only.

    What it makes is kept in a folder, run folders as of `modeler build` among it; the captures are only read. It shows
    the command line of each step.
    """

    folder: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="FOLDER"), default("choose there")] = (
        None
    )
    """A capture, or a folder with captures."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("studio")
    """Folder in which scans are kept: DIR/NAME/ for each capture, with masks, runs and exports."""
    port: Annotated[int, tyro.conf.arg(metavar="N"), default("a free one")] = 0
    """Port to serve on."""

    def run(self) -> int:
        """Serve the page until Ctrl-C."""
        from modeler.system.processes import check_installed
        from modeler.types import InputError

        check_installed("nicegui", "NiceGUI", "studio")
        from modeler.runs.outputs import check_folder
        from modeler.studio.server import serve
        from modeler.studio.state import Studio as State

        if self.folder is not None and not self.folder.exists():
            raise InputError(f"{self.folder}: no such folder or file; give a capture, or a folder with captures")
        capture = self.folder is not None and _is_capture(self.folder)
        if capture and self.folder is not None:
            check_folder(self.out, [self.folder])
        state = State(self.out, self.folder.absolute().parent if capture and self.folder else self.folder)
        if capture and self.folder is not None:
            state.open(self.folder)
        try:
            serve(state, self.port, lambda address: say(f"open {address} in a browser; Ctrl-C ends it"))
        except KeyboardInterrupt:
            say("ended; what was made is kept")
        return 0


def _is_capture(path: Path) -> bool:
    from modeler.sequences import open_sequence
    from modeler.types import InputError

    try:
        open_sequence(path)
    except InputError:
        if path.is_dir():
            return False
        raise
    return True
