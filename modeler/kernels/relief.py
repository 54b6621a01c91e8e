"""Relief of a mesh: its normals diffused, but not across edges, and its vertices fitted to them."""

import math

import numpy as np

from modeler.kernels.cache import njit


@njit(cache=True, nogil=True)
def facets(vertices, triangles):
    """Return the unit normals (t, 3), 0 without area, and the areas (t,) of triangles (t, 3) of vertices (v, 3)."""
    normals, areas = np.zeros((len(triangles), 3)), np.zeros(len(triangles))
    for f in range(len(triangles)):
        a, b, c = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            normals[f, k] = (vertices[b, i] - vertices[a, i]) * (vertices[c, j] - vertices[a, j]) - (
                vertices[b, j] - vertices[a, j]
            ) * (vertices[c, i] - vertices[a, i])
        length = math.sqrt(normals[f, 0] ** 2 + normals[f, 1] ** 2 + normals[f, 2] ** 2)
        areas[f] = 0.5 * length
        if length > 0.0:
            normals[f] /= length
    return normals, areas


@njit(cache=True, nogil=True)
def diffused(normals, guide, areas, neighbours, edge, passes):
    """Return unit normals (t, 3) after robust anisotropic diffusion (Black et al. 1998; eq. 12.13).

    In each pass, a normal becomes the mean of itself and its neighbours' by area and Tukey's biweight of the difference
    between the two in smoother normals, without which rounded surface becomes faceted (Catté et al. 1992).

    Args:
        normals: (t, 3) unit.
        guide: (t, 3) unit, in which edges are found.
        areas: (t,).
        neighbours: (t, 3) triangles across the edges, -1 = none.
        edge: length of a difference in the guide across which nothing diffuses.
        passes: number of passes.
    """
    weights = np.zeros(neighbours.shape)
    for f in range(len(normals)):
        for k in range(3):
            g = neighbours[f, k]
            if g < 0:
                continue
            share = (
                (guide[f, 0] - guide[g, 0]) ** 2 + (guide[f, 1] - guide[g, 1]) ** 2 + (guide[f, 2] - guide[g, 2]) ** 2
            ) / (edge * edge)
            if share < 1.0:
                weights[f, k] = areas[g] * (1.0 - share) ** 2
    normals, after = normals.copy(), np.empty_like(normals)
    for _ in range(passes):
        for f in range(len(normals)):
            x, y, z = areas[f] * normals[f, 0], areas[f] * normals[f, 1], areas[f] * normals[f, 2]
            for k in range(3):
                weight, g = weights[f, k], neighbours[f, k]
                if weight > 0.0:
                    x, y, z = x + weight * normals[g, 0], y + weight * normals[g, 1], z + weight * normals[g, 2]
            length = math.sqrt(x * x + y * y + z * z)
            if length > 0.0:
                after[f, 0], after[f, 1], after[f, 2] = x / length, y / length, z / length
            else:
                after[f] = normals[f]
        normals, after = after, normals
    return normals


@njit(cache=True, nogil=True)
def fitted(vertices, triangles, normals, limits_m, passes):
    """Return vertices (v, 3) moved so that triangles get the given normals (Sun et al. 2007).

    In each pass, a vertex moves to the mean of its projections on planes through the centres of its triangles.

    Args:
        vertices: (v, 3) in m.
        triangles: (t, 3).
        normals: (t, 3) unit.
        limits_m: (v,) farthest that a vertex may move from where it was.
        passes: number of passes.
    """
    moved, steps, uses = vertices.copy(), np.empty_like(vertices), np.zeros(len(vertices))
    for f in range(len(triangles)):
        for k in range(3):
            uses[triangles[f, k]] += 1.0
    centre = np.empty(3)
    for _ in range(passes):
        steps[:] = 0.0
        for f in range(len(triangles)):
            a, b, c = triangles[f, 0], triangles[f, 1], triangles[f, 2]
            for k in range(3):
                centre[k] = (moved[a, k] + moved[b, k] + moved[c, k]) / 3.0
            for corner in range(3):
                v = triangles[f, corner]
                along = 0.0
                for k in range(3):
                    along += normals[f, k] * (centre[k] - moved[v, k])
                for k in range(3):
                    steps[v, k] += along * normals[f, k]
        for v in range(len(moved)):
            away = 0.0
            for k in range(3):
                moved[v, k] += steps[v, k] / max(uses[v], 1.0)
                away += (moved[v, k] - vertices[v, k]) ** 2
            if away > limits_m[v] ** 2:
                share = limits_m[v] / math.sqrt(away)
                for k in range(3):
                    moved[v, k] = vertices[v, k] + share * (moved[v, k] - vertices[v, k])
    return moved
