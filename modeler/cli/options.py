"""Options that several commands share, grouped as help shows them."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Annotated, Literal

import tyro


def _default(text: str) -> object:
    return tyro.conf.arg(help_behavior_hint=f"(default: {text})")


@dataclass(frozen=True)
class FrameOptions:
    """Which frames."""

    every: Annotated[int, tyro.conf.arg(metavar="N")] = 1
    """Use the first frame and every N-th after it."""
    frames: Annotated[str, tyro.conf.arg(metavar="A:B"), _default("all")] = ":"
    """Use frame numbers from A up to, but not including, B; either may be left out."""


@dataclass(frozen=True)
class ObjectOptions:
    """Where the object is, in sequences without masks."""

    roi: Annotated[tuple[int, int, int, int] | None, tyro.conf.arg(metavar="X0 Y0 X1 Y1"), _default("whole image")] = (
        None
    )
    """Look for the object within these pixels: columns X0 to X1, rows Y0 to Y1, ends not included."""
    max_depth_m: Annotated[float | None, tyro.conf.arg(metavar="M"), _default("no limit")] = None
    """Take nothing farther away than this for the object."""


@dataclass(frozen=True)
class PriorOptions:
    """What is known of the motion between two frames."""

    prior: Literal["general", "table"] = "general"
    """general: any motion within limits of rotation and shift. table: the object stays on the table it stands on."""
    max_rotation_deg: Annotated[float | None, tyro.conf.arg(metavar="DEG"), _default("50")] = None
    """Largest rotation between two frames (general, table)."""
    max_offset_m: Annotated[float | None, tyro.conf.arg(metavar="M"), _default("0.04")] = None
    """Largest distance between the centroids of what two frames see (general)."""
    max_shift_m: Annotated[float | None, tyro.conf.arg(metavar="M"), _default("0.05")] = None
    """Largest shift of the object on the table (table)."""

    def given(self, *accepted: str) -> dict[str, float]:
        """Return the parameters that were given, by field name.

        Args:
            accepted: names of the parameters that the prior has.

        Raises:
            InputError: where a parameter of another prior was given, or a value that is none.
        """
        from modeler.types import InputError

        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "prior"}
        given = {name: value for name, value in values.items() if value is not None}
        for name in given.keys() - set(accepted):
            raise InputError(
                f"{_flag(name)} is no parameter of --prior {self.prior}; leave it out or change the prior."
            )
        for name, value in given.items():
            if not 0.0 < value < math.inf or (name == "max_rotation_deg" and value > 180.0):
                limit = "at most 180" if name == "max_rotation_deg" else "finite"
                raise InputError(f"{_flag(name)} {value:g} is out of range; give a positive number, {limit}.")
        return given


Method = Literal["visibility", "paper", "icp", "gicp", "fpfh", "fpfh-icp"]


@dataclass(frozen=True)
class MethodOptions:
    """How two frames are registered."""

    method: Method = "visibility"
    """visibility: ours. paper: Wüthrich et al. 2012. The others are baselines."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Same seed, same machine, same result, to the bit."""


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"
