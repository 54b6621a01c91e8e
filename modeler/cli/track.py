"""`modeler track`: an object found in new images with its model, and followed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from modeler.cli.console import Interrupt, say
from modeler.cli.options import FrameOptions, InputOptions, WatchOptions
from modeler.composition.options import SEED, MethodOptions, ObjectOptions, PriorOptions, default
from modeler.runs.compiling import compile_kernels

if TYPE_CHECKING:
    from collections.abc import Sequence

    from modeler.runs.known_objects import KnownObject, TrackFolder
    from modeler.sequences import AbstractSequence
    from modeler.tracking import Tracked, Tracker


@dataclass(frozen=True)
class Track:
    """Find an object in new images with its model, and follow it: poses with covariance, or that it is not there.

    Its motion is predicted from the frames before; where the images contradict that, it is looked for with any
    rotation, as in the first frame. Ctrl-C ends with the frames so far.
    """

    model: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MODEL")]
    """Run folder of `modeler build`, or a mesh: PLY, OBJ, GLB or STL."""
    sequence: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SEQUENCE")]
    """A sequence in any format that `modeler build` takes; realsense: and others for a connected camera."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder to create: poses.json, trajectory.txt, bop.csv, recording.rrd and report.html."""
    unit: Annotated[Literal["m", "cm", "mm"] | None, default("m; mm beside a models_info.json")] = None
    """Unit of lengths in a mesh file."""
    independent: bool = False
    """Look for the object in each frame for itself, with any rotation."""
    overwrite: bool = False
    """Replace the results of an earlier track in the folder."""
    sensor: Annotated[Path | None, tyro.conf.arg(metavar="FILE"), default("from SEQUENCE")] = None
    """Noise of the depth camera, as `modeler calibrate-sensor` measured it."""
    camera: Annotated[Path | None, tyro.conf.arg(metavar="FILE"), default("from the run, if of the same camera")] = None
    """Focal length of the depth camera, as `modeler calibrate-camera` estimated it."""
    colour: Annotated[bool, default("compare, if model and frames have colour")] = True
    """Do not compare colours."""
    seed: Annotated[int, SEED] = 0
    """Same seed, same machine, same result, to the bit."""
    watching: WatchOptions = field(default_factory=WatchOptions)
    prior: PriorOptions = field(default_factory=PriorOptions)
    selection: FrameOptions = field(default_factory=FrameOptions)
    where: ObjectOptions = field(default_factory=ObjectOptions)
    given: InputOptions = field(default_factory=InputOptions)

    def run(self) -> int:
        """Track the object; status 3 if a frame is left in doubt: poses.json has the reasons."""
        from modeler.export import locked
        from modeler.runs.known_objects import TrackFolder, known_object
        from modeler.runs.outputs import check_folder, run_inputs

        files = [path for path in (self.model, self.sequence, self.sensor, self.camera) if path is not None]
        check_folder(self.out, run_inputs(files))
        folder = TrackFolder(self.out, str(self.model), str(self.sequence))
        folder.check(overwrite=self.overwrite)
        thing = known_object(self.model, self.unit)
        whole, frames = self._opened(thing)
        tracker = self._tracker(thing, whole)
        compile_kernels(say)
        with locked(self.out):
            found = self._tracked(tracker, frames, folder)
        return _summarise(found, self.out)

    def _opened(self, thing: KnownObject) -> tuple[AbstractSequence, AbstractSequence]:
        """Return the sequence, and the selected frames; those that are plainly not what they seem are refused."""
        from modeler.cli.reading import opened, selected
        from modeler.runs.reopening import calibrated

        whole = opened(self.sequence, self.given, self.watching)
        whole = calibrated(whole, self.sensor, self.camera)
        whole = whole if self.camera is not None else thing.seen_by(whole)
        return whole, selected(whole, self.selection, self.given)[0]

    def _tracker(self, thing: KnownObject, sequence: AbstractSequence) -> Tracker:
        """Return the tracker with the parts asked for."""
        from modeler.composition import compose
        from modeler.segmentation import Scene
        from modeler.tracking import Tracker

        asked = self.prior.prior is not None or bool(self.prior.parameters())
        known = PriorOptions(prior="general") if not asked else self.prior
        parts = compose.modeler(sequence, known, MethodOptions(colour=self.colour), self.where)
        scene = Scene() if sequence.live else compose.scene(parts, sequence)
        model = thing.model if self.colour else replace(thing.model, vertex_colours=None)
        return Tracker(
            model,
            parts.sensor.measured(scene.range_noise),
            prior=parts.prior if asked else None,
            independent=self.independent,
            depth_scale_sigma=0.0 if thing.focal is None else thing.focal.depth_scale_sigma,
            segmenter=parts.segmenter,
            scene=scene,
            known_symmetries=thing.symmetries,
            seed=self.seed,
        )

    def _tracked(self, tracker: Tracker, frames: AbstractSequence, folder: TrackFolder) -> list[Tracked]:
        """Track the object through frames, write and show it."""
        from modeler.cli.reading import reading, while_it_lasts
        from modeler.runs.known_objects import PAGE
        from modeler.viz import blueprint, entities, model_view
        from modeler.viz.report.track import write_track_page
        from modeler.viz.stream import open_stream

        facts = {"model": folder.model, "sequence": folder.sequence, "seed": self.seed}
        recording = folder.path / "recording.rrd"
        stream = open_stream(frames.name, save=recording, spawn=self.watching.view, web=self.watching.web, facts=facts)
        found: list[Tracked] = []
        try:
            stream.lay_out(blueprint.tracking_layout(None))
            stream.draw_at(None, [(entities.TRACKED_MESH, model_view.mesh(tracker.model))])
            with Interrupt() as interrupt, reading() as watched:
                shown = watched(frames, "tracking").until(lambda: interrupt.asked)
                for frame in interrupt.until(while_it_lasts(shown) if frames.live else shown):
                    found.append(tracker.update(frame))
                    if found[-1].pose is not None and sum(one.pose is not None for one in found) == 1:
                        stream.lay_out(blueprint.tracking_layout(found[-1].view))
                    stream.draw_at(frame.index, model_view.draw_tracked(frame, found[-1], tracker.renderer))
                    folder.write(found)
                    found[-1] = replace(found[-1], view=None)  # which a long track would not hold
        finally:
            stream.close()
        folder.write(found, last=True)
        write_track_page(folder.path, folder.path / PAGE, tracker.renderer.centre_m)
        return found


def _summarise(found: Sequence[Tracked], out: Path) -> int:
    """Write a summary to stderr, and return the exit status."""
    usable = sum(one.usable for one in found)
    absent = sum(one.outcome == "not there" for one in found)
    doubtful = [one for one in found if not one.usable and one.outcome != "not there"]
    seconds = median([one.seconds for one in found] or [0.0])
    frames = "1 frame" if len(found) == 1 else f"{len(found)} frames"
    say(f"placed in {usable} of {frames}, not there in {absent}; {seconds:.2f} s a frame: {out}")
    for one in doubtful[:3]:
        say(f"frame {one.frame} is {one.outcome}, in doubt: {one.reason}")
    if len(doubtful) > 3:
        say(f"for {len(doubtful) - 3} more, see {out / 'poses.json'}")
    return 3 if doubtful or not found else 0
