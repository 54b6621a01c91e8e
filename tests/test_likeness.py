"""Views that match may show different sides that are alike: print tells them apart, and one flat face shows nothing."""

from dataclasses import replace

import numpy as np
import pytest
from tabletop import Box, seen
from test_colour_fit import printed
from test_verdict import CAMERA, poses_of, turned

from modeler import se3
from modeler.priors import GeneralPrior, TablePrior
from modeler.types import AbstractPrior, Array, Frame, Plane, RayImage
from modeler.verdict.likeness import flat_check, likenesses, print_check

SIDES_DEG = (0.0, 20.0, 40.0, 60.0, 190.0, 210.0, 230.0, 250.0)
ALIKE_DEG = [angle_deg % 180.0 for angle_deg in SIDES_DEG]
"""The same shape: an ellipsoid is the same after half a turn."""
TABLE = Plane(np.array([0.0, -1.0, 0.0]), 0.2, 0.002, 0.001)


def box(index: int, camera_from_object: Array, plane: Plane | None = None) -> RayImage:
    """A box whose top and bottom are beyond the image, each pixel a ray that meets it or does not."""
    w, h = CAMERA.rays()
    rays = np.stack([w, h, np.ones_like(w)], axis=-1).reshape(-1, 3)
    turn, middle_m = camera_from_object[:3, :3], camera_from_object[:3, 3]
    depth_m, outwards = Box((0.1, 0.2, 0.1)).cast(-middle_m @ turn, rays @ turn)
    mask, shape = np.isfinite(depth_m), (CAMERA.height, CAMERA.width)
    depth = np.where(mask, depth_m, 1.5).reshape(shape).astype(np.float32)
    frame = Frame(index, float(index), depth, CAMERA, mask.reshape(shape))
    return replace(seen(frame, outwards[mask] @ turn.T, 0.001), plane=plane)


@pytest.mark.parametrize(("found_deg", "holds"), [(SIDES_DEG, True), (ALIKE_DEG, False)])
def test_print_of_another_side_that_is_alike_contradicts_the_match(found_deg: list[float], holds: bool) -> None:
    found = print_check(likenesses(printed(angles_deg=SIDES_DEG), poses_of([*found_deg]), 0.005))
    assert found is not None
    pair, check = found
    assert check.holds is holds
    if not holds:
        assert pair.first < 4 <= pair.second
        assert abs(pair.correlation) < 0.2


@pytest.mark.parametrize(("right", "holds"), [(0, False), (1, True)])
def test_of_pairs_across_segments_that_agrees_best_decides(right: int, holds: bool) -> None:
    """Seen from 90° apart; all but so many show another side."""
    pairs = likenesses(printed(angles_deg=SIDES_DEG), poses_of([*SIDES_DEG]), 0.005)
    within = [pair for pair in pairs if (pair.first < 4) is (pair.second < 4)]
    usual = max(pair.correlation for pair in within)
    kind = replace(within[0], motion=turned(90.0), across=True)
    across = [replace(kind, first=k, second=4 + k, correlation=usual if k < right else 0.1 * usual) for k in range(3)]
    for some, expected in ((across, holds), (across[1:2], True)):  # a single one may be seen too obliquely
        found = print_check([*within, *some])
        assert found[1].holds is expected


def test_a_side_without_print_contradicts_nothing() -> None:
    views, plain = printed(angles_deg=SIDES_DEG), printed(0.0, noise=2.0, angles_deg=SIDES_DEG)
    mixed = {k: plain[k] if k in (4, 5) else views[k] for k in (*range(6),)}
    found = print_check(likenesses(mixed, poses_of(ALIKE_DEG), 0.005))
    assert found[1].holds
    assert print_check(likenesses(plain, poses_of(ALIKE_DEG), 0.005)) is None


@pytest.mark.parametrize(
    ("prior", "plane", "loose"),
    [
        (None, None, 2.0),
        (GeneralPrior(limits_assumed=True), TABLE, 2.0),
        (GeneralPrior(), TABLE, 0.0),
        (TablePrior(max_rotation_deg=72.0, max_shift_m=0.5), TABLE, 2.0),
        (TablePrior(max_rotation_deg=40.0, max_shift_m=0.5), TABLE, 0.0),
        (None, replace(TABLE, normal=np.array([0.0, 0.0, -1.0])), 0.0),
    ],
)
def test_part_of_a_flat_face_holds_frames_only_if_the_motion_excludes_other_sides(
    prior: AbstractPrior | None, plane: Plane | None, loose: float
) -> None:
    """Frames turned by 10° against the camera show a part of one side; the others show two sides."""
    beside = [se3.translation(np.array([shift_m, 0.0, 0.0])) for shift_m in (0.0, 0.0, 0.15, -0.15)]
    poses = [shift @ turned(angle_deg) for shift, angle_deg in zip(beside, (55.0, 35.0, 10.0, -10.0), strict=True)]
    views = {k: box(k, pose, plane) for k, pose in enumerate(poses)}
    pairs = likenesses(views, {k: se3.inverse(pose) for k, pose in enumerate(poses)}, 0.01)
    found = flat_check(pairs, views, {k: k for k in views}, prior)
    assert found[1].value == loose


def test_two_sides_or_print_hold_frames() -> None:
    angles_deg = [65.0, 45.0, 25.0]
    views = {k: box(k, turned(angle_deg)) for k, angle_deg in enumerate(angles_deg)}
    pairs = likenesses(views, poses_of(angles_deg), 0.01)
    places = {k: k for k in views}
    assert all(pair.shaped for pair in pairs)
    flat = [replace(pair, shaped=False, normal=np.array([0.0, 0.0, -1.0])) for pair in pairs]
    for correlation, holds in ((0.9, True), (np.nan, False)):
        found = flat_check([replace(pair, correlation=correlation) for pair in flat], views, places, None)
        assert found[1].holds is holds
    assert flat_check([], views, places, None) is None
