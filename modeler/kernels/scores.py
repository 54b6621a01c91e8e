"""Scores of poses: the log-likelihood of both views' surface, and the moments of its colours, in one projection."""

import numpy as np

from modeler.kernels.cache import njit
from modeler.kernels.photometric import NO_COLOURS, fetch_features, sum_moments
from modeler.kernels.point_likelihood import buffers, project, sum_over_points, write_transform
from modeler.kernels.threads import over_rows

# Columns of `scores`. The last four are Σ a b, Σ a², Σ b² and the number of the features a and b of matching points.
LOG_LIKELIHOOD, EXPLAINED, PRODUCT, OWN_SQUARE, OTHER_SQUARE, MATCHES = 0, 1, 2, 3, 4, 5


def scores(poses, forward, backward, forward_parameters, backward_parameters, colours=(NO_COLOURS, NO_COLOURS)):
    """Return the scores of poses, summed over the points of two views (method, eq. 4.1 and 7.3).

    In single precision, the error is below 1e-4 nats per point unless a point falls within 1e-3 px of a pixel's border.

    Args:
        poses: (m, 12) float64 rows of the 3×4 matrices of target_from_source; or (m, 13), see `write_transform`.
        forward: the `Projection` of the source's points in the target.
        backward: the `Projection` of the target's points in the source.
        forward_parameters: the `LikelihoodParameters` of the forward direction.
        backward_parameters: the `LikelihoodParameters` of the backward direction.
        colours: the `Colours` of both directions.

    Returns:
        (m, 6): log-likelihood; number of points explained by the other view; moments of the features of matching
        points, 0 if colours are not compared. Points are weighted by f.
    """
    parameters = forward_parameters, backward_parameters
    return over_rows(_scores, poses, (forward, backward), parameters, colours, least=16)


@njit(cache=True, nogil=True, error_model="numpy")
def _scores(poses, projections, parameters, colours):
    result = np.zeros((poses.shape[0], 6))
    transform = np.empty(12)
    most = max(projections[0].points.shape[1], projections[1].points.shape[1])
    (transformed, pixels, looked_up), seen = buffers(most), np.empty(most, dtype=np.float32)
    for i in range(poses.shape[0]):
        for direction in range(2):  # one copy of the code: compiling is slow
            write_transform(poses[i], direction == 1, transform)
            projection, features, model = projections[direction], colours[direction], parameters[direction]
            project(transform, projection, transformed, pixels, looked_up)
            total, explained = sum_over_points(projection.points, transformed, looked_up, model)
            result[i, LOG_LIKELIHOOD] += total
            result[i, EXPLAINED] += explained
            if features.values.shape[0] > 0:
                fetch_features(features.values.shape[0], pixels, features, transformed, seen)
                moments = sum_moments(
                    projection.points, features.values, transformed, looked_up, seen, model.blur_m * model.blur_m
                )
                for k in range(4):
                    result[i, PRODUCT + k] += moments[k]
    return result
