"""One build or one chain of registrations with colour as it is, displaced or left out."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal, cast, final

import numpy as np
from PIL import Image

from modeler import se3
from modeler.composition import compose
from modeler.composition.compose import comes_back
from modeler.composition.options import MethodOptions, ObjectOptions, PriorOptions
from modeler.evaluation import align_to_model, nees, rotation_error_deg, true_motion
from modeler.export import RunMeta, report_of
from modeler.priors import GeneralPrior, TablePrior
from modeler.sequences import AbstractSequence, GivenSequence, open_sequence, survey
from modeler.sequences.base import AbstractDerived
from modeler.types import AbstractPrior, Array, Frame, InputError, Step
from studies.colour.scenes import EFFECTS, SIZES_PX, Effect, Picture, Scene
from studies.whole.things import read

Part = Literal["aligned", "displaced", "captures", "pairs"]
PARTS: Final[tuple[Part, ...]] = ("aligned", "displaced", "captures", "pairs")
BODIES: Final = ("ball", "apple", "tin", "box", "bottle", "figure")
TEXTURES: Final = ("printed", "freckled", "grained", "faint", "plain")
PAIRED: Final = (
    ("ball", "photograph"),
    ("apple", "freckled"),
    ("apple", "grained"),
    ("tin", "photograph"),
    ("tin", "faint"),
    ("mug", "printed"),
    ("box", "photograph"),
    ("bottle", "photograph"),
    ("figure", "grained"),
    *((body, "plain") for body in ("ball", "apple", "tin", "mug", "box", "bottle")),
)
PRIORS: Final[Mapping[str, AbstractPrior]] = {"table": TablePrior(), "general": GeneralPrior()}
_SIZE: Final = (160, 160)  # of images of pairs: the rest would be of the table
_FRAMES: Final = 3  # of a body whose pairs are registered
RIGHT_DEG: Final = 3.0
"""Largest error of a right pair, if it is not known to be wider."""
SEEDS: Final[Mapping[str, int]] = {"tuning": 0, "held-out": 1000}


@final
@dataclass(frozen=True)
class Way:
    """What is done to colour."""

    mirrored: bool = False
    scale: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)
    """Of the image's width, right and down."""
    late: bool = False
    """Whether each frame has the colour of the one before."""
    left_out: bool = False
    """Whether views are registered by depth alone."""

    def changed(self, frames: list[Frame]) -> list[Frame]:
        """Return frames with colour as another camera, or another program, has it."""
        colours = [frame.colour for frame in frames]
        if self.late:
            colours = [colours[0], *colours[:-1]]
        return [
            frame if colour is None else replace(frame, colour=self._moved(colour))
            for frame, colour in zip(frames, colours, strict=True)
        ]

    def _moved(self, colour: np.ndarray) -> np.ndarray:
        image = Image.fromarray(np.ascontiguousarray(colour[:, ::-1]) if self.mirrored else colour)
        (width, height), (x, y) = image.size, (part * image.size[0] for part in self.shift)
        across, down = (0.5 * size * (1.0 - 1.0 / self.scale) for size in (width, height))
        numbers = (1.0 / self.scale, 0, across - x / self.scale, 0, 1.0 / self.scale, down - y / self.scale)
        moved = image.transform(image.size, Image.Transform.AFFINE, numbers, Image.Resampling.BILINEAR)
        return np.array(moved)


@final
@dataclass(frozen=True, eq=False)
class Recoloured(AbstractDerived):
    """A sequence whose frames have other colours."""

    recoloured: Mapping[int, Frame]
    """By frame number."""

    def frame(self, index: int) -> Frame:
        """Return the frame with number `index`."""
        return self.recoloured[index]


ALIGNED: Final = "as it is"
WAYS: Final[Mapping[str, Way]] = {
    ALIGNED: Way(),
    "left out": Way(left_out=True),
    "another camera's": Way(scale=1.25, shift=(-0.0375, 0.0)),
    "wider": Way(scale=0.75, shift=(0.03, 0.01)),
    "shifted": Way(shift=(0.04, 0.0)),
    "shifted and down": Way(shift=(-0.03, 0.02)),
    "mirrored": Way(mirrored=True),
    "a frame late": Way(late=True),
}
DISPLACED: Final = tuple(name for name in WAYS if name not in (ALIGNED, "left out"))


@final
@dataclass(frozen=True)
class Case:
    """One build, or one chain of pairs."""

    part: Part
    body: str
    """Of a rendered scene, or the name of a capture."""
    texture: str
    """"" for captures."""
    way: str
    """What is done to colour, or is wrong with light or camera."""
    seed: int

    @property
    def key(self) -> str:
        """Its name in results."""
        return ", ".join(str(value) for value in asdict(self).values())


def cases(half: str, parts: tuple[str, ...], data: Path) -> list[Case]:
    """Return what is measured."""
    found, seed = [], SEEDS[half]
    shown = [(body, texture) for body in BODIES for texture in TEXTURES]
    again = [(body, texture) for body in BODIES[:5] for texture in ("freckled", "plain")]
    found += [Case("aligned", *one, ALIGNED, seed + number) for number, one in enumerate(shown + again)]
    textured = [one for one in shown if one[1] in ("printed", "grained", "freckled")] + [
        ("box", "faint"),
        ("tin", "faint"),
    ]
    found += [
        Case("displaced", *one, DISPLACED[number % len(DISPLACED)], seed + 100 + number)
        for number, one in enumerate(textured)
    ]
    captures = sorted(path.parent.name for path in data.glob("*/rgb")) if data.is_dir() else []
    found += [Case("captures", name, "", way, 0) for name in captures for way in WAYS]
    numbers = itertools.count(seed + 200)
    found += [Case("pairs", *one, effect, next(numbers)) for effect in EFFECTS for one in PAIRED]
    return [case for case in found if case.part in parts]


def measured(case: Case, data: Path, things: Path) -> dict[str, Any]:
    """Return what a case comes to.

    Args:
        case: the case.
        data: folder of captures.
        things: file with photographs, see `studies.whole.things`.
    """
    began = time.perf_counter()
    if case.part == "pairs":
        found: dict[str, Any] = {"pairs": list(_pairs(case, things))}
    else:
        found = _built(case, data)
    return {"key": case.key, **asdict(case), **found, "seconds": round(time.perf_counter() - began, 1)}


def _scene(case: Case) -> Scene:
    return Scene(case.body, case.texture, case.seed, SIZES_PX.get(case.body, 90.0))


def _picture(case: Case, things: Path) -> Picture | None:
    """Return a photograph of the case's half."""
    if case.texture != "photograph":
        return None
    pictures = read(things)[1][case.seed >= SEEDS["held-out"] :: len(SEEDS)]
    return pictures[case.seed % len(pictures)]


def _built(case: Case, data: Path) -> dict[str, Any]:
    way = WAYS[case.way]
    if case.part == "captures":
        whole: AbstractSequence = open_sequence(data / case.body)
        frames, truth = [whole.frame(index) for index in whole.indices], whole.truth()
    else:
        frames, truth = _scene(case).rendered()
        whole = GivenSequence.of(frames, live=False)
    given = Recoloured(whole, {frame.index: frame for frame in way.changed(frames)})
    try:
        doubt = survey(given, truth=False).misaligned
    except InputError as error:
        return {"refused": str(error)}
    modeler = compose.modeler(given, PriorOptions(), MethodOptions(colour=not way.left_out), ObjectOptions())
    scene, closes = compose.scene(modeler, given), comes_back(given, modeler.prior, modeler.closer.max_angle_deg)
    began = time.perf_counter()
    *_, last = modeler.run(given, scene, closure_expected=closes)
    assert isinstance(last, Step)
    report = report_of(last, RunMeta(case.key, 0, "auto"))
    return {
        "before": "" if doubt is None else str(doubt),
        "status": 0 if report["trustworthy"] else 3,
        "codes": list(report["reason_codes"]),
        "reasons": list(report["reasons"]),
        "evidence": {name: [one["value"], one["limit"]] for name, one in report["evidence"].items()},
        "loop_sd": None if report["loop"] is None else report["loop"]["sigmas"],
        "placed": f"{len(last.solution.trajectory)} of {len(frames)}",
        "errors_deg": _errors_deg(last.solution.trajectory, truth),
        "built_s": round(time.perf_counter() - began, 1),
    }


def _errors_deg(trajectory: Mapping[int, Array], truth: Mapping[int, Array] | None) -> list[float] | None:
    """Return the median and the largest rotation error; None without truth."""
    known = {} if truth is None else {frame: pose for frame, pose in truth.items() if frame in trajectory}
    if len(known) < 2:
        return None
    model_from_object = align_to_model(trajectory, known)
    errors = [
        rotation_error_deg(se3.inverse(model_from_object @ trajectory[frame]), pose) for frame, pose in known.items()
    ]
    return [round(float(np.median(errors)), 3), round(float(max(errors)), 3)]


def _pairs(case: Case, things: Path) -> Iterator[dict[str, Any]]:
    """Yield the errors of the pairs of neighbouring frames under two priors."""
    shown = replace(_scene(case), size=_SIZE, frames=_FRAMES)
    frames, truth = replace(shown, effect=cast(Effect, case.way), picture=_picture(case, things)).rendered()
    given = GivenSequence.of(frames, live=False)
    modeler = compose.modeler(given, PriorOptions(), MethodOptions(), ObjectOptions())
    scene = compose.scene(modeler, given)
    views = [modeler.prepare(frame, scene).view for frame in frames]
    for name, prior in PRIORS.items():
        for target, source in itertools.pairwise(views):
            if target is None or source is None:
                continue
            began, motion = time.process_time(), true_motion(truth, target.index, source.index)
            posterior = modeler.register(source, target, prior=prior)
            about = partial(_about, centre_m=source.centroid_m)
            yield {
                "prior": name,
                "usable": posterior.usable,
                "error_deg": round(rotation_error_deg(posterior.pose.mean, motion), 3),
                "sd_deg": round(float(np.degrees(np.sqrt(np.trace(about(posterior.pose.covariance)[:3, :3])))), 3),
                "nees": round(nees(posterior.pose, motion), 3),
                "seconds": round(time.process_time() - began, 2),
            }


def _about(covariance: Array, centre_m: Array) -> Array:
    return se3.covariance_about(covariance, centre_m)
