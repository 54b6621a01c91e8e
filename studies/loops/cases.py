"""The sequences: an object that comes back to where it was in many ways."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from modeler import sequences
from modeler.sequences import AbstractSequence
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.recipe import Place, Places
from modeler.types import Array, Frame
from studies.calibration.specimens import load_specimen

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
BUNDLED = Path(sequences.__file__).parent / "bundled"


@dataclass(frozen=True)
class Case:
    """One sequence and its motion prior."""

    name: str
    """What it is called."""
    sequence: AbstractSequence
    """Its frames."""
    prior: str = "table"
    """The prior to use."""
    gone: frozenset[int] = frozenset()
    """Frames from which the object is missing."""
    closes: bool = True
    """Whether a loop leads over all frames, so that closing it should mend what adds up along them."""

    def frames(self) -> Iterator[Frame]:
        """Yield the frames, without the object where it is gone."""
        for index in self.sequence.indices:
            frame = self.sequence.frame(index)
            if index in self.gone and frame.mask is not None:
                frame = replace(frame, mask=np.zeros_like(frame.mask))
            yield frame

    def truth(self) -> dict[int, Array] | None:
        """Return the true camera_from_model (4, 4) by frame number, where it is known."""
        return self.sequence.truth()


def turned(angles_deg: Sequence[float], *, shape: str, width: int = 640, seed: int = 0) -> AbstractSequence:
    """Return a rendered sequence of a shape that stands on the table a little off its axis, at these turns.

    Each turn is off by a little, as a hand's is; the last is exact.
    """
    recipe = load_specimen(shape)
    rng = np.random.default_rng(seed)
    wobble_deg = rng.normal(0.0, 0.5, len(angles_deg))
    wobble_deg[[0, -1]] = 0.0
    places = []
    for angle_deg in np.asarray(angles_deg) + wobble_deg:
        angle_rad = np.radians(angle_deg)
        offset_m = (0.02 * float(np.cos(angle_rad)), 0.02 * float(np.sin(angle_rad)), 0.0)
        places.append(Place(offset_m, (0.0, 0.0, float(angle_deg))))
    scale = width / recipe.view.width
    view = replace(
        recipe.view, width=width, height=round(scale * recipe.view.height), focal_px=scale * recipe.view.focal_px
    )
    return RenderedSequence(
        replace(recipe, trajectory=Places(tuple(places)), view=view, colour="none", pattern=None, seed=seed)
    )


def rendered(shape: str, seed: int) -> list[Case]:
    """Return the rendered cases, in the order of the table.

    One registration bridges the gap of the first turn that has one, 45° wide. Nothing bridges that of the second, 92°
    wide: the frames after it are lost until the object comes back to the first views, and then join backwards in time,
    so that what hangs together are two arms from the first view, and no loop.
    """
    there = np.arange(0.0, 136.0, 15.0)

    def case(
        name: str, angles_deg: Sequence[float] | Array, gone: frozenset[int] = frozenset(), *, closes: bool = True
    ) -> Case:
        return Case(name, turned(list(angles_deg), shape=shape, seed=seed), gone=gone, closes=closes)

    return [
        case("full-turn", np.linspace(0.0, 360.0, 16)),
        case("turn-and-a-half", np.linspace(0.0, 540.0, 23)),
        case("two-turns", np.linspace(0.0, 720.0, 31)),
        case("back-and-forth", [*there, *there[-2::-1]]),
        case("turn-with-gap", np.linspace(0.0, 390.0, 27), frozenset({11, 12})),
        case("turn-lost-and-found", np.linspace(0.0, 390.0, 18), frozenset({7, 8, 9}), closes=False),
        case("200-at-2deg", np.linspace(0.0, 398.0, 200)),
    ]


def bundled() -> list[Case]:
    """Return the sequences that come with the project."""
    return [Case(name, sequences.open_sequence(BUNDLED / name)) for name in ("box", "flashlight", "tube")]


def real() -> list[Case]:
    """Return the available real captures."""
    priors = {"cap": "table", "kleenex": "table", "castard": "general", "dragon": "general", "dog_upright": "general"}
    return [
        Case(name, sequences.open_sequence(SHARED / name), prior)
        for name, prior in priors.items()
        if (SHARED / name).is_dir()
    ]
