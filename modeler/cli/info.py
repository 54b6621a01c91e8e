"""`modeler info`: what an input holds."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from modeler.cli.input_options import InputOptions
from modeler.cli.options import IdleSeed


@dataclass(frozen=True)
class Info:
    """Say what was found at a path: format, frames, resolution, depth, intrinsics, masks, colour, what is missing.

    Every frame is read once, so that what is said is true of the whole input.
    """

    input: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="INPUT")]
    """A sequence in any format that `modeler build` takes; the format is told from the path."""
    json: bool = False
    """Print a JSON object instead of lines."""
    given: InputOptions = field(default_factory=InputOptions)
    randomness: IdleSeed = field(default_factory=IdleSeed)

    def run(self) -> int:
        """Print what was found; status 2 where the input cannot be used."""
        from modeler.cli.informing import inform

        return inform(self)
