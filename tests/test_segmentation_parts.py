"""What segmentation is made of: mixed pixels, pieces, clusters and edges."""

import numpy as np

from modeler.segmentation.depth_images import edge_of, mixed_pixels, pieces, voxel_clusters, without_specks


def test_mixed_pixels_against_a_naive_twin(rng):
    depth = rng.choice([0.5, 0.6, 0.7, np.nan], (20, 30)).astype(np.float32)
    tolerance = np.full_like(depth, 0.05)
    fast = mixed_pixels(depth, tolerance_m=tolerance, pixel_m=np.full_like(depth, 0.001))
    for row in range(20):
        for column in range(30):
            around = depth[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2]
            here = depth[row, column]
            assert fast[row, column] == (np.any(here - around > 0.05) and np.any(around - here > 0.05))


def test_pieces_end_at_jumps_and_clusters_at_gaps():
    depth = np.full((4, 9), 0.5, dtype=np.float32)
    depth[:, 5:] = 0.6
    labels = pieces(depth, np.ones(depth.shape, dtype=np.bool_))
    assert set(np.unique(labels[:, :4])) == {labels[0, 0]}
    assert labels[0, 0] != labels[0, 8]
    line = np.full((75, 3), 0.01)
    line[:, 0] = np.r_[np.linspace(0.0, 0.1, 50), np.linspace(0.15, 0.2, 25)]
    near, far = (
        voxel_clusters(line, low_m=np.zeros(3), high_m=np.full(3, 0.21), gap_m=gap_m) for gap_m in (0.06, 0.01)
    )
    assert len(np.unique(near)) == 1
    assert len(np.unique(far)) == 2


def test_specks_go():
    mask = np.zeros((30, 40), dtype=np.bool_)
    mask[10:20, 10:20], mask[25, 30], mask[3:5, 3:5] = True, True, True
    assert without_specks(mask, 0.05).sum() == 100


def test_the_edge_of_what_is_seen():
    seen = np.zeros((60, 80), dtype=np.bool_)
    seen[20:, 16:] = True  # a band that the sensor leaves blind, and a table before nothing
    edge = edge_of(seen)
    assert edge[20:, 16].all()
    assert edge[20, 16:].all()
    assert edge[-1, 16:].all()
    assert not edge[21:-1, 17:-1].any()
    seen[10:20, 40:50] = True  # something on the table that rises over its end: there the camera sees on
    edge = edge_of(seen)
    assert edge[20:, 16].all()
    assert not edge[:-1, 17:-1].any()


def test_the_side_of_what_rises_over_the_end_of_a_table_is_no_edge():
    seen = np.zeros((60, 80), dtype=np.bool_)
    seen[38:58, 8:72] = True  # a table that covers a third of each column
    seen[24:38, 30:50] = True  # with what stands there it is more than half
    assert not edge_of(seen)[:57, 9:71].any()
