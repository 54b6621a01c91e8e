"""Calibration of covariances for cameras other than the renderer's: `python -m studies calibration.by_camera`.

Depth cameras of several kinds (`calibration.depth_cameras`) observe shapes of the study, each once with its true focal
length and once with a nominal one, which has errors of 2 % standard deviation. Pairs are registered with both priors
and with ICP, and evaluated camera by camera. Shapes are split as in the study itself.

Tables go to stdout, progress to stderr, trials as CSV into a folder. `--conformal-from` takes those of the other half:
they give a factor on the covariances of each outcome (split conformal prediction), whose effect on coverage is shown.
"""

from __future__ import annotations

import argparse
import csv
import io
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Final, TypeVar, final

import numpy as np
from scipy.special import chdtri

from modeler import se3
from modeler.baselines import IcpRegistrar
from modeler.evaluation import about_point, nees, rotation_error_deg, true_motion
from modeler.export import write_atomically
from modeler.priors import GeneralPrior, TablePrior
from modeler.registration import VisibilityRegistrar
from modeler.segmentation import Segmenter, scene_frames
from modeler.sequences.rendering import RenderedSequence, surroundings
from modeler.types import AbstractPrior, AbstractRegistrar, Array, Camera, Frame, Posterior, RayImage, SensorNoise
from modeler.views import Sensor
from studies.calibration.depth_cameras import CAMERAS, DepthCamera, World, placed
from studies.calibration.specimens import SPECIMENS, Half, Specimen, load_specimen
from studies.calibration.study import CONTROL, OURS, Condition, staged

Key = TypeVar("Key")
NOMINAL: Final = 0.02
"""Standard deviation of a nominal focal length's logarithm."""
STEPS_DEG: Final = (12.0, 25.0, 40.0)
_RENDERER: Final = "our renderer"
_CLASSES: Final = ("asymmetric", "near-symmetric", "n-fold", "revolution")
_HEAD: Final = f"{'pairs':>5}{'NEES/6':>8}{'± se':>7}{'median':>8}{'50 %':>6}{'95 %':>6}"


@final
@dataclass(frozen=True)
class Trial:
    """One pair of one camera with one prior by one method."""

    camera: str
    stated: str
    """Whether the focal length is `true` or `nominal`."""
    symmetry: str
    shape: str
    distance_m: float
    step_deg: float
    prior: str
    method: str
    outcome: str = "outside the prior"
    usable: bool = False
    """Only such answers are judged."""
    error_deg: float = float("nan")
    sigma_deg: float = float("nan")
    """Root mean square rotation error that the covariance predicts."""
    matched: float = float("nan")
    """Surface points of a view that the other view has as well."""
    log_volume: float = float("nan")
    """½ log det of the covariance about the object's centroid (rad, m)."""
    nees: float = float("nan")
    nees_rotation: float = float("nan")
    nees_translation: float = float("nan")


@final
@dataclass(frozen=True)
class CameraStudy:
    """Which shapes are shown to which cameras."""

    specimens: tuple[Specimen, ...]
    cameras: tuple[str, ...] = (_RENDERER, *CAMERAS)
    frames: int = 3
    """Of each shape: one more than pairs."""
    seed: int = 0

    def trials(self, number: int) -> Iterator[Trial]:
        """Yield what every method makes of the pairs of one shape with every camera."""
        specimen = self.specimens[number]
        recipe = load_specimen(specimen.recipe)
        for name in self.cameras:
            camera, place = CAMERAS.get(name), (_RENDERER, *CAMERAS).index(name)
            seed = int(np.random.SeedSequence([self.seed, recipe.seed, place]).generate_state(1)[0])
            rng = np.random.default_rng(seed)
            distances = (0.6, 0.8, 1.1) if camera is None else camera.distances_m
            condition = Condition(
                distance_m=distances[(number + place) % len(distances)],
                step_deg=STEPS_DEG[(number // len(distances) + place) % len(STEPS_DEG)],
            )
            sequence = RenderedSequence(staged(recipe, condition, frames=self.frames, seed=seed))
            frames = shown(sequence, camera, rng, seed)
            truth, error = sequence.truth(), float(np.exp(rng.normal(0.0, NOMINAL)))
            blank = Trial(name, "true", specimen.symmetry, specimen.recipe, condition.distance_m, condition.step_deg,
                          "", "")  # fmt: skip
            for stated, factor in (("true", 1.0), ("nominal", error)):
                views = viewed([replace(frame, camera=refocused(frame.camera, factor)) for frame in frames], camera)
                for target, source in pairwise(views):
                    motion = true_motion(truth, target.index, source.index)
                    yield from _pair(replace(blank, stated=stated), source, target, motion, seed)


def shown(sequence: RenderedSequence, camera: DepthCamera | None, rng: np.random.Generator, seed: int) -> list[Frame]:
    """Return the frames of a sequence as a camera sees it, None for the renderer's own, masked by the truth."""
    if camera is None:
        return [sequence.frame(index) for index in sequence.indices]
    found = []
    for index in sequence.truth():
        world = world_of(sequence, index)
        depth_m = camera.measure(world, rng, seed).astype(np.float32)
        found.append(Frame(index, float(index), depth_m, camera.camera, camera.look(world).on_object))
    return found


def world_of(sequence: RenderedSequence, index: int) -> World:
    """Return what is before the camera at a frame."""
    recipe = sequence.recipe
    thing, around = recipe.object.mesh(), surroundings(recipe)
    beside = placed(around.vertices_m, around.triangles, recipe.view.camera_from_table())
    return World(placed(thing.vertices_m, thing.triangles, sequence.truth()[index]), beside)


def viewed(frames: Sequence[Frame], camera: DepthCamera | None) -> list[RayImage]:
    """Return the views of a sequence; of the camera, None for the renderer's own, at most its kind is given."""
    segmenter = Segmenter()
    scene = segmenter.scene([frames[k] for k in scene_frames(range(len(frames)))])
    sensor = Sensor(SensorNoise(sigma_r_m=None) if camera is None else camera.stated).measured(scene.range_noise)
    return [sensor.ray_image(frame, segmenter.segment(frame, scene).plane) for frame in frames]


def refocused(camera: Camera, factor: float) -> Camera:
    """Return intrinsics with focal lengths multiplied by a factor."""
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


METHODS: Final[dict[str, AbstractRegistrar]] = {OURS: VisibilityRegistrar(), CONTROL: IcpRegistrar()}
PRIORS: Final[dict[str, AbstractPrior]] = {"general": GeneralPrior(), "table": TablePrior()}


def _pair(blank: Trial, source: RayImage, target: RayImage, truth: Array, seed: int) -> Iterator[Trial]:
    sigma_focal = NOMINAL if blank.stated == "nominal" else 0.0
    source, target = (replace(view, sigma_focal=sigma_focal) for view in (source, target))
    for prior_name, prior in PRIORS.items():
        density = prior.between(source, target)
        possible = bool(np.isfinite(density.log_density(truth[None])[0]))
        for method_name, method in METHODS.items():
            trial = replace(blank, prior=prior_name, method=method_name)
            if possible:
                rng = np.random.default_rng([seed, source.index, target.index])
                trial = judged(trial, method.register(source, target, density, rng=rng), truth, source, target)
            yield trial


def judged(trial: Trial, posterior: Posterior, truth: Array, source: RayImage, target: RayImage) -> Trial:
    """Return a trial with its errors; the uncertainty of a nominal focal length is given."""
    there = truth @ se3.translation(source.centroid_m)
    pose = posterior.pose.widened(NOMINAL if trial.stated == "nominal" else 0.0)
    estimate = about_point(pose, source.centroid_m)
    squares = [nees(estimate, there, part) for part in (slice(0, 6), slice(0, 3), slice(3, 6))]
    return replace(
        trial,
        outcome=posterior.outcome.label,
        usable=posterior.usable,
        error_deg=rotation_error_deg(posterior.pose.mean, truth),
        sigma_deg=float(np.degrees(np.sqrt(np.trace(estimate.covariance[:3, :3])))),
        matched=0.5 * posterior.overlap * (len(source.points_m) + len(target.points_m)),
        log_volume=0.5 * float(np.linalg.slogdet(estimate.covariance)[1]),
        nees=squares[0],
        nees_rotation=squares[1],
        nees_translation=squares[2],
    )


def summary(trials: Sequence[Trial]) -> str:
    """Return NEES/6, its standard error and median, and the coverage of some answers in words of a table."""
    usable = [one for one in trials if one.usable]
    if not usable:
        return f"{0:>5}{'-':>8}{'-':>7}{'-':>8}{'-':>6}{'-':>6}"
    squares = np.array([one.nees for one in usable])
    error = standard_error(squares, [one.shape for one in usable])
    inside = [100.0 * np.mean(squares <= chdtri(6, 1.0 - level)) for level in (0.5, 0.95)]
    return (
        f"{len(squares):>5}{squares.mean() / 6:8.2f}{error / 6:7.2f}{np.median(squares) / 6:8.2f}"
        f"{inside[0]:6.0f}{inside[1]:6.0f}"
    )


def standard_error(values: Array, shapes: Sequence[str]) -> float:
    """Return the standard error of a mean whose values may be correlated within shapes, but not between them.

    Args:
        values: (n,).
        shapes: (n,) names.
    """
    _, numbers = np.unique(shapes, return_inverse=True)
    sums = np.bincount(numbers, values - values.mean())
    if len(sums) < 2:
        return float("nan")
    return float(np.sqrt(len(sums) / (len(sums) - 1) * np.sum(sums**2)) / len(values))


def equal_volume(trials: Sequence[Trial]) -> float:
    """Return the mean log volume of regions after one factor on all covariances makes 95 % of them hold the truth."""
    good = [one for one in trials if one.usable]
    if not good:
        return float("nan")
    needed = np.quantile([one.nees for one in good], 0.95) / chdtri(6, 0.05)
    return float(np.mean([one.log_volume for one in good]) + 3.0 * np.log(needed))


def conformal_factors(trials: Sequence[Trial]) -> dict[str, float]:
    """Return the split-conformal factor on covariances for each outcome (Papadopoulos, Proedrou, Vovk, Gammerman 2002).

    With it, the 95 % region of one more pair like these holds the truth with a probability of at least 95 %; infinite
    with fewer than 19 pairs.
    """
    ours = [one for one in trials if one.usable and one.method == OURS]
    factors = {}
    for outcome, members in _by(ours, lambda one: one.outcome).items():
        squares = sorted(one.nees for one in members)
        rank = math.ceil(0.95 * (len(squares) + 1))
        factors[outcome] = squares[rank - 1] / float(chdtri(6, 0.05)) if rank <= len(squares) else math.inf
    return factors


def conformal_text(trials: Sequence[Trial], factors: Mapping[str, float]) -> str:
    """Return a table of the coverage of 95 % regions as they are, and with covariances multiplied by factors."""
    lines = ["split-conformal factors on covariances: " + ", ".join(f"{k} {v:.2f}" for k, v in factors.items())]
    lines += [f"{'coverage, %':<29}{'pairs':>6}{'as is':>8}{'with':>8}"]
    ours = [one for one in trials if one.usable and one.method == OURS]
    for (camera, stated), members in _by(ours, lambda one: (one.camera, one.stated)).items():
        limits = float(chdtri(6, 0.05)) * np.array([[1.0, factors.get(one.outcome, math.inf)] for one in members])
        covered = 100.0 * np.mean(np.array([one.nees for one in members])[:, None] <= limits, axis=0)
        lines.append(f"{camera:<20}{stated:<9}{len(members):6}{covered[0]:8.0f}{covered[1]:8.0f}")
    return "\n".join(lines)


def text(trials: Sequence[Trial]) -> str:
    """Return the tables that a person reads."""
    ours = [one for one in trials if one.method == OURS]
    lines = []
    for stated in dict.fromkeys(one.stated for one in trials):
        lines += [f"focal length {stated}", f"{'':32}{'general':^40}{'table':^40}", f"{'':32}{_HEAD}{_HEAD}"]
        for camera in dict.fromkeys(one.camera for one in trials):
            some = [one for one in ours if (one.camera, one.stated) == (camera, stated)]
            lines.append(f"{camera:<32}" + "".join(summary([o for o in some if o.prior == p]) for p in PRIORS))
        lines.append("")
    lines += ["both priors, camera by camera", f"{'':56}{_HEAD}"]
    for camera, stated in dict.fromkeys((one.camera, one.stated) for one in ours):
        some = [one for one in ours if (one.camera, one.stated) == (camera, stated)]
        for title, parts in _parts(some).items():
            for name, members in parts.items():
                lines.append(f"{camera:<20}{stated:<9}{title:<11}{name:<16}{summary(members)}")
    lines += [
        "",
        "log volume at 95 % coverage: nats, and the factor on a standard deviation that ICP's needs beside it",
    ]
    for camera, stated in dict.fromkeys((one.camera, one.stated) for one in trials):
        some = [one for one in trials if (one.camera, one.stated) == (camera, stated)]
        own, other = (equal_volume([one for one in some if one.method == method]) for method in (OURS, CONTROL))
        lines.append(f"{camera:<20}{stated:<9}{own:8.1f}{other:8.1f}{np.exp((other - own) / 6.0):8.2f}")
    return "\n".join(lines)


def _parts(trials: Sequence[Trial]) -> dict[str, dict[str, list[Trial]]]:
    usable = [one for one in trials if one.usable]
    return {
        "class": {name: [one for one in trials if one.symmetry == name] for name in _CLASSES},
        "outcome": _by([one for one in trials if one.method == OURS], lambda one: one.outcome),
        "stated sd": _quartiles(usable, lambda one: one.sigma_deg, "°"),
        "matched": _quartiles(usable, lambda one: one.matched, ""),
    }


def _by(trials: Sequence[Trial], key: Callable[[Trial], Key]) -> dict[Key, list[Trial]]:
    return {name: [one for one in trials if key(one) == name] for name in dict.fromkeys(key(one) for one in trials)}


def _quartiles(trials: Sequence[Trial], key: Callable[[Trial], float], unit: str) -> dict[str, list[Trial]]:
    if len(trials) < 4:
        return {}
    ordered = sorted(trials, key=key)
    parts = [[ordered[k] for k in part] for part in np.array_split(np.arange(len(ordered)), 4)]
    return {f"{key(part[0]):.3g} to {key(part[-1]):.3g}{unit}": part for part in parts}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m studies calibration.by_camera", description=__doc__)
    parser.add_argument("--half", choices=("tuning", "held-out"), default="tuning", help="which shapes")
    parser.add_argument("--per-class", type=int, default=12, metavar="N", help="shapes of each class of symmetry")
    parser.add_argument("--frames", type=int, default=CameraStudy.frames, metavar="N", help="one more than pairs")
    parser.add_argument("--cameras", nargs="+", choices=CameraStudy.cameras, default=CameraStudy.cameras)
    parser.add_argument("--seed", type=int, default=0, help="of poses, noise and registration")
    parser.add_argument("--out", type=Path, default=Path("runs/calibration"), help="folder of the results")
    parser.add_argument("--conformal-from", type=Path, metavar="CSV", help="trials that give conformal factors")
    options = parser.parse_args(arguments)
    others = read(options.conformal_from) if options.conformal_from else []
    if options.per_class < 1 or options.frames < 2 or options.seed < 0:
        parser.error("no pair is left; check --per-class (1 or more), --frames (2 or more) and --seed (not negative)")
    study = CameraStudy(chosen(options.half, options.per_class), tuple(options.cameras), options.frames, options.seed)
    trials: list[Trial] = []
    began = time.perf_counter()
    for number, specimen in enumerate(study.specimens):
        trials += study.trials(number)
        done = f"{number + 1} of {len(study.specimens)} shapes"
        print(f"{done}: {specimen.recipe}, {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
    print(text(trials))
    if others:
        print("", conformal_text(trials, conformal_factors(others)), sep="\n")
    options.out.mkdir(parents=True, exist_ok=True)
    write_atomically(options.out / f"by_camera-{options.half}.csv", table(trials))
    return 0


def chosen(half: Half, per_class: int) -> tuple[Specimen, ...]:
    """Return the given number of shapes of each class, always the same."""
    rng = np.random.default_rng(0)
    found = []
    for name in _CLASSES:
        members = [one for one in SPECIMENS if (one.half, one.symmetry) == (half, name)]
        found += [members[k] for k in rng.permutation(len(members))[:per_class]]
    return tuple(found[k] for k in rng.permutation(len(found)))


def table(trials: Sequence[Trial]) -> str:
    """Return trials as CSV, for `read`."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, [one.name for one in fields(Trial)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(one) for one in trials)
    return stream.getvalue()


def read(path: Path) -> list[Trial]:
    """Return the trials that the study wrote, with what conformal factors need."""
    with path.open(newline="") as stream:
        return [
            Trial(
                row["camera"],
                row["stated"],
                row["symmetry"],
                row["shape"],
                float(row["distance_m"]),
                float(row["step_deg"]),
                row["prior"],
                row["method"],
                row["outcome"],
                usable=row["usable"] == "True",
                nees=float(row["nees"]),
            )
            for row in csv.DictReader(stream)
        ]


if __name__ == "__main__":
    sys.exit(main())
