"""`modeler calibrate-sensor` and `modeler calibrate-camera`: the noise and the focal length of a depth camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from modeler.cli.console import say
from modeler.cli.options import InputOptions, MovedOptions

if TYPE_CHECKING:
    from modeler.sequences.noise_calibration import Calibration
    from modeler.types import FocalLength


@dataclass(frozen=True)
class CalibrateSensor:
    """Measure a depth camera's noise, across and along the ray, from a few frames of a static scene.

    Put a box or two at the relevant distances in front of a farther background, keep everything still, and record ten
    frames. `modeler build SEQUENCE --sensor FILE` uses the result for any sequence of the same camera.
    """

    input: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="INPUT")]
    """At least 3 frames in any supported format."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """JSON file to write."""
    overwrite: bool = False
    """Replace an existing file."""
    given: InputOptions = field(default_factory=InputOptions)

    def run(self) -> int:
        """Measure the noise, store it, and print it by distance and angle."""
        from modeler.cli.reading import reading
        from modeler.export import write_atomically
        from modeler.runs.outputs import check_files
        from modeler.sequences import open_sequence
        from modeler.sequences.calibrated import noise_text, object_distance_m
        from modeler.sequences.noise_calibration import calibrate

        check_files([self.out], [self.input], overwrite=self.overwrite)
        sequence = open_sequence(self.input, self.given.overrides())
        with reading() as watched:
            found = calibrate(watched(sequence.recorded(), "reading"))
        distance_m = object_distance_m(sequence.frame(sequence.indices[0]))
        sigma_wh, sigma_r_m = found.model.at(distance_m)
        sensor = {"sigma_wh": sigma_wh, "sigma_r_m": sigma_r_m, "distance_m": distance_m}
        write_atomically(self.out, noise_text(found.model, _facts(sequence.name, found, sensor)))
        print("\n".join(_table(found)))
        say(
            f"at {distance_m:.2f} m {1e3 * sigma_wh * distance_m:.2f} mm across and {1e3 * sigma_r_m:.2f} mm "
            f"along the ray, from {found.frames} frames: {self.out}"
        )
        return 0


def _facts(name: str, found: Calibration, sensor: dict[str, float]) -> dict[str, object]:
    return {
        "schema": 1,
        "sequence": name,
        "frames": found.frames,
        "sensor": sensor,
        "along": [
            {
                "distance_m": one.distance_m,
                "angle_deg": math.degrees(one.angle_rad),
                "sigma_m": math.sqrt(one.variance_m2),
                "pixels": one.pixels,
            }
            for one in found.bins
        ],
        "across": [
            {"distance_m": one.depth_m, "sigma_px": math.sqrt(one.variance_px2), "length_px": one.length}
            for one in found.borders
        ],
    }


def _table(found: Calibration) -> list[str]:
    """Return the measured noise and that of the fitted model, one line per distance and angle."""
    lines = [f"across the ray  {found.model.lateral_px:.2f} px, from {len(found.borders)} borders", "along the ray"]
    lines.append("  distance   angle    pixels   measured      model")
    for one in found.bins:
        model_m = float(found.model.sigma_r_m(one.distance_m, one.angle_rad))
        lines.append(
            f"  {one.distance_m:6.2f} m  {math.degrees(one.angle_rad):5.0f}°  {one.pixels:8d}  "
            f"{1e3 * math.sqrt(one.variance_m2):6.2f} mm  {1e3 * model_m:6.2f} mm"
        )
    return lines


_OPEN = 0.005  # of sizes: less is not reported


@dataclass(frozen=True)
class CalibrateCamera:
    """Estimate a depth camera's focal length from a run in which the object came back to its first view.

    A wrong focal length makes all rotations too small or too large, so that a full turn does not close. Depth with too
    flat a relief, as from smoothing and hole filling, has the same effect: loops cannot separate the two, and the size
    of the model depends on which it is. Steps and spans of a partial turn determine the focal length, too, but less.
    `modeler build SEQUENCE --camera FILE` uses the result for any sequence of the same camera.
    """

    run_folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Run folder of `modeler build`, of a full turn. Its loop may have been rejected as contradicting the chain; its
    consecutive pairs must be right."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """JSON file to write."""
    overwrite: bool = False
    """Replace an existing file."""
    known: Literal["neither", "focal-length", "depth"] = "neither"
    """What is accurate in the sequence: focal-length (a calibrated camera; the depth is wrong) or depth (unfiltered;
    the focal length is nominal). neither: half of the error is attributed to each, and a model that may be wrong by
    more than 5 mm for this reason is not trusted."""
    moved: MovedOptions = field(default_factory=MovedOptions)

    def run(self) -> int:
        """Estimate the focal length and store it; status 3 if no loop determines it."""
        from modeler.export import write_atomically
        from modeler.graph.focal import FocalCalibrator
        from modeler.runs.outputs import check_files, run_inputs
        from modeler.runs.reopening import reopened
        from modeler.sequences import FocalFactor
        from modeler.types import InputError

        check_files([self.out], run_inputs([self.run_folder], self.moved.sequence), overwrite=self.overwrite)
        run = reopened(self.run_folder, self.moved.sequence)
        part, *others = run.parts
        if others:
            raise InputError(f"{self.run_folder}: joins several runs; calibrate with one of them")
        modeler = part.modeler()
        found = FocalCalibrator().estimate(run.views, run.edges, run.sensor, modeler.register, modeler.prior)
        used_px = run.views[min(run.views)].frame.camera.fx
        factor = found.factor * (run.report.get("camera") or {}).get("focal_factor", 1.0)
        share = {"neither": 0.5, "focal-length": 1.0, "depth": 0.0}[self.known]
        open_by = abs(math.log(factor)) if self.known == "neither" else 0.0
        given_px = used_px * found.factor / factor
        result = FocalFactor(factor, given_px, factor**share, 0.5 * open_by, found.sigma, found.determined_by)
        open_sds = {"sigmas_before": found.sigmas_before, "sigmas_after": found.sigmas_after} if found.loops else {}
        facts = {"sigmas_before": None, "sigmas_after": None, **open_sds, "loops": found.loops}
        write_atomically(self.out, result.text({**facts, "fx_px": found.factor * used_px, "run": str(self.run_folder)}))
        say(f"{_said(found, used_px, given_px)}: {self.out}")
        if found.determined_by == "loop" and result.depth_scale_sigma >= _OPEN:
            say(
                f"or the relief of the depth is wrong by {100.0 * open_by:.0f} %; sizes are known only to "
                f"{100.0 * result.depth_scale_sigma:.0f} %: give --known to say which of the two is accurate"
            )
        return 0 if found.determined_by == "loop" else 3


def _said(found: FocalLength, used_px: float, given_px: float) -> str:
    from modeler.verdict.advice import focal_length_found, graph_cycles

    if found.determined_by == "prior" and found.loops:
        return (
            f"{graph_cycles(found.loops)} do not determine the focal length: closure error of "
            f"{found.sigmas_before:.1f} sd as given, "
            f"{found.sigmas_after:.1f} sd with the best one; if this is large, an edge is wrong: see the worst pairs "
            "in the run's report"
        )
    if found.determined_by == "prior":
        return (
            "no loop determines the focal length; turn the object fully, with overlapping steps, and use a motion "
            "prior (--prior table)"
        )
    focal_px = used_px * found.factor
    before = "as given" if f"{used_px:.1f}" == f"{given_px:.1f}" else f"with the run's {used_px:.1f} px"
    sds = found.sigmas_after, found.sigmas_before
    return focal_length_found((focal_px, focal_px * found.sigma), given_px, found.loops, sds, before)
