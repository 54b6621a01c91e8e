"""`modeler calibrate-sensor`: the noise of a depth camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from modeler.cli.console import say
from modeler.cli.options import InputOptions

if TYPE_CHECKING:
    from modeler.sequences.noise_calibration import Calibration


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
        """Measure the noise, store it, and print it by distance and angle.

        Raises:
            InputError: if the input cannot be used or the file cannot be written.
        """
        from modeler.cli.inputs import reading
        from modeler.cli.outputs import check_files
        from modeler.export import write_atomically
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
    """Return the other contents of the file."""
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
