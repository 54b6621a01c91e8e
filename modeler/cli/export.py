"""`modeler export`: the fused mesh in the format of another program."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Export:
    """Write the fused mesh of a run as PLY, OBJ, GLB or STL."""

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Run folder, as `modeler build` makes it."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE.{ply,obj,glb,stl}")]
    """File to write, in m; its ending selects the format. STL carries no colour."""

    def run(self) -> int:
        """Convert the mesh."""
        from modeler.export import export_mesh

        export_mesh(self.run_folder, self.out)
        return 0
