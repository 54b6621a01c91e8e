"""Shading of a matt surface by lamps fixed to the camera: harmonics of its normal in the camera's frame."""

import numpy as np

from modeler.kernels.cache import njit

HARMONICS = 8  # up to the second degree, without the constant


@njit(cache=True)
def harmonics(pose, x, y, z):
    """Return the spherical harmonics of degrees 1 and 2 (8,), unscaled, of a direction rotated to a camera's frame.

    They describe nearly all shading of a matt surface by distant lamps (Basri and Jacobs 2003, "Lambertian reflectance
    and linear subspaces").
    """
    a = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z
    b = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z
    c = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z
    return a, b, c, a * b, b * c, a * c, a * a - b * b, 3.0 * c * c - 1.0


@njit(cache=True)
def harmonics_of(normals, pose):
    """Return the harmonics (n, 8) of normals (n, 3), see `harmonics`."""
    result = np.empty((len(normals), HARMONICS))
    for n in range(len(normals)):
        turned = harmonics(pose, normals[n, 0], normals[n, 1], normals[n, 2])
        for h in range(HARMONICS):
            result[n, h] = turned[h]
    return result


@njit(cache=True)
def shading_of(normals, coefficients):
    """Return the shading (n,) of normals (n, 3), given coefficients (9,) of a constant and the harmonics."""
    result = np.empty(len(normals))
    camera = np.eye(4)
    for n in range(len(normals)):
        turned = harmonics(camera, normals[n, 0], normals[n, 1], normals[n, 2])
        result[n] = coefficients[0]
        for h in range(HARMONICS):
            result[n] += coefficients[1 + h] * turned[h]
    return result
