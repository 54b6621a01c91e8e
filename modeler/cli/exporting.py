"""What `modeler export` does once it is understood."""

from __future__ import annotations

import numpy as np

from modeler import export as files
from modeler.cli.export import Export
from modeler.cli.reopened import reopened
from modeler.cli.saying import say
from modeler.export.mesh import TEXTURED
from modeler.export.texture import TRIANGLES
from modeler.fusion import Fuser, FusionVolume
from modeler.types import InputError, ObjectModel


def export(options: Export) -> None:
    """Write the mesh of a run as asked for.

    Raises:
        InputError: where the options exclude each other, or something cannot be read or written.
    """
    _check(options)
    report = files.RunFolder(options.run_folder).result()  # a sequence may hold a model.ply as well: the true one
    if not report.get("poses"):
        raise InputError(f"{options.run_folder}: no frame of this run was accepted; report.json says why")
    volume = _volume(options)
    if volume is None:
        model = files.read_model(files.mesh_of(options.run_folder))
    else:
        model = volume.model(watertight=options.watertight)
        if not len(model.triangles):
            raise InputError(f"{options.run_folder}: its views give no surface; more of them are needed")
    if options.tint is not None:
        model = files.tinted(model, options.tint)
    count = options.triangles or (TRIANGLES if options.texture else None)
    if count is not None:
        model = files.simplified(model, count)
    texture = None
    if options.texture and volume is not None:
        if not volume.views.coloured.any():
            raise InputError(f"{options.run_folder}: its frames have no colour; leave out --texture")
        model, texture = files.textured(model, volume.painted, volume.texel_m)
    if options.bop:
        files.write_bop(model, options.out)
    else:
        files.write_mesh(model, options.out, texture, object_from_upright=files.model_upright(report))
    _tell(model, options)


def _check(options: Export) -> None:
    """Refuse options that exclude each other before anything is worked out."""
    suffix = files.format_of(options.out)
    if options.texture and (options.bop or suffix not in TEXTURED):
        raise InputError(f"{options.out}: --texture goes with {' and '.join(TEXTURED)} alone; choose another --out")
    if options.texture and options.tint is not None:
        raise InputError("--texture and --tint are two ways to colour; give one of them")
    if options.tint is not None and suffix == ".stl":
        raise InputError(f"{options.out}: STL carries no colour for --tint; choose another --out")
    if options.bop and suffix != ".ply":
        raise InputError(f"{options.out}: BOP models are PLY files; give --out a name such as obj_000001.ply")
    if options.triangles is not None and options.triangles < 4:
        raise InputError(f"--triangles {options.triangles} is too few for a solid; give at least 4")
    if options.voxel_m is not None and not 0.0 < options.voxel_m < 1.0:
        raise InputError(f"--voxel-m {options.voxel_m:g} is out of range; give a length in m between 0 and 1")


def _volume(options: Export) -> FusionVolume | None:
    """Return the views of the run, where the mesh has to be made anew."""
    if not (options.watertight or options.texture or options.voxel_m is not None):
        return None
    run = reopened(options.run_folder, options.moved.sequence)
    return run.volume(Fuser(voxel_m=options.voxel_m or run.report["settings"].get("voxel_m")))


def _tell(model: ObjectModel, options: Export) -> None:
    """Say on stderr what was written, and how much of it nobody saw."""
    made_up = ""
    if options.watertight and model.vertex_views is not None:
        made_up = f", {100.0 * float(np.mean(model.vertex_views == 0)):.0f} % of the vertices made up"
    say(f"{len(model.triangles)} triangles{made_up}: {options.out}")
