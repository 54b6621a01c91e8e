"""What `modeler calibrate-sensor` does once it is understood."""

from __future__ import annotations

import math

from modeler.cli.calibrate_sensor import CalibrateSensor
from modeler.cli.reading import reading
from modeler.cli.saying import say
from modeler.export.files import write_atomically
from sequences import open_sequence
from sequences.noise.calibrate import Calibration, calibrate
from sequences.noise.model import noise_text, object_distance_m


def calibrate_sensor(options: CalibrateSensor) -> int:
    """Measure a camera's noise and store it.

    Raises:
        InputError: where the input cannot be used or the file cannot be written.
    """
    sequence = open_sequence(options.input, options.given.stated())
    with reading() as watched:
        found = calibrate(watched(sequence.recorded(), "reading"))
    distance_m = object_distance_m(sequence.frame(sequence.indices[0]))
    write_atomically(options.out, noise_text(found.model, _facts(sequence.name, found, distance_m)))
    print("\n".join(_table(found)))
    sigma_wh, sigma_r_m = found.model.at(distance_m)
    say(
        f"at {distance_m:.2f} m {1e3 * sigma_wh * distance_m:.2f} mm across and {1e3 * sigma_r_m:.2f} mm "
        f"along the ray, from {found.frames} frames: {options.out}"
    )
    return 0


def _facts(name: str, found: Calibration, distance_m: float) -> dict[str, object]:
    """Return what the file says besides the model."""
    sigma_wh, sigma_r_m = found.model.at(distance_m)
    return {
        "schema": 1,
        "sequence": name,
        "frames": found.frames,
        "sensor": {"sigma_wh": sigma_wh, "sigma_r_m": sigma_r_m, "distance_m": distance_m},
        "along": [
            {
                "distance_m": one.distance_m,
                "angle_deg": math.degrees(one.angle_rad),
                "sigma_m": math.sqrt(one.variance_m2),
                "pixels": one.pixels,
            }
            for one in found.classes
        ],
        "across": [
            {"distance_m": one.depth_m, "sigma_px": math.sqrt(one.variance_px2), "length_px": one.length}
            for one in found.borders
        ],
    }


def _table(found: Calibration) -> list[str]:
    """Return what was measured, a line for each distance and angle, beside what the model says."""
    lines = [f"across the ray  {found.model.lateral_px:.2f} px, from {len(found.borders)} borders", "along the ray"]
    lines.append("  distance   angle    pixels   measured      model")
    for one in found.classes:
        model_m = float(found.model.sigma_r_m(one.distance_m, one.angle_rad))
        lines.append(
            f"  {one.distance_m:6.2f} m  {math.degrees(one.angle_rad):5.0f}°  {one.pixels:8d}  "
            f"{1e3 * math.sqrt(one.variance_m2):6.2f} mm  {1e3 * model_m:6.2f} mm"
        )
    return lines
