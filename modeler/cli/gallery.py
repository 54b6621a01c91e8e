"""`modeler gallery`: many models on one page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from modeler.cli.console import bar, say
from modeler.cli.options import default


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
        """Write the page.

        Raises:
            InputError: if the folder holds no run, or the page cannot be written.
        """
        import os
        from urllib.parse import quote

        from modeler.cli.jobs import NOTES
        from modeler.cli.models import TABLE, models_in, thumbnail_of
        from modeler.cli.outputs import check_files
        from modeler.export.models_table import blank, write_table
        from modeler.system.regular_files import read_regular
        from modeler.types import InputError
        from modeler.viz.report.gallery import write_gallery

        out = self.folder / "gallery.html" if self.out is None else self.out
        check_files([out], [], overwrite=self.overwrite)
        rows = models_in(self.folder)
        if not rows:
            raise InputError(f"{self.folder}: holds no run folder; give the --out of modeler batch")
        write_table(self.folder / TABLE, rows)
        pictures, links = {}, {}
        with bar() as progress:
            for row in progress.track(rows):
                name = row["name"]
                if row.get("triangles"):
                    picture = self.folder / NOTES / f"{name}.jpg"
                    if not _newer(picture, self.folder / name / "model.ply"):
                        thumbnail_of(self.folder / name, picture)
                    if picture.exists():  # not so where the model was removed
                        pictures[name] = read_regular(picture)
                pages = [self.folder / name / page for page in ("report.html", "report.json")]
                page = next((page for page in pages if page.exists()), None)
                if page is not None:
                    links[name] = quote(Path(os.path.relpath(page, out.parent)).as_posix())
        write_gallery(out, self.folder.absolute().name, [blank() | row for row in rows], pictures, links)
        say(f"open {out} in a browser")
        return 0


def _newer(picture: Path, model: Path) -> bool:
    """Return whether the picture of a model is up to date, or the model was removed."""
    return picture.exists() and (not model.exists() or picture.stat().st_mtime_ns >= model.stat().st_mtime_ns)
