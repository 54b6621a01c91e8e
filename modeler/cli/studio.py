"""`modeler studio`: the page in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from modeler.cli.console import say
from modeler.composition.options import default


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
        """Serve the page until Ctrl-C.

        Raises:
            InputError: if the folder cannot be used, or a package is missing.
        """
        from modeler.system.extras import check_installed
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
