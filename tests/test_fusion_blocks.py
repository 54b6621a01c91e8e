"""Fusion of many views: in blocks on disk, the same surface, in memory that does not grow with their number."""

import os
import sys
import tempfile
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tabletop
from scipy.spatial import KDTree

from modeler.fusion import Fuser, depth_views
from modeler.fusion.fuser import HALVES, downsampled, voxel_means
from modeler.fusion.support import _solved
from modeler.system.disk_arrays import DiskArrays, ViewStore

VOXEL_M = 0.002
BRICK = tabletop.Box((0.07, 0.05, 0.04))
POSES = tabletop.turntable(12)


def in_blocks(monkeypatch: pytest.MonkeyPatch, views: int) -> None:
    """Let blocks hold this many views."""
    monkeypatch.setattr(depth_views, "BLOCK_BYTES", 1)
    monkeypatch.setattr(depth_views, "BLOCK_VIEWS", views)


def test_several_blocks_make_the_same_model_as_one(monkeypatch: pytest.MonkeyPatch) -> None:
    views, trajectory = tabletop.views(BRICK, POSES, np.random.default_rng(0)), tabletop.trajectory(POSES)
    whole = Fuser(voxel_m=VOXEL_M).volume(views, trajectory)
    in_blocks(monkeypatch, 4)
    parts = Fuser(voxel_m=VOXEL_M).volume(views, trajectory)
    assert (len(whole.views.blocks), len(parts.views.blocks)) == (1, 3)
    assert parts.tau_m == pytest.approx(whole.tau_m, rel=0.02)
    for watertight in (False, True):
        one, other = whole.model(watertight=watertight), parts.model(watertight=watertight)
        away_m, nearest = KDTree(one.vertices_m).query(other.vertices_m)
        assert np.quantile(away_m, 0.99) < VOXEL_M
        along_m = np.sum((other.vertices_m - one.vertices_m[nearest]) * one.vertex_normals[nearest], axis=1)
        along_m = along_m[other.vertices_m[:, 2] > -BRICK.half_m[2]]  # no view sees below the foot
        assert np.quantile(np.abs(along_m), 0.95) < whole.sigma_m  # which blocks estimate as well, and relief follows
        assert len(other.points_m) == pytest.approx(len(one.points_m), rel=0.02)


def test_views_of_all_blocks_are_counted_and_averaged(monkeypatch: pytest.MonkeyPatch) -> None:
    views, trajectory = tabletop.views(BRICK, POSES, np.random.default_rng(0)), tabletop.trajectory(POSES)
    whole = Fuser(voxel_m=VOXEL_M).volume(views, trajectory)
    in_blocks(monkeypatch, 3)
    # The limits that follow from the disagreement of views within blocks are those of all views.
    parts = replace(Fuser(voxel_m=VOXEL_M).volume(views, trajectory), near_m=whole.near_m, sigma_m=whole.sigma_m)
    model = whole.model()
    one, other = (volume.support(model.points_m, model.normals) for volume in (whole, parts))
    assert np.mean(one.views == other.views) > 0.999
    assert np.mean(one.empty_views == other.empty_views) > 0.95  # carving ends where their disagreement says
    np.testing.assert_allclose(other.weight, one.weight, rtol=0.05)
    np.testing.assert_allclose(other.sigmas_m, one.sigmas_m, rtol=0.1)
    off = np.abs(one.colours.astype(int) - other.colours).max(axis=1)
    assert np.mean(off <= 4) > 0.99  # highlights are found by the median of the views of a block


def test_blocks_that_cannot_be_written_stay_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(prefix: str) -> None:
        raise OSError(28, "No space left on device")

    views, trajectory = tabletop.views(BRICK, POSES[:8]), tabletop.trajectory(POSES[:8])
    in_blocks(monkeypatch, 4)
    on_disk = Fuser(voxel_m=VOXEL_M).fuse(views, trajectory)
    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    np.testing.assert_array_equal(Fuser(voxel_m=VOXEL_M).fuse(views, trajectory).vertices_m, on_disk.vertices_m)


def test_arrays_on_disk_are_what_was_written() -> None:
    disk, rng = DiskArrays(chunk_bytes=2**16), np.random.default_rng(0)
    made = [rng.normal(size=(size, 3)) for size in (5, 2000, 20_000, 0, 7)]  # the third is larger than a chunk
    made.append(made[2][:, ::2])  # not contiguous
    kept = [disk.written(array) for array in made]
    for array, same in zip(made, kept, strict=True):
        disk.release()
        np.testing.assert_array_equal(array, same)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_place_on_the_disk_is_free_again_once_its_arrays_are_gone() -> None:
    def files() -> int:
        """Return how many files without a name are open."""
        return sum(
            os.readlink(entry).endswith("(deleted)") for entry in Path("/proc/self/fd").iterdir() if entry.exists()
        )

    disk, before = DiskArrays(chunk_bytes=2**16), files()
    kept = [disk.written(np.full(1000, number)) for number in range(100)]
    assert files() - before > 10
    del kept[1:]
    assert files() - before <= 3  # that of the first array, and the newest, which is open as well
    np.testing.assert_array_equal(kept[0], 0)


def test_clouds_are_averaged_together_as_they_are_at_once() -> None:
    rng = np.random.default_rng(0)
    points_m, normals = rng.uniform(0.0, 0.05, (3000, 3)), rng.normal([3.0, 0.0, 0.0], 1.0, (3000, 3))
    weights = rng.uniform(0.1, 1.0, 3000)
    at_once = downsampled(points_m, normals, weights, voxel_m=0.01, max_voxels=10**6)
    clouds = [(points_m[part], normals[part], weights[part]) for part in (slice(0, 900), slice(900, None))]
    boxes_m = np.array([[cloud[0].min(axis=0), cloud[0].max(axis=0)] for cloud in clouds])
    together = voxel_means(clouds, boxes_m, voxel_m=0.01, max_voxels=10**6)
    places = np.floor((points_m - points_m.min(axis=0)) / 0.01)
    assert len(at_once[0]) == len(np.unique(np.column_stack([places, normals @ HALVES > 0.0]), axis=0))
    for one, other in zip(at_once, together, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_both_sides_of_a_sheet_stay_in_the_cloud() -> None:
    rng = np.random.default_rng(0)
    points_m = rng.uniform(0.0, 0.05, (2000, 3)) * [1.0, 1.0, 0.0]
    normals = np.where(np.arange(2000)[:, None] % 2, [0.0, 0.0, 1.0], [0.0, 0.0, -1.0])
    found_m, directions = downsampled(points_m, normals, np.ones(2000), voxel_m=0.01, max_voxels=10**6)
    np.testing.assert_array_equal(np.abs(directions[:, 2]), 1.0)
    for side in (-1.0, 1.0):
        assert np.count_nonzero(directions[:, 2] == side) == len(found_m) / 2 == 25


@pytest.mark.parametrize("shape", [(5, 9), (9, 5)])
def test_gains_solve_their_equations_whichever_side_is_smaller(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    left, right = rng.uniform(size=shape), rng.uniform(size=shape)
    diagonal, values = rng.uniform(20.0, 30.0, shape[0]), rng.normal(size=(shape[0], 2))
    found = _solved(diagonal, left, right, values)
    np.testing.assert_allclose((np.diag(diagonal) - left @ right.T) @ found, values, rtol=1e-9)


def test_memory_does_not_grow_with_the_number_of_views(monkeypatch: pytest.MonkeyPatch) -> None:
    def most_mib(count: int) -> float:
        """Return the peak of the memory that fusing a number of views allocates; pages of mapped files do not count."""
        store = ViewStore(memory_bytes=0, chunk_bytes=2**23)
        views = {k: store.keep(replace(made[k % 12], frame=replace(made[k % 12].frame, index=k))) for k in range(count)}
        tracemalloc.start()
        Fuser(voxel_m=0.006).fuse(views, {k: poses[k % 12] for k in range(count)})
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return most / 2**20

    made, poses = tabletop.views(BRICK, POSES, np.random.default_rng(0)), tabletop.trajectory(POSES)
    monkeypatch.setattr(depth_views, "BLOCK_BYTES", 2**24)
    monkeypatch.setattr(depth_views, "STATISTICS", 10**5)
    most_mib(24)  # what is made once, such as compiled kernels
    few, many = most_mib(48), most_mib(192)
    held_mib = sum(array.nbytes for array in (made[0].points_m, made[0].normals, made[0].frame.depth_m)) / 2**20
    assert (many - few) / (192 - 48) < 0.1 * held_mib
