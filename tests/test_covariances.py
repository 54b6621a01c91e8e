"""Whole runs of shapes that look alike from several sides are as sure of their poses as they may be."""

import numpy as np
import pytest
from loops import covariances


@pytest.mark.slow
def test_poses_of_a_run_are_no_surer_than_they_may_be() -> None:
    """A body with four sides alike, of which two steps match as well a quarter turn on, beyond the prior's limits.

    Errors of one run go together, so that its mean scatters: three times the expected is no lie.
    """
    found = covariances.run("stepper_motor", 42, 6, 25.0, "table")
    assert [len(values) for values in found.values()] == [5, 5, 6]
    assert all(np.mean(values) < 3.0 * 6.0 for values in found.values()), found


def test_a_line_of_the_table_counts_what_lies_within_the_region() -> None:
    row = covariances.row("cup", [{"pose": [6.0, 6.0], "near": [3.0], "far": [60.0]}, {kind: [6.0] for kind in _KINDS}])
    assert row.split() == ["cup", "1.00", "100", "%", "0.75", "100", "%", "5.50", "50", "%"]


_KINDS = ("pose", "near", "far")
