"""What `import modeler` offers."""

import doctest
import inspect
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tabletop
from command_runner import spawned

import modeler
from modeler import se3
from modeler.composition.compose import chosen_prior, options_of
from modeler.composition.options import PriorOptions
from modeler.sequences import bundled
from modeler.types import AbstractPrior, Camera, Event, Frame, Step
from studies.loops.known import Known

POSES = tabletop.turntable(15)
SOURCE, TARGET = (tabletop.view(tabletop.Box((0.06, 0.045, 0.08)), POSES[index], index).frame for index in (1, 0))
CAMERA = SOURCE.camera
FRAMES = [tabletop.view(tabletop.Box((0.06, 0.045, 0.08)), POSES[index], index).frame for index in range(4)]
KNOWN = Known(dict(enumerate(POSES[:4])))
NUMBERS = (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)


def test_the_package_is_imported_without_what_it_is_made_of() -> None:
    code = "import sys, modeler; print('numpy' in sys.modules, modeler.TablePrior.__name__, 'numpy' in sys.modules)"
    assert spawned("-c", code).out.split() == ["False", "TablePrior", "True"]


AWAKE = """
import os, time
def ticks(task):
    return sum(map(int, open(f"/proc/self/task/{task}/stat").read().rpartition(")")[2].split()[11:13]))
others = set(os.listdir("/proc/self/task"))
import numpy, scipy.linalg
blas = set(os.listdir("/proc/self/task")) - others
from modeler import GeneralPrior, Sensor
from modeler.registration import VisibilityRegistrar
from modeler.sequences import bundled, open_sequence
sequence = open_sequence(bundled("box"))
frames = [sequence.frame(index) for index in (0, 1)]
def registered(seed):
    target, source = (Sensor(sequence.sensor()).ray_image(frame) for frame in frames)
    density = GeneralPrior().between(source, target)
    return VisibilityRegistrar().register(source, target, density, rng=numpy.random.default_rng(seed)).usable
registered(0)
time.sleep(0.5)  # what imports woke falls asleep again
before = sum(map(ticks, blas))
print(len(blas), all([registered(seed) for seed in range(4)]), sum(map(ticks, blas)) - before)
"""
"""A task's time is counted in ticks of 10 ms; an awakened thread of BLAS spins for longer."""


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="threads are not listed here")
def test_registration_leaves_the_threads_of_blas_asleep() -> None:
    """Once awake, they take cores from the kernels: a pair took a third longer."""
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    threads, usable, ticks = spawned("-c", AWAKE, env=environment).out.split()
    if threads == "0":
        pytest.skip("BLAS has no threads here")
    assert (usable, ticks) == ("True", "0")


def test_every_public_name_is_there_and_documented() -> None:
    assert set(modeler.__all__) <= set(dir(modeler))
    assert all(getattr(modeler, name).__doc__ for name in modeler.__all__)
    with pytest.raises(AttributeError, match="nothing_such"):
        _ = modeler.nothing_such  # pyright: ignore[reportAttributeAccessIssue]


def test_a_model_is_never_built_into_its_sequence() -> None:
    for sequence in (bundled("box"), modeler.open_sequence(bundled("box")).select(every=2)):
        with pytest.raises(modeler.InputError, match="only read"):
            modeler.build(sequence, bundled("box") / "run")


def test_two_depth_images_give_a_pose_and_its_covariance() -> None:
    depths, masks = (SOURCE.depth_m, TARGET.depth_m), (SOURCE.mask, TARGET.mask)
    assert masks[0] is not None
    assert masks[1] is not None
    zeros = np.nan_to_num(depths[0])
    matrix = [[CAMERA.fx, 0.0, CAMERA.cx], [0.0, CAMERA.fy, CAMERA.cy], [0.0, 0.0, 1.0]]
    one = modeler.register(zeros, depths[1], NUMBERS, masks=(masks[0], masks[1]))
    other = modeler.register(depths[0].tolist(), depths[1], matrix, masks=(masks[0], masks[1]))
    truth = POSES[0] @ se3.inverse(POSES[1])
    assert one.outcome is modeler.Outcome.CONVERGED
    assert np.degrees(se3.rotation_angle(se3.inverse(truth) @ one.pose.mean)) < 1.0
    assert np.linalg.eigvalsh(one.pose.covariance)[0] > 0.0
    np.testing.assert_array_equal(one.pose.mean, other.pose.mean)


def test_a_prior_may_be_named() -> None:
    arguments = {"masks": (SOURCE.mask, TARGET.mask)}
    one, other = (
        modeler.register(SOURCE.depth_m, TARGET.depth_m, NUMBERS, prior=prior, **arguments)  # pyright: ignore
        for prior in ("table", chosen_prior(PriorOptions(prior="table"), None))
    )
    np.testing.assert_array_equal(one.pose.mean, other.pose.mean)


def taken(order: list[str]) -> Iterator[Frame]:
    for frame in FRAMES:
        order.append(f"taken {frame.index}")
        yield frame


def stated(order: list[str]) -> Callable[[Event], None]:
    return lambda event: order.append(f"step {event.frame.index}") if isinstance(event, Step) else None


def test_frames_of_a_generator_become_a_run_folder_with_a_verdict(tmp_path: Path) -> None:
    events: list[Event] = []
    result = modeler.build(taken([]), tmp_path / "run", prior="general", registrar=KNOWN, sinks=[events.append])
    last = events[-1]
    assert isinstance(last, Step)
    assert last.last
    assert (result.graph.edges, result.verdict) == (last.edges_so_far, last.verdict)
    assert set(result.solution.trajectory) == {0, 1, 2, 3}
    assert result.report == json.loads((tmp_path / "run" / "report.json").read_text())
    assert {"model.ply", "recording.rrd", "graph.g2o"} <= {path.name for path in (tmp_path / "run").iterdir()}
    single = modeler.build(FRAMES, prior="general", registrar=KNOWN)
    assert single.folder is None
    assert single.report["edges"] == result.report["edges"]
    for frame, pose in result.solution.trajectory.items():
        np.testing.assert_array_equal(single.solution.trajectory[frame], pose)


def test_a_live_loop_is_asked_for_a_frame_once_the_one_before_is_processed() -> None:
    live, read = list[str](), list[str]()
    for order, flag in ((live, True), (read, False)):
        modeler.build(taken(order), prior="general", registrar=KNOWN, sinks=[stated(order)], live=flag)
    assert live == [
        *("taken 0", "taken 1", "taken 2"),  # from which the scene is learned
        *("step 0", "step 1", "step 2", "taken 3", "step 3", "step 3"),
    ]
    assert read[:4] == ["taken 0", "taken 1", "taken 2", "taken 3"]


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        ([], "no frame"),
        ([SOURCE.depth_m], r"ndarray where a frame is wanted; make it with modeler\.Frame\.of"),
        ([SOURCE, TARGET], "frame 0 comes after frame 1"),
    ],
)
def test_what_is_no_sequence_of_frames_is_refused(frames: list[Any], words: str) -> None:
    with pytest.raises(modeler.InputError, match=words):
        modeler.build(frames)


RESULTS = {"InputError", "KnownObject", "ObjectModel", "Outcome", "PoseGaussian", "Posterior", "Result", "SensorNoise",
           "Solution", "Step", "Tracked", "Verdict"}  # fmt: skip


@pytest.mark.parametrize(
    "what",
    [
        *(getattr(modeler, name) for name in modeler.__all__ if name not in RESULTS),
        *(modeler.Modeler.run, modeler.Modeler.register, modeler.Tracker.update, modeler.Frame.of, modeler.Camera.of),
    ],
    ids=lambda what: what.__qualname__,
)
def test_an_argument_of_another_type_is_refused_by_name(what: Callable[..., Any]) -> None:
    for name, parameter in inspect.signature(what).parameters.items():
        if name != "self" and parameter.annotation != "npt.ArrayLike | None":  # of which NumPy takes nearly all
            wrong = object() if "None" in parameter.annotation else None
            with pytest.raises(modeler.InputError, match=f"{what.__qualname__}: `{name}` is .*; give "):
                what(**{name: wrong})


@pytest.mark.parametrize(
    ("what", "wrong"),
    [
        (modeler.TurntablePrior, {"step_deg": 5.0, "step_sign": np.ones(2)}),
        (modeler.known_object, {"path": "x", "unit": np.ones(2)}),
    ],
)
def test_an_array_in_place_of_a_word_is_refused(what: Callable[..., Any], wrong: dict[str, Any]) -> None:
    with pytest.raises(modeler.InputError, match=f"`{[*wrong][-1]}` is of type ndarray"):
        what(**wrong)


@pytest.mark.parametrize("roi", [(), (0, 0, 9), (5, 0, 5, 9), np.zeros((0, 0), int)])
def test_a_region_without_four_edges_or_pixels_is_refused(roi: Any) -> None:
    with pytest.raises(modeler.InputError, match="is empty; give X0 Y0 X1 Y1"):
        modeler.Segmenter(roi=roi)


def test_a_used_folder_is_refused_before_a_frame_is_taken(tmp_path: Path) -> None:
    (tmp_path / "note.txt").touch()
    with pytest.raises(modeler.InputError, match="not empty"):
        modeler.build((pytest.fail("taken") for _ in range(1)), tmp_path)


@pytest.mark.parametrize(
    "prior",
    [
        modeler.TablePrior(),
        modeler.TurntablePrior(-25.0, 3.0, axis_direction=(0.0, 1.0, 0.0)),
        modeler.GeneralPrior(max_rotation_deg=20.0),
    ],
)
def test_a_prior_is_made_again_from_what_a_report_says_of_it(prior: AbstractPrior) -> None:
    assert chosen_prior(options_of(prior), None) == prior


def test_the_tutorial_on_priors_runs() -> None:
    (tutorial,) = doctest.DocTestFinder(recurse=False).find(AbstractPrior, globs={})
    said: list[str] = []
    done = doctest.DocTestRunner().run(tutorial, out=said.append)
    assert (said, done.failed) == ([], 0)
    assert done.attempted > 8


@pytest.mark.parametrize(
    "change",
    [
        {"depth_m": SOURCE.depth_m[:10]},
        {"depth_m": SOURCE.depth_m.astype(np.uint16)},
        {"mask": np.ones((3, 4), dtype=bool)},
        {"mask": np.ones(SOURCE.depth_m.shape)},
        {"colour": np.zeros(SOURCE.depth_m.shape, dtype=np.uint8)},
        {"occluder": np.ones((4, 3), dtype=bool)},
        {"camera": replace(CAMERA, width=2 * CAMERA.width)},
    ],
)
def test_no_frame_has_images_of_another_camera(change: dict[str, Any]) -> None:
    """What a kernel reads lies in the images that it is given."""
    with pytest.raises(modeler.InputError, match="where its camera has"):
        replace(SOURCE, **change)


@pytest.mark.parametrize("change", [{"width": 0}, {"fx": 0.0}, {"fy": -5.0}, {"cx": np.nan}, {"fx": np.inf}])
def test_no_camera_is_without_pixels_or_focal_length(change: dict[str, Any]) -> None:
    with pytest.raises(modeler.InputError):
        replace(CAMERA, **change)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"source_depth_m": np.ones((3, 4))}, "have shapes"),
        ({"intrinsics": (1.0, 2.0)}, "intrinsics"),
        ({"intrinsics": (0.0, 500.0, 10.0, 10.0)}, "intrinsics"),
        ({"masks": (np.ones((3, 4)), np.ones((3, 4)))}, "a mask"),
        ({"source_depth_m": np.zeros_like(SOURCE.depth_m)}, "source image"),
        ({"source_depth_m": np.zeros((0, 0)), "target_depth_m": np.zeros((0, 0))}, "has shape"),
        ({"source_depth_m": [[1.0], [1.0, 2.0]]}, "is no array"),
        ({"source_depth_m": SOURCE.depth_m.astype(complex)}, "complex"),
        ({"intrinsics": Camera(64, 48, *NUMBERS)}, "its camera has"),
        ({"intrinsics": Camera(6400, 4800, *NUMBERS)}, "its camera has"),
        ({"masks": (SOURCE.mask,)}, "1 masks for two"),
        ({"masks": (np.full(SOURCE.depth_m.shape, np.nan), TARGET.mask)}, "NaN"),
        ({"masks": ("mask", "mask")}, "real numbers"),
        ({"colours": (np.zeros((*SOURCE.depth_m.shape, 4), np.uint8),) * 2}, "colours"),
        ({"source_depth_m": 1000.0 * SOURCE.depth_m}, "not in mm"),
        ({"colours": (SOURCE.colour,)}, "1 colours for two"),
        ({"seed": -1}, "negative"),
        ({"prior": "tabel"}, "unknown prior"),
        ({"prior": "held"}, "held"),
    ],
)
def test_what_cannot_be_registered_is_refused(change: dict[str, object], words: str) -> None:
    arguments = {"source_depth_m": SOURCE.depth_m, "target_depth_m": TARGET.depth_m, "intrinsics": NUMBERS} | change
    with pytest.raises(modeler.InputError, match=words):
        modeler.register(**arguments)  # pyright: ignore[reportArgumentType]
