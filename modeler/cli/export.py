"""`modeler export`: the fused mesh in the format of another program."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from modeler.cli.options import IdleSeed, MovedOptions, default


@dataclass(frozen=True)
class Export:
    """Write the fused mesh of a run as PLY, OBJ, GLB or STL, in m, object frame.

    The axes are those of the camera at the first frame: x right, y down, z forward. A GLB's node turns them so that y
    is up, as glTF has it, and the model stands as it stood. What --watertight, --texture and --voxel-m ask for is made
    anew from the frames, so the sequence must be there.
    """

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Run folder, as `modeler build` makes it."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE.{ply,obj,glb,stl}")]
    """File to write; its ending selects the format. STL carries no colour."""
    watertight: bool = False
    """Close what nobody saw with made-up surface. In PLY its vertices have 0 `views` and a `sigma_m` of -1."""
    triangles: Annotated[int | None, tyro.conf.arg(metavar="N"), default("all")] = None
    """Simplify the mesh to so many triangles. With --texture 8000 unless given: the detail is in the image."""
    texture: bool = False
    """Colour by an image wrapped around the mesh, from the sharpest frontal views (OBJ with MTL and PNG, GLB)."""
    bop: bool = False
    """Write a BOP model: PLY in mm, origin in the centre of its box, and its entry in models_info.json."""
    tint: Annotated[Literal["views", "sigma"] | None, default("none")] = None
    """Colour vertices by the number of views that saw them or by their standard deviation; made-up surface is pink."""
    voxel_m: Annotated[float | None, tyro.conf.arg(metavar="M"), default("as the data")] = None
    """Side of a voxel: detail of the mesh."""
    moved: MovedOptions = field(default_factory=MovedOptions)
    randomness: IdleSeed = field(default_factory=IdleSeed)

    def run(self) -> int:
        """Write the mesh."""
        from modeler.cli.exporting import export

        export(self)
        return 0
