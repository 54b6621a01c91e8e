"""`modeler calibrate-sensor`: the noise of a depth camera."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from modeler.cli.input_options import InputOptions
from modeler.cli.options import IdleSeed


@dataclass(frozen=True)
class CalibrateSensor:
    """Measure a depth camera's noise, across and along the ray, from a few frames of a scene that stands still.

    Put a box or two at the distances that matter before a farther background, keep everything still, and record ten
    frames. `modeler build SEQUENCE --sensor FILE` uses the result for any sequence of the same camera.
    """

    input: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="INPUT")]
    """At least 3 frames in any format that is read."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """JSON file to write; one that is there is replaced."""
    given: InputOptions = field(default_factory=InputOptions)
    randomness: IdleSeed = field(default_factory=IdleSeed)

    def run(self) -> int:
        """Measure the noise, store it, and print what was measured at which distance and angle."""
        from modeler.cli.calibrating_sensor import calibrate_sensor

        return calibrate_sensor(self)
