"""What a person can say of an input that does not say it itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from modeler.cli.options import default

if TYPE_CHECKING:
    from sequences import Given


@dataclass(frozen=True)
class InputOptions:
    """What counts more than what the input says."""

    intrinsics: Annotated[
        tuple[float, float, float, float] | None, tyro.conf.arg(metavar="FX FY CX CY"), default("as the input says")
    ] = None
    """Intrinsics of the depth camera in px."""
    depth_scale_mm: Annotated[float | None, tyro.conf.arg(metavar="MM"), default("as the input says")] = None
    """Millimetres per unit of stored depth."""
    depth_topic: Annotated[str | None, tyro.conf.arg(metavar="TOPIC"), default("the only one")] = None
    """Topic of the depth images in a ROS bag."""
    colour_topic: Annotated[str | None, tyro.conf.arg(metavar="TOPIC"), default("the one aligned to depth")] = None
    """Topic of the colour images in a ROS bag."""

    def stated(self) -> Given:
        """Return them as readers take them.

        Raises:
            InputError: where one cannot be.
        """
        from sequences import Given

        return Given(self.intrinsics, self.depth_scale_mm, self.depth_topic, self.colour_topic)
