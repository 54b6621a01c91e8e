"""The study of calibration: its design, what it makes of posteriors known to be true or false, and that it runs."""

import csv
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import binary_erosion
from scipy.spatial import KDTree
from slow_cases import sampled

from modeler import se3
from modeler.baselines import IcpRegistrar
from modeler.evaluation import rotation_error_deg, sample_surface, true_motion
from modeler.priors import TablePrior
from modeler.registration import VisibilityRegistrar
from modeler.registration.visibility import VisibilityLikelihood
from modeler.registration.visibility.sampling import AdaptiveSampler
from modeler.sequences.rendering import RenderedSequence
from modeler.types import AbstractRegistrar, Outcome, PoseGaussian, Posterior, RayImage, ViewPair
from modeler.viz.figures import coverage_curves
from studies.calibration.__main__ import panels, run
from studies.calibration.specimens import PRINTED, SPECIMENS, Specimen, load_specimen, recipe_names
from studies.calibration.study import CONTROL, MEASURES, OURS, OUTSIDE, Condition, Study, Trial, judged, staged
from studies.calibration.tables import rows, text

BLANK = Trial("tuning", "n-fold", "box", "usual", "table", OURS, 1, 0, outcome=OUTSIDE)
CENTROID_M = np.array([0.05, -0.02, 0.8])


def _posterior(pose: PoseGaussian, outcome: Outcome = Outcome.CONVERGED) -> Posterior:
    return Posterior(source=1, target=0, pose=pose, outcome=outcome, overlap=1.0)


def _drawn(count: int, claim: float) -> list[Trial]:
    """Trials whose covariances claim standard deviations that are `claim` times the true ones."""
    rng = np.random.default_rng(0)
    trials = []
    for _ in range(count):
        factor = 0.02 * (0.4 * rng.normal(size=(6, 6)) + np.eye(6))
        mean = se3.exp(rng.normal(size=6))
        truth = mean @ se3.exp(factor @ rng.normal(size=6))
        pose = PoseGaussian(mean, claim**2 * factor @ factor.T)
        trials.append(judged(BLANK, _posterior(pose), truth, CENTROID_M))
    return trials


def test_the_design_is_as_wide_as_promised() -> None:
    study = Study()
    assert {specimen.recipe for specimen in SPECIMENS} <= set(recipe_names())
    assert len({specimen.recipe for specimen in SPECIMENS}) == len(SPECIMENS)
    for half, pairs in (("tuning", 280), ("held-out", 330)):
        members = tuple(specimen for specimen in SPECIMENS if specimen.half == half)
        assert replace(study, specimens=members).pairs >= pairs
        assert len(members) >= 10
        for symmetry in ("asymmetric", "near-symmetric", "n-fold", "revolution"):
            alike = tuple(specimen for specimen in members if specimen.symmetry == symmetry)
            assert replace(study, specimens=alike).pairs >= 60
    for values in zip(*((c.distance_m, c.noise, c.step_deg) for c in study.conditions), strict=True):
        assert len(set(values)) >= 3


def test_every_printed_shape_has_all_finishes_in_one_half() -> None:
    halves: dict[str, set[str]] = {}
    for half in ("tuning", "held-out"):
        members = [specimen for specimen in PRINTED if specimen.half == half]
        assert replace(Study(), specimens=tuple(members)).pairs >= 250
        finishes: dict[str, list[str]] = {}
        for specimen in members:
            shape, finish = specimen.recipe.split("+")
            finishes.setdefault(shape, []).append(finish)
            assert specimen.symmetry in (f"n-fold, {finish}", f"revolution, {finish}")
        assert all(sorted(found) == ["faint", "labelled", "plain"] for found in finishes.values())
        halves[half] = set(finishes)
    assert not halves["tuning"] & halves["held-out"]
    for bare in SPECIMENS:
        assert bare.recipe not in halves["held-out" if bare.half == "tuning" else "tuning"]


def test_finishes_of_a_shape_differ_in_print_alone() -> None:
    """Depth, motion and lamps are the same; print spreads the colours, and without any there are none."""
    recipes = []
    for finish in ("plain", "faint", "labelled"):
        recipe = staged(load_specimen(f"can+{finish}"), Condition(), frames=2, seed=3)
        assert recipe.photography is not None
        view = replace(recipe.view, width=160, height=120, focal_px=143.75)
        recipes.append(replace(recipe, view=view, photography=replace(recipe.photography, noise_levels=0.0)))
    plain, faint, labelled = (RenderedSequence(recipe).frame(1) for recipe in recipes)
    colours = []
    for frame in (plain, faint, labelled):
        np.testing.assert_array_equal(frame.depth_m, plain.depth_m)
        assert frame.mask is not None
        inside = np.asarray(binary_erosion(frame.mask, iterations=2), bool)
        chroma = np.log(np.maximum(frame.colour[inside], 1.0))
        colours.append(float((chroma - chroma.mean(axis=1, keepdims=True)).std(axis=0).max()))
    assert colours[0] < 0.5 * colours[1] < 0.25 * colours[2]


@dataclass(frozen=True)
class Looking(AbstractRegistrar):
    """Keeps the source views that it is given."""

    seen: list[RayImage]

    def posterior_of(self, pair: ViewPair) -> Posterior:
        self.seen.append(pair.source)
        return _posterior(PoseGaussian(np.eye(4), np.eye(6)))


@pytest.mark.slow
def test_a_blind_study_leaves_out_colour_alone() -> None:
    seen: list[RayImage] = []
    study = Study(conditions=(Condition(),), priors={"table": TablePrior()}, methods={OURS: Looking(seen)})
    specimen = next(specimen for specimen in PRINTED if specimen.recipe == "can+labelled")
    for blind in (False, True):
        assert len(list(replace(study, blind=blind).trials(specimen))) == 1
    sighted, blind_view = seen
    assert sighted.frame.colour is not None
    assert blind_view.frame.colour is None
    np.testing.assert_array_equal(sighted.points_m, blind_view.points_m)


@pytest.mark.parametrize("specimen", sampled(SPECIMENS, every=12), ids=lambda specimen: specimen.recipe)
def test_shapes_have_the_symmetry_of_their_class(specimen: Specimen) -> None:
    mesh, rng = load_specimen(specimen.recipe).object.mesh(), np.random.default_rng(0)
    surface_m = sample_surface(mesh.vertices_m, mesh.triangles, 62_000, rng)
    # Shapes with an axis have it along z through their origin; what else there is may have one through its middle.
    surface_m -= surface_m.mean(axis=0) if specimen.symmetry == "asymmetric" else 0.0
    few_m, nearest = surface_m[:2000], KDTree(surface_m[2000:])

    def moved(axis: int, angle_deg: float) -> float:
        turn = se3.exp(np.radians(angle_deg) * np.eye(6)[axis])
        gaps_m, _ = nearest.query(se3.transform(turn, few_m), distance_upper_bound=0.003)
        return float(np.mean(np.isinf(gaps_m)))

    shares = {angle_deg: moved(2, angle_deg) for angle_deg in range(30, 181, 30)}
    onto_itself = {angle_deg for angle_deg, share in shares.items() if share == 0.0}
    match specimen.symmetry:
        case "revolution":
            assert onto_itself == set(shares)
        case "n-fold":
            assert onto_itself in ({180}, {120}, {90, 180}, {60, 120, 180})
            assert min(share for angle_deg, share in shares.items() if angle_deg not in onto_itself) > 0.15
        case "near-symmetric":
            assert min(shares.values()) > 0.01
            assert max(shares.values()) < 0.25
        case "asymmetric":
            assert min(*shares.values(), *(moved(axis, 180.0) for axis in (0, 1))) > 0.25


@pytest.mark.parametrize("name", sampled([specimen.recipe for specimen in SPECIMENS], every=12, fast=6))
def test_staging_changes_what_the_condition_says(name: str) -> None:
    recipe = load_specimen(name)
    usual, other = (
        RenderedSequence(staged(recipe, condition, frames=4, seed=7))
        for condition in (Condition(), Condition(distance_m=1.1, noise=2.0, step_deg=40.0))
    )
    turns_deg = [
        rotation_error_deg(np.eye(4), true_motion(other.truth(), frame, frame + 1)) for frame in other.indices[:-1]
    ]
    assert np.mean(turns_deg) == pytest.approx(40.0, abs=10.0)
    nearer_m, farther_m = (float(np.mean([pose[2, 3] for pose in s.truth().values()])) for s in (usual, other))
    assert farther_m - nearer_m == pytest.approx(0.3, abs=0.05)
    # Noise along the ray grows with the square of the distance.
    farther, nearer = (sequence.sensor().along_ray_m(1.0) for sequence in (other, usual))
    assert farther / nearer == pytest.approx(2.0 * (1.1 / 0.8) ** 2, rel=0.02)
    assert not np.allclose(usual.truth()[0], RenderedSequence(staged(recipe, Condition(), frames=4, seed=8)).truth()[0])


@pytest.mark.parametrize("name", ["box", "tube", "jar"])
def test_the_table_of_the_study_is_as_plane_as_the_prior_takes_it(name: str) -> None:
    recipe, prior = staged(load_specimen(name), Condition(), frames=2001, seed=7), TablePrior()
    table_from_object = se3.inverse(recipe.view.camera_from_table()) @ [*RenderedSequence(recipe).truth().values()]
    motions = table_from_object[1:] @ se3.inverse(table_from_object[:-1])
    np.testing.assert_allclose(np.degrees(motions[:, :2, 2].std(axis=0)), prior.sigma_tilt_deg, rtol=0.06)
    assert np.diff(table_from_object[:, 2, 3]).std() == pytest.approx(prior.sigma_height_m, rel=0.06)


@pytest.mark.parametrize("axis", range(6))
def test_an_error_along_one_axis_counts_there(axis: int) -> None:
    sigmas = np.array([0.01, 0.02, 0.03, 0.001, 0.002, 0.003])
    xi = np.zeros(6)
    xi[axis] = 2.0 * sigmas[axis]
    mean = se3.exp(np.random.default_rng(1).normal(size=6))
    to_centroid = se3.translation(CENTROID_M)
    truth = mean @ to_centroid @ se3.exp(xi) @ se3.inverse(to_centroid)
    to_camera = se3.adjoint(to_centroid)
    pose = PoseGaussian(mean, to_camera @ np.diag(sigmas**2) @ to_camera.T)
    trial = judged(BLANK, _posterior(pose), truth, CENTROID_M)
    parts = {"pose", "rotation" if axis < 3 else "translation", list(MEASURES)[3 + axis]}
    for name, square in trial.nees.items():
        assert square == pytest.approx(4.0 if name in parts else 0.0, abs=1e-6)


def test_true_covariances_are_found_true_and_false_ones_false() -> None:
    count = 1000
    for measure in rows(_drawn(count, claim=1.0), "all")[0].measures.values():
        assert measure.mean_nees == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / count))
        for level, share in measure.coverage.items():
            assert share == pytest.approx(level, abs=4.0 * np.sqrt(level * (1.0 - level) / count))
    too_sure = rows(_drawn(200, claim=0.1), "all")[0].measures["pose"]
    assert too_sure.mean_nees > 80.0
    assert too_sure.coverage[0.95] < 0.05
    too_modest = rows(_drawn(200, claim=10.0), "all")[0].measures["pose"]
    assert too_modest.mean_nees < 0.012
    assert too_modest.coverage[0.5] == 1.0


def test_only_answers_that_are_given_are_judged() -> None:
    lost = judged(BLANK, _posterior(PoseGaussian(np.eye(4), np.eye(6)), Outcome.NO_OVERLAP), np.eye(4), CENTROID_M)
    (row,) = rows([BLANK, BLANK, lost, *_drawn(20, claim=1.0)], "all")
    assert (row.pairs, row.outside, row.refused, row.judged) == (23, 2, 1, 20)
    assert row.measures == rows(_drawn(20, claim=1.0), "all")[0].measures
    (empty,) = rows([BLANK], "all")
    assert np.isnan(empty.measures["pose"].mean_nees)
    assert OURS in text([BLANK])
    assert coverage_curves(panels([BLANK])).startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_study_runs_and_repeats_itself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    quick = AdaptiveSampler(samples=250)
    box = Specimen("box", "n-fold", "tuning")
    small = Study(
        specimens=(box,),
        conditions=(Condition(),),
        frames=3,
        priors={"table": TablePrior()},
        methods={OURS: VisibilityRegistrar(VisibilityLikelihood(points=100), sampler=quick), CONTROL: IcpRegistrar()},
    )
    trials = run(small, tmp_path)
    assert [(trial.source, trial.method) for trial in trials] == [(1, OURS), (1, CONTROL), (2, OURS), (2, CONTROL)]
    ours, control = rows(trials, "all")
    assert (ours.judged, control.judged) == (2, 2)
    assert control.measures["pose"].mean_nees > 5.0 * ours.measures["pose"].mean_nees
    assert "TUNING HALF" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["calibration.csv", "calibration.json", "coverage.png"]
    assert json.loads((tmp_path / "calibration.json").read_text())["rows"][0]["judged"] == 2
    with (tmp_path / "calibration.csv").open() as file:
        written = list(csv.DictReader(file))
    assert [float(line["nees_pose"]) for line in written] == [trial.nees["pose"] for trial in trials]
    assert list(replace(small, frames=2).trials(box)) == trials[:2]
