"""The model of a run for a pose estimator, a simulator or a printer: all files that it needs, read back and checked."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from modeler import export as files
from modeler import se3
from modeler.export import datasets, solids
from modeler.export.datasets import PosedImages, share_within_masks, write_colmap, write_nerfstudio
from modeler.export.mesh import TRIANGLES, Texture
from modeler.export.placing import model_up
from modeler.export.usd import opened_usd, write_usd
from modeler.fusion import Fuser, FusionVolume, Symmetries, SymmetryFinder
from modeler.runs.outputs import check_files, check_folder, run_inputs
from modeler.runs.reopening import Reopened, reopened
from modeler.sequences import finest_unit_mm, write_bop
from modeler.system.pictures import encoded
from modeler.system.processes import check_installed, diverted
from modeler.types import Array, InputError, ObjectModel, areas_m2

SMALLEST_M: Final = 1e-3
LARGEST_M: Final = 10.0
"""An object of the hand or of the table has a size between these; of another size, the unit is wrong."""


@dataclass(frozen=True)
class Checks:
    """Statements about a file, and which of them do not hold."""

    held: tuple[str, ...] = ()
    """Passed checks, in words."""
    failed: tuple[str, ...] = ()
    """Failed checks, in words."""

    def also(self, holds: bool, words: str, otherwise: str = "") -> Checks:
        """Return the checks with one more: `words` where it holds, else `otherwise`, or `not` and the words."""
        if holds:
            return Checks((*self.held, words), self.failed)
        return Checks(self.held, (*self.failed, otherwise or f"not {words}"))

    def and_also(self, others: Checks) -> Checks:
        """Return these checks and others."""
        return Checks((*self.held, *others.held), (*self.failed, *others.failed))

    def attempt(self, what: Callable[[], tuple[bool, str]], absent: str) -> Checks:
        """Return the checks with that of a program, if installed.

        Args:
            what: returns whether it passes, and words; ValueError if the program rejects the file.
            absent: words if the program is not installed.
        """
        try:
            return self.also(*what())
        except ImportError:
            return Checks((*self.held, absent), self.failed)
        except ValueError as error:
            return Checks(self.held, (*self.failed, " ".join(str(error).split())))

    @property
    def words(self) -> str:
        """All of it in one line."""
        failed = f"; FAILED: {'; '.join(self.failed)}" if self.failed else ""
        return f"checked: {', '.join(self.held)}{failed}"


def loaded(path: Path) -> Any:
    """Return the one mesh in a file as trimesh reads it, corners at one place merged where the format keeps none."""
    import trimesh

    return trimesh.load_mesh(path, process=path.suffix.lower() == ".stl")


def mesh_checks(path: Path, *, unit_m: float = 1.0, most_triangles: int) -> Checks:
    """Return checks that every exported mesh has to pass: size, number and area of its triangles."""
    mesh = loaded(path)
    corners, triangles = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
    size_m = unit_m * np.ptp(corners, axis=0)
    flat = int(np.count_nonzero(areas_m2(corners, triangles) * unit_m**2 <= 1e-14))
    unit = "m" if unit_m == 1.0 else "mm"
    size = " x ".join(f"{length:.3g}" for length in size_m / unit_m)
    return (
        Checks()
        .also(bool(SMALLEST_M < size_m.max() < LARGEST_M), f"{size} {unit}", f"a size of {size} {unit} is implausible")
        .also(len(triangles) <= most_triangles, f"{len(triangles)} triangles", f"{len(triangles)} triangles: too many")
        .also(not flat, "none degenerate", f"{flat} degenerate triangles")
    )


_MESHES: Final = {"foundationpose": "model.obj", "print": "model.stl"}

Purpose = Literal["foundationpose", "bop", "mujoco", "urdf", "isaac", "gazebo", "print", "nerfstudio", "colmap"]
"""Programs for which there are presets."""


@dataclass(frozen=True)
class Preset:
    """One export for one program."""

    run_folder: Path
    out: Path
    purpose: Purpose
    say: Callable[[str], None]
    """Receives what is worth knowing of the files, in words."""
    overwrite: bool
    triangles: int | None
    """Simplify the mesh to so many; None: what the program and the detail need."""
    texture_px: int
    voxel_m: float | None
    """Side of a voxel; None: as in the run."""
    density_kg_m3: float | None
    """Density of the solid; None: that of water."""
    mass_kg: float | None
    sequences: tuple[Path, ...]
    """Where the sequences of the run are now; none: where they were."""

    def write(self) -> Checks:
        """Write the files, read them back, and return the checks."""
        inputs = run_inputs([self.run_folder], self.sequences)
        check_folder(self.out, inputs)
        if self.out.suffix.lower() in files.FORMATS:
            raise InputError(f"{self.out}: `purpose` {self.purpose} writes a folder; give `out` a name without suffix")
        if os.path.lexists(self.out) and not self.out.is_dir():
            raise InputError(f"{self.out}: is not a folder; choose another `out`")
        if self.purpose == "isaac":
            check_installed("pxr", "usd-core", "usd")
        check_files(self._outs(), inputs, overwrite=self.overwrite)
        scenes = self.out / "onboarding_static"
        if self.purpose == "bop" and scenes.exists() and (not scenes.is_dir() or any(scenes.iterdir())):
            raise InputError(f"{scenes}: exists already; remove it or give another `out`")
        report = files.RunFolder(self.run_folder).result()
        if not report.get("poses"):
            raise InputError(f"{self.run_folder}: no frame of this run was accepted; report.json says why")
        written: Mapping[Purpose, Callable[[], Checks]] = {
            "foundationpose": self._foundationpose,
            "bop": self._bop,
            "mujoco": self._mujoco,
            "urdf": self._urdf,
            "isaac": self._isaac,
            "gazebo": self._gazebo,
            "print": self._print,
            "nerfstudio": self._posed_images,
            "colmap": self._posed_images,
        }
        return written[self.purpose]()

    def _outs(self) -> tuple[Path, ...]:
        """Return the files to write, except convex parts and scenes, whose number is unknown before."""
        if self.purpose == "bop":
            return (self._bop_model, self._bop_model.with_name(datasets.MODELS_INFO))
        if self.purpose in _MESHES:
            meshes = files.files_of(self._mesh, textured=self.purpose == "foundationpose")
            return (*meshes, files.pose_file(self._mesh))
        if self.purpose == "nerfstudio":
            return (self.out / "transforms.json", self._points, files.pose_file(self._points))
        if self.purpose == "colmap":
            return (*(self.out / "sparse" / "0" / f"{name}.bin" for name in ("cameras", "images", "points3D")),)
        of = solids.PhysicsFiles(self.out, coloured=True)
        if self.purpose == "isaac":
            return (of.model(".usd"), of.texture, files.pose_file(of.model(".usd")))
        of_programs = {
            "mujoco": (of.model(".xml"), self.out / solids.MUJOCO_SCENE),
            "urdf": (of.model(".urdf"),),
            "gazebo": tuple(self.out / name for name in solids.GAZEBO),
        }
        model = of_programs[self.purpose]
        return (*model, *files.files_of(of.visual, textured=True), files.pose_file(of.visual), of.part(0))

    @property
    def _mesh(self) -> Path:
        """The mesh of a preset that writes only one."""
        return self.out / _MESHES[self.purpose]

    @cached_property
    def _reopened(self) -> Reopened:
        return reopened(self.run_folder, self.sequences, self.say)

    @cached_property
    def _volume(self) -> FusionVolume:
        run = self._reopened
        return run.volume(Fuser(voxel_m=self.voxel_m or run.report["settings"].get("voxel_m")))

    def _model(self, *, watertight: bool) -> ObjectModel:
        """Return the mesh in the object frame."""
        model = self._reopened.model(self._volume, watertight=watertight)
        if not len(model.triangles):
            raise InputError(f"{self.run_folder}: its views give no surface; more of them are needed")
        return model

    def _coloured(self, model: ObjectModel) -> tuple[ObjectModel, Texture | None]:
        """Return the mesh, simplified and without degenerate triangles, with its texture where frames have colour."""
        coloured = self._volume.views.coloured
        if self.triangles is None:  # without texture 50,000 at most
            model = files.simplified(files.simplified(model), TRIANGLES if coloured else 50_000)
        else:
            model = files.simplified(model, self.triangles)
        model = solids.without_degenerate(model)
        if not coloured:
            return model, None
        return files.textured(model, self._volume.texture_colours, self.texture_px)

    def _foundationpose(self) -> Checks:
        out = self._mesh
        model, texture = self._coloured(self._model(watertight=False))
        place = files.placement(model, self._reopened.report, "bbox", "z")
        files.write_mesh(place.placed(model), out, texture, axes=place.axes)
        place.write(out)
        self._report(place)
        checks = mesh_checks(out, most_triangles=solids.MOST_TRIANGLES)
        if texture is None:
            return checks.also(True, "no texture, as the frames have no colour")
        mesh = loaded(out)
        height, width = texture.image.shape[:2]
        uv = np.asarray(mesh.visual.uv)
        return checks.also(
            bool(mesh.visual.material.image is not None and np.isfinite(uv).all()),
            f"texture of {width} x {height} px",
            "its texture cannot be read",
        )

    def _print(self) -> Checks:
        out = self._mesh
        model = files.simplified(self._model(watertight=True), self.triangles)
        place = files.placement(model, self._reopened.report, "base", "z")
        base_known = place.up_from == "support"
        flat = solids.with_flat_bottom(place.placed(model), self._volume.grid.voxel_m if base_known else None)
        files.write_mesh(replace(flat, vertices_m=1000.0 * flat.vertices_m), out, axes=place.axes, unit="mm")
        place.write(out, unit="mm")
        self._report(place)
        mesh = loaded(out)
        corners_m = np.asarray(mesh.vertices, dtype=np.float64) / 1000.0
        area_m2 = solids.bottom_area_m2(corners_m, np.asarray(mesh.faces))
        footprint_m2 = float(np.prod(np.ptp(corners_m[:, :2], axis=0)))
        how = "" if base_known else " (cut there, as no support was seen)"
        size = " x ".join(f"{length:.1f}" for length in 1000.0 * np.ptp(corners_m, axis=0))
        return (
            Checks()
            .also(bool(mesh.is_watertight and mesh.is_winding_consistent), "watertight")
            .also(bool(mesh.volume > 0.0), f"{mesh.volume / 1000.0:.1f} cm³", "it encloses no volume")
            .also(
                area_m2 > 0.02 * footprint_m2,
                f"bottom flat on {1e4 * area_m2:.1f} cm²{how}",
                f"its bottom is flat on only {1e4 * area_m2:.1f} cm²",
            )
            .also(True, f"{size} mm")
        )

    def _mujoco(self) -> Checks:
        solid = self._solid_files()
        solids.write_mjcf(solid.of, solid.body, solid.parts)

        def settles() -> tuple[bool, str]:
            settled = solids.settled_in_mujoco(self.out / solids.MUJOCO_SCENE)
            return settled.at_rest, settled.words

        return solid.file_checks().attempt(settles, "MuJoCo is not installed, so not loaded there")

    def _urdf(self) -> Checks:
        solid = self._solid_files()
        solids.write_urdf(solid.of, solid.body, solid.parts)

        def settles() -> tuple[bool, str]:
            with diverted(1):  # PyBullet writes to stdout by itself
                settled = solids.settled_in_pybullet(solid.of.model(".urdf"), solids.drop_height_m(solid.parts))
            return settled.at_rest, settled.words

        return solid.file_checks().attempt(settles, "PyBullet is not installed, so not loaded there")

    def _gazebo(self) -> Checks:
        solid = self._solid_files()
        solids.write_sdf(solid.of, solid.body, solid.parts)
        return solid.file_checks()

    def _isaac(self) -> Checks:
        solid = self._solid()
        of = solid.of
        write_usd(of, solid.model, solid.texture, solid.body, solid.parts)
        if solid.texture is not None:
            files.write_atomically(of.texture, encoded(solid.texture.image, "PNG"))
        solid.place.write(of.model(".usd"))
        return Checks().also(*opened_usd(of.model(".usd"))).and_also(solid.checks())

    def _solid_files(self) -> _Solid:
        """Write the visual mesh and the convex parts of the solid, and return it."""
        solid = self._solid()
        of = solid.of
        files.write_mesh(solid.model, of.visual, solid.texture, axes=solid.place.axes)
        solid.place.write(of.visual)
        solids.write_parts(of, solid.parts)
        return solid

    def _solid(self) -> _Solid:
        whole = self._model(watertight=True)
        place = files.placement(whole, self._reopened.report, "base", "z")
        density = self.density_kg_m3 or 1000.0  # water's; plastics have 900 to 1400, wood 400 to 800
        body = solids.body_of(place.placed(whole), density_kg_m3=density, mass_kg=self.mass_kg)
        self.say("finding convex parts, which takes some 10 s with CoACD")
        parts = solids.convex_parts(place.placed(whole))
        model, texture = self._coloured(whole)
        of = solids.PhysicsFiles(self.out, texture is not None)
        self._report(place)
        source = "as given" if self.mass_kg is not None else f"at {density:g} kg/m³"
        self.say(f"{body.mass_kg:.3g} kg {source}; friction {solids.FRICTION[0]:g}, a default: neither is measured")
        return _Solid(of, place, place.placed(model), texture, body, parts)

    @property
    def _points(self) -> Path:
        """Initial points of a data set for radiance fields."""
        return self.out / "points.ply"

    def _posed_images(self) -> Checks:
        run, out = self._reopened, self.out
        if any(view.frame.colour is None for view in run.views.values()):
            raise InputError(f"{self.run_folder}: its frames have no colour, which {self.purpose} is about")
        model = self._model(watertight=False)
        place = files.placement(model, run.report, "base", "z")
        mesh_from_object = se3.inverse(place.object_from_mesh)
        poses = {k: mesh_from_object @ pose for k, pose in run.solution.trajectory.items() if k in run.views}
        data = PosedImages.of(place.placed(model), {k: run.views[k].frame for k in poses}, poses)
        self._report(place)
        if self.purpose == "nerfstudio":
            write_nerfstudio(data, out)
            place.write(self._points)
            share = share_within_masks(out)
            words = f"{100.0 * share:.0f} % of {len(data.points_m)} points within the masks of {len(poses)} images"
            # Some lie at the rim, or behind a hand.
            return Checks().also(share > 0.9, words, f"only {words}")
        tolerance_m = 3.0 * max(view.sigma_r_m for view in run.views.values())
        count = write_colmap(data, out, tolerance_m)
        return Checks().also(count > 0, f"{count} points seen in {len(poses)} images", "no image sees a point")

    @property
    def _bop_model(self) -> Path:
        return self.out / "models" / "obj_000001.ply"

    def _bop(self) -> Checks:
        run, out = self._reopened, self.out
        scenes = {
            f"obj_000001_{side}": {frame: run.views[frame] for frame in frames}
            for side, frames in self._sides().items()
        }
        model = self._model(watertight=False)
        if self.triangles is not None:
            model = files.simplified(model, self.triangles)
        model = solids.without_degenerate(model)
        place = files.placement(model, run.report, "bbox", "z")
        found = SymmetryFinder().find_in(model, model_up(run.report)[0])
        entries = _symmetry_entries(found, place.object_from_mesh)
        files.write_bop(model, self._bop_model, place, entries)
        self._report(place)
        self.say(found.words)
        placed, count = place.placed(model), 0
        for name, views in scenes.items():
            poses = {k: se3.inverse(run.solution.trajectory[k]) @ place.object_from_mesh for k in views}
            shots = {k: view.frame for k, view in views.items() if k in poses}
            farthest_m = max(float(np.nanmax(frame.depth_m)) for frame in shots.values())
            write_bop(
                out / "onboarding_static" / name,
                shots.values(),
                poses,
                {"name": run.name},
                depth_scale_mm=finest_unit_mm(farthest_m),
                files={"scene_gt_info.json": files.scene_gt_info(placed, shots.values(), poses).encode()},
            )
            count += len(shots)
        words = f"{count} frames with masks, boxes and poses in {len(scenes)} scene{'s' if len(scenes) > 1 else ''}"
        return mesh_checks(self._bop_model, unit_m=1e-3, most_triangles=10**7).also(self._reads_back(scenes), words)

    def _sides(self) -> dict[str, list[int]]:
        """Return the frames of each scene: BOP's static onboarding has one of the object upright, one turned over."""
        run, sides = self._reopened, {}
        for number, part in enumerate(run.parts):
            side = ("up", "down")[number] if number < 2 else f"part{number + 1}"
            own = (frame + part.offset for frame in part.accepted)
            sides[side] = [frame for frame in own if frame in run.views and frame in run.solution.trajectory]
        return {side: frames for side, frames in sides.items() if frames}

    def _reads_back(self, scenes: dict[str, dict]) -> bool:
        """Return whether the scenes are read with a pose and a mask for every frame."""
        from modeler.sequences import open_sequence

        for name, views in scenes.items():
            sequence = open_sequence(self.out / "onboarding_static" / name)
            truth = sequence.truth() or {}
            if {*sequence.indices} != {*views} or {*truth} != {*views}:
                return False
            if any(sequence.frame(index).mask is None for index in views):
                return False
        return True

    def _report(self, place: files.Placement) -> None:
        self.say(f"{self.out}: {place.words}")


def _symmetry_entries(found: Symmetries, object_from_mesh: Array) -> dict[str, Any]:
    """Return the symmetries for `models_info.json`: BOP's are those that colour does not resolve.

    Those of the shape alone are added as `shape_symmetries_…`, if there is colour.
    """

    def entries(of: Symmetries) -> dict[str, Any]:
        axes = ((axis.direction, axis.point_m) for axis in of.continuous)
        return datasets.symmetry_entries(of.discrete, axes, object_from_mesh)

    left, of_shape = found.with_colour, entries(found)
    if left is None:
        found_entries = of_shape
    else:
        found_entries = {**entries(left), **{f"shape_{name}": values for name, values in of_shape.items()}}
    return {**found_entries, "symmetries_tolerance_mm": 1000.0 * found.tolerance_m}


@dataclass(frozen=True, eq=False)
class _Solid:
    """An object for simulators."""

    of: solids.PhysicsFiles
    """Where its files lie."""
    place: files.Placement
    """The frame of all of it."""
    model: ObjectModel
    """The mesh that is shown."""
    texture: Texture | None
    body: solids.Body
    parts: solids.ConvexParts
    """What collides."""

    def checks(self) -> Checks:
        """Return what is to be said of its mass and its parts."""
        return (
            Checks()
            .also(True, f"closed around {1e6 * self.body.volume_m3:.1f} cm³")
            .also(solids.is_possible_inertia(self.body.inertia_kg_m2), "physically possible inertia")
            .also(True, self.parts.method)
        )

    def file_checks(self) -> Checks:
        """Return the same after checks of the files of its meshes."""
        convex = all(loaded(self.of.part(k)).is_convex for k in range(len(self.parts.meshes)))
        meshes = mesh_checks(self.of.visual, most_triangles=solids.MOST_TRIANGLES).also(convex, "parts convex")
        return meshes.and_also(self.checks())
