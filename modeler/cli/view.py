"""`modeler view`: look at a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from modeler.cli.console import say


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
