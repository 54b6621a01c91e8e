"""Pictures of meshes: what lies where, from which side."""

import numpy as np

from modeler.viz.report.mesh import look_at, shade

SQUARE = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])  # counter-clockwise from above
UP = np.array([0.0, 1.0, 0.0])


def picture(direction, colours=None):
    return shade(SQUARE, TRIANGLES, colours, look_at(np.zeros(3), np.array(direction), 6.0, UP), (40, 60))


def test_the_camera_looks_at_the_point_and_stands_upright():
    pose = look_at(np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, 2.0]), 5.0, UP)
    np.testing.assert_allclose(pose[:3, 3], [1.0, 2.0, 8.0])
    np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(pose[:3, 2], [0.0, 0.0, -1.0])
    np.testing.assert_allclose(pose[:3, 1], -UP)


def test_a_surface_is_grey_in_front_red_behind_and_white_beside():
    front, back = picture([0.0, 0.0, 1.0]), picture([0.0, 0.0, -1.0])
    assert front.shape == (40, 60, 3)
    assert front.dtype == np.uint8
    assert np.ptp(front[20, 30]) == 0
    assert 60 < front[20, 30, 0] < 200
    red, green, blue = back[20, 30].astype(int)
    assert red > 2 * max(green, blue)
    assert np.all(front[0, 0] == 255)


def test_colours_stand_where_their_vertices_are():
    colours = np.array([[200, 0, 0], [0, 200, 0], [0, 200, 0], [200, 0, 0]], dtype=np.uint8)
    front = picture([0.0, 0.0, 1.0], colours).astype(int)
    assert front[20, 20, 0] > front[20, 20, 1]  # red where x is negative: left in the picture
    assert front[20, 40, 1] > front[20, 40, 0]
