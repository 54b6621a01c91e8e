"""What surrounds the object, and what is painted on it."""

import numpy as np

from modeler.types import Array
from sequences.rendering.mesh import Mesh
from sequences.rendering.recipe import Mosaic, Recipe
from sequences.rendering.shapes import Box, placement

_WALL_THICKNESS_M = 0.05


def surroundings(recipe: Recipe) -> Mesh:
    """Return table and wall in the table frame."""
    meshes = [Mesh.single(np.zeros((0, 3)), np.zeros((0, 3), np.int64))]
    if recipe.table is not None:
        table = recipe.table
        slab = Box((*table.size_m, table.thickness_m)).mesh().painted(table.rgb)
        meshes.append(slab.moved(placement((0.0, 0.0, -table.thickness_m / 2.0), (0.0, 0.0, 0.0))))
    if recipe.wall is not None:
        wall = recipe.wall
        slab = Box((wall.size_m[0], _WALL_THICKNESS_M, wall.size_m[1])).mesh().painted(wall.rgb)
        meshes.append(slab.moved(placement((0.0, wall.distance_m + _WALL_THICKNESS_M / 2.0, 0.0), (0.0, 0.0, 0.0))))
    return Mesh.joined(meshes)


def mosaic_shade(points_m: Array, mosaic: Mosaic) -> Array:
    """Return how bright (n,) a mosaic is at points (n, 3) of the model frame."""
    # The shift keeps faces of usual sizes off the borders of cells, where rounding would decide.
    cell = np.floor(points_m / mosaic.cell_m + np.array([0.37, 0.41, 0.43])).astype(np.int64).astype(np.uint64)
    code = cell[:, 0] * np.uint64(73856093) ^ cell[:, 1] * np.uint64(19349663) ^ cell[:, 2] * np.uint64(83492791)
    code = (code ^ (code >> np.uint64(13))) * np.uint64(0x9E3779B97F4A7C15)
    return 1.0 - mosaic.contrast * (code >> np.uint64(40)).astype(np.float64) / 2.0**24
