"""`modeler convert`: any input to the native layout, and results to other programs' formats."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from modeler.cli.input_options import InputOptions
from modeler.cli.options import FrameOptions, IdleSeed, default


@dataclass(frozen=True)
class Convert:
    """Write any input as a BOP scene folder, the native layout; or the poses of a run for other programs.

    A run folder as INPUT gives its poses: as scene_gt.json (BOP) where OUT ends in .json, as a TUM trajectory where
    it ends in .txt.
    """

    input: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="INPUT")]
    """A sequence in any format that is read, or a run folder."""
    out: Annotated[Path, tyro.conf.arg(metavar="OUT")]
    """BOP scene folder to make; scene_gt.json or poses.txt for a run."""
    sensor: Annotated[Path | None, tyro.conf.arg(metavar="FILE"), default("as INPUT says")] = None
    """Noise of the depth camera, as `modeler calibrate-sensor` measured it, to write into sequence.json."""
    selection: FrameOptions = field(default_factory=FrameOptions)
    given: InputOptions = field(default_factory=InputOptions)
    randomness: IdleSeed = field(default_factory=IdleSeed)

    def run(self) -> int:
        """Convert the input."""
        from modeler.cli.converting import convert

        return convert(self)
