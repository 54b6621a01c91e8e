"""`modeler export`: the fused mesh in the format of another program."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from modeler.cli.console import say
from modeler.cli.options import MovedOptions, check_voxel
from modeler.composition.options import default

Origin = Literal["camera", "base", "centre", "bbox"]  # spelt out here, for help imports nothing heavy
Up = Literal["z", "y"]
Purpose = Literal["foundationpose", "bop", "mujoco", "urdf", "isaac", "gazebo", "print", "nerfstudio", "colmap"]
_BODIES = ("mujoco", "urdf", "isaac", "gazebo")

if TYPE_CHECKING:
    from modeler.export.mesh import Texture
    from modeler.fusion import FusionVolume
    from modeler.types import ObjectModel


@dataclass(frozen=True)
class Export:
    """Write the fused mesh of a run as PLY, OBJ, GLB, STL or 3MF, in m.

    The centre of its base is the origin and z is up, in GLB y; FILE.pose.json has the pose that maps it back to where
    the first camera saw it. --watertight, --texture and --voxel-m fuse again from the frames, so the sequence must be
    available.
    """

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Run folder of `modeler build`."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE.{ply,obj,glb,stl,3mf} or DIR")]
    """File to write; its suffix selects the format. STL has no colour. With --for a folder."""
    purpose: Annotated[Purpose | None, tyro.conf.arg(name="for"), default("none")] = None
    """Write a folder with all files for a program, read them back and check them: foundationpose (OBJ with texture),
    bop (models and onboarding_static), mujoco, urdf, isaac (OpenUSD) and gazebo (SDF) with mesh, convex parts, mass and
    inertia, print (watertight STL in mm with a flat bottom), nerfstudio and colmap (images with masks and
    cameras around the object at rest, for radiance fields and splats)."""
    overwrite: bool = False
    """Replace existing files."""
    origin: Annotated[Origin | None, default("base")] = None
    """Origin: the centre of the base, the centroid of the surface, the centre of its box, or the first camera, whose
    axes (x right, y down, z forward) are then kept, as in the run's own model.ply."""
    up: Annotated[Up | None, default("y for GLB, z otherwise")] = None
    """Up axis: the support's normal; without a support, from the ring of cameras or the image."""
    watertight: bool = False
    """Fill unobserved regions with interpolated surface. In PLY its vertices have 0 `views` and a `sigma_m` of -1."""
    triangles: Annotated[
        int | None, tyro.conf.arg(metavar="N"), default("as few as half a standard deviation allows")
    ] = None
    """Simplify the mesh to N triangles. Unless given, those with --texture are 8000 at most, the detail being in the
    image, and meshes with colours of vertices keep all triangles, since these carry the print."""
    texture: bool = False
    """Colour by an image wrapped around the mesh, from the sharpest frontal views (OBJ with MTL and PNG, GLB)."""
    texture_px: int = 2048
    """Side of that image, a square; programs that read textures commonly take so many."""
    bop: bool = False
    """Write a BOP model: PLY in mm, origin in the centre of its box, z up, and its entry in models_info.json; the frame
    of --for bop."""
    tint: Annotated[Literal["views", "sigma"] | None, default("none")] = None
    """Colour vertices by the number of views that saw them or by their standard deviation; interpolated surface is
    pink."""
    voxel_m: Annotated[float | None, tyro.conf.arg(metavar="M"), default("from the data")] = None
    """Side of a voxel."""
    density_kg_m3: Annotated[float | None, default("1000, that of water")] = None
    """Density of the solid, with --for mujoco, urdf, isaac and gazebo."""
    mass_kg: Annotated[float | None, default("from the density")] = None
    """Mass, instead of a density."""
    moved: MovedOptions = field(default_factory=MovedOptions)

    def run(self) -> int:
        """Write the mesh."""
        if self.purpose is not None:
            return self._for(self.purpose)
        from modeler import export as files
        from modeler.export.mesh import TRIANGLES
        from modeler.runs.outputs import check_files, run_inputs
        from modeler.types import InputError

        _check(self)
        outs = files.files_of(self.out, textured=self.texture)
        origin: Origin = self.origin or "base"
        up = self.up or files.default_up(self.out.suffix.lower(), origin)
        as_seen = self.bop or (origin == "camera" and up is None)  # where a sidecar would say nothing
        outs = outs if as_seen else (*outs, files.pose_file(self.out))
        check_files(outs, run_inputs([self.run_folder], self.moved.sequence), overwrite=self.overwrite)
        report = files.RunFolder(self.run_folder).result()  # a sequence may hold a model.ply as well: the true one
        if not report.get("poses"):
            raise InputError(f"{self.run_folder}: no frame of this run was accepted; report.json says why")
        volume, model = _fused(self)
        if model is None:
            model = files.read_model(files.mesh_of(self.run_folder))
        elif not len(model.triangles):
            raise InputError(f"{self.run_folder}: its views give no surface; more of them are needed")
        if self.tint is not None:
            model = files.tinted(model, self.tint)
        if self.triangles is not None:
            model = files.simplified(model, self.triangles)
        elif self.texture:
            model = files.simplified(files.simplified(model), TRIANGLES)
        elif model.vertex_colours is None or self.out.suffix.lower() == ".stl":
            model = files.simplified(model)
        texture = None
        if self.texture and volume is not None:
            if not volume.views.coloured:
                raise InputError(f"{self.run_folder}: its frames have no colour; leave out --texture")
            model, texture = files.textured(model, volume.texture_colours, self.texture_px)
            say(texture_words(texture, volume))
        if self.bop:
            place = files.placement(model, report, "bbox", "z")
            files.write_bop(model, self.out, place)
            _report(model, self)
            say(f"{place.words}; in mm")
        elif as_seen:
            files.write_mesh(model, self.out, texture, object_from_upright=files.model_upright(report))
            _report(model, self)
        else:
            place = files.placement(model, report, origin, up)
            files.write_mesh(
                place.placed(model), self.out, texture, object_from_upright=files.AS_GIVEN, axes=place.axes
            )
            place.write(self.out)
            _report(model, self)
            say(f"{place.words}; the pose in the camera: {files.pose_file(self.out).name}")
        return 0

    def _for(self, purpose: Purpose) -> int:
        """Write what a program needs."""
        from modeler.runs.presets import Preset

        _check_numbers(self)
        _check_preset(self, purpose)
        checks = Preset(
            self.run_folder,
            self.out,
            purpose,
            say,
            overwrite=self.overwrite,
            triangles=self.triangles,
            texture_px=self.texture_px,
            voxel_m=self.voxel_m,
            density_kg_m3=self.density_kg_m3,
            mass_kg=self.mass_kg,
            sequences=self.moved.sequence,
        ).write()
        say(checks.words)
        return 3 if checks.failed else 0


def texture_words(texture: Texture, volume: FusionVolume) -> str:
    """Return the resolution of a texture, compared with that of the images."""
    side_px = len(texture.image)
    words = f"texture of {side_px} x {side_px} px, {1000.0 * texture.texel_m:.2g} mm each"
    coarse = texture.texel_m > volume.pixel_m
    return f"{words}, coarser than the images: --texture-px {2 * side_px} keeps their detail" if coarse else words


def _check(options: Export) -> None:
    """Refuse options that exclude each other before anything is worked out."""
    from modeler.export import format_of
    from modeler.export.mesh import TEXTURED
    from modeler.types import InputError

    suffix = format_of(options.out)
    if options.texture and (options.bop or suffix not in TEXTURED):
        raise InputError(f"{options.out}: --texture goes with {' and '.join(TEXTURED)} alone; choose another --out")
    if options.texture and options.tint is not None:
        raise InputError("--texture and --tint are two ways to colour; give one of them")
    if options.tint is not None and suffix == ".stl":
        raise InputError(f"{options.out}: STL carries no colour for --tint; choose another --out")
    if options.bop and suffix != ".ply":
        raise InputError(f"{options.out}: BOP models are PLY files; give --out a name such as obj_000001.ply")
    if options.bop and (options.origin or options.up):
        raise InputError("--bop puts the origin in the centre of the box, z up; leave out --origin and --up")
    if options.density_kg_m3 is not None or options.mass_kg is not None:
        raise InputError(f"--density-kg-m3 and --mass-kg go with --for {', '.join(_BODIES)} alone")
    _check_numbers(options)


def _check_preset(options: Export, purpose: Purpose) -> None:
    """Refuse options that a preset decides on, or that go with other presets."""
    from modeler.types import InputError

    given = [name for name in ("origin", "up", "watertight", "texture", "bop", "tint") if getattr(options, name)]
    if given:
        raise InputError(f"--for {purpose} decides on --{given[0]}; leave it out")
    bodies = {"density-kg-m3": options.density_kg_m3, "mass-kg": options.mass_kg}
    of_bodies = [name for name, value in bodies.items() if value is not None]
    if of_bodies and purpose not in _BODIES:
        raise InputError(f"--{of_bodies[0]} goes with --for {', '.join(_BODIES)} alone")


def _check_numbers(options: Export) -> None:
    """Refuse numbers that are out of range."""
    from modeler.types import InputError

    if options.triangles is not None and options.triangles < 4:
        raise InputError(f"--triangles {options.triangles} is too few for a solid; give at least 4")
    if not 64 <= options.texture_px <= 8192:
        raise InputError(f"--texture-px {options.texture_px} is out of range; give 64 to 8192")
    check_voxel(options.voxel_m)
    for name, value in (("density-kg-m3", options.density_kg_m3), ("mass-kg", options.mass_kg)):
        if value is not None and not 0.0 < value < 1e6:
            raise InputError(f"--{name} {value:g} is out of range; give a positive number")
    if options.density_kg_m3 is not None and options.mass_kg is not None:
        raise InputError("--density-kg-m3 and --mass-kg both give the mass; give one of them")


def _fused(options: Export) -> tuple[FusionVolume, ObjectModel] | tuple[None, None]:
    """Return the views of the run and their model, if the mesh has to be fused again."""
    if not (options.watertight or options.texture or options.voxel_m is not None):
        return None, None
    from modeler.fusion import Fuser
    from modeler.runs.reopening import reopened

    run = reopened(options.run_folder, options.moved.sequence, say)
    volume = run.volume(Fuser(voxel_m=options.voxel_m or run.report["settings"].get("voxel_m")))
    return volume, run.model(volume, watertight=options.watertight)


def _report(model: ObjectModel, options: Export) -> None:
    """Report on stderr the file and the interpolated share."""
    interpolated = ""
    if options.watertight and model.vertex_views is not None:
        interpolated = f", {100.0 * float((model.vertex_views == 0).mean()):.0f} % of the vertices interpolated"
    say(f"{len(model.triangles)} triangles{interpolated}: {options.out}")
