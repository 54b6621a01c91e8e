"""Images wrapped around meshes: in pieces, so that large ones take no longer than many small ones."""

import numpy as np
import numpy.typing as npt
import trimesh

from modeler.export.texture import PIECE, textured
from modeler.types import Array, ObjectModel


def test_a_mesh_of_many_triangles_is_unwrapped_in_pieces_without_overlap() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    nothing = np.zeros((0, 3))
    model = ObjectModel(
        points_m=nothing,
        normals=nothing,
        colours=None,
        vertices_m=np.asarray(ball.vertices),
        triangles=np.asarray(ball.faces, dtype=np.int64),
        vertex_normals=np.asarray(ball.vertices) / 0.05,
        vertex_colours=None,
    )
    assert len(model.triangles) > 3 * PIECE

    def paint(points_m: Array, _: Array) -> npt.NDArray[np.uint8]:
        return np.rint(127.5 + 2400.0 * points_m).clip(0.0, 255.0).astype(np.uint8)

    wrapped, texture = textured(model, paint, 5e-4)
    corners, before = wrapped.vertices_m[wrapped.triangles], model.vertices_m[model.triangles]
    assert sorted(map(tuple, corners.mean(axis=1).round(9))) == sorted(map(tuple, before.mean(axis=1).round(9)))
    # Were two charts on top of each other, the image would show the colours of one of them only.
    middle = texture.uv[wrapped.triangles].mean(axis=1)
    height, width = texture.image.shape[:2]
    rows, columns = ((1.0 - middle[:, 1]) * height).astype(int), (middle[:, 0] * width).astype(int)
    shown = texture.image[rows, columns].astype(int)
    assert np.abs(shown - paint(corners.mean(axis=1), corners[:, 0])).max() <= 6
