"""Photographs of labelled bodies: print turns with the body, light stays with the camera, and a seed decides both."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from input_errors import refused
from PIL import Image
from scipy.ndimage import map_coordinates
from trimesh.visual.texture import TextureVisuals

from modeler import se3
from modeler.sequences.rendering import RenderedSequence
from modeler.sequences.rendering.cameras import Lamp, Photography, SmoothNormals
from modeler.sequences.rendering.labels import (
    Chart,
    Cylindrical,
    Embedded,
    Faces,
    Label,
    Picture,
    Print,
    Spherical,
    Unwrapped,
    gamma_coded,
)
from modeler.sequences.rendering.recipe import Place, Places, Recipe, Viewpoint, load_recipe
from modeler.sequences.rendering.shapes import AnyShape, Box, Cylinder, MeshFile, Sphere
from modeler.system.pictures import linear_light
from modeler.types import Array, InputError

VIEW = Viewpoint(160, 120, 287.5, 0.6, look_height_m=0.05)
STEADY = Photography(highlight=0.0, exposure_sigma=0.0, white_balance_sigma=0.0, noise_levels=0.0, samples=1)
FLAT = replace(STEADY, ambient=0.8, lamps=())
TIN, BALL, BOX = Cylinder(0.037, 0.11), Sphere(0.05), Box((0.08, 0.08, 0.12))


def turned(
    shape: AnyShape, *turns_deg: float, label: Label | None = None, photography: Photography = FLAT
) -> RenderedSequence:
    """Return exact views of a shape that is turned about the vertical."""
    places = Places(tuple(Place(rotation_deg=(0.0, 0.0, turn_deg)) for turn_deg in turns_deg))
    recipe = Recipe(shape, view=VIEW, trajectory=places, sensor=None, colour="png")
    return RenderedSequence(replace(recipe, label=label, photography=photography))


def seen(sequence: RenderedSequence, index: int) -> tuple[Array, Array]:
    """Return points (n, 3) of the object that a view shows, in its camera frame, and their linear colours (n, 3)."""
    frame = sequence.frame(index)
    rays = np.stack([*frame.camera.rays(), np.ones(frame.mask.shape)], axis=-1)
    points_m = (rays * frame.depth_m[..., None])[frame.mask]
    return points_m, linear_light(frame.colour[frame.mask] / 255.0)


def carried_colours(sequence: RenderedSequence) -> tuple[Array, Array, Array]:
    """Return the colours (n, 3) of points that both views show: in the first, in the second, and had it not moved."""
    truth, target = sequence.truth(), sequence.frame(1)
    points_m, colours = seen(sequence, 0)
    there_m = se3.transform(truth[1] @ se3.inverse(truth[0]), points_m)
    image, camera = linear_light(target.colour / 255.0), target.camera
    found = []
    for at_m in (there_m, points_m):
        place = [camera.fy * at_m[:, 1] / at_m[:, 2] + camera.cy, camera.fx * at_m[:, 0] / at_m[:, 2] + camera.cx]
        depth_m = map_coordinates(np.nan_to_num(target.depth_m.astype(np.float64)), place, order=1)
        looked = [map_coordinates(image[..., k], place, order=1) for k in range(3)]
        found.append((np.abs(depth_m - at_m[:, 2]) < 1e-3, np.stack(looked, axis=1)))
    both = found[0][0] & found[1][0]
    assert both.sum() > 300
    return colours[both], found[0][1][both], found[1][1][both]


def correlation(first: Array, second: Array) -> float:
    return float(np.corrcoef((first - first.mean(axis=0)).ravel(), (second - second.mean(axis=0)).ravel())[0, 1])


@pytest.mark.parametrize("light", [FLAT, Photography()])
@pytest.mark.parametrize(
    ("shape", "wrap"), [(TIN, Cylindrical()), (BALL, Spherical()), (BOX, Faces(lids=True))], ids=("tin", "ball", "box")
)
def test_print_turns_with_the_body(shape: AnyShape, wrap: Cylindrical | Spherical | Faces, light: Photography) -> None:
    sequence = turned(shape, 0.0, 24.0, label=Label(Print(3), wrap), photography=light)
    here, there, unmoved = carried_colours(sequence)
    assert correlation(here, there) > 0.85
    assert np.abs(here - there).mean() < 0.5 * np.abs(here - unmoved).mean()


def test_a_point_of_a_tin_has_the_colour_that_its_label_has_there() -> None:
    """Looked up by the definition, with neither mesh nor texture in between."""
    label = Label(Print(5), Cylindrical(-0.03, 0.04))
    sequence = turned(TIN, 0.0, 130.0, label=label)
    chart = Chart(2.0 * np.pi * 0.037, 0.07, closed=True)
    image = linear_light(Print(5).image(TIN.mesh(), chart, 0, VIEW.distance_m / VIEW.focal_px).astype(np.float64))
    for index in (0, 1):
        points_m, colours = seen(sequence, index)
        x, y, z = se3.transform(se3.inverse(sequence.truth()[index]), points_m).T
        on_side = np.abs(np.hypot(x, y) - 0.037) < 1e-4
        labelled = on_side & (z > -0.0299) & (z < 0.0399)
        column = np.arctan2(y, x) / (2.0 * np.pi) % 1.0 * image.shape[1] - 0.5
        row = np.clip((0.04 - z) / 0.07 * image.shape[0] - 0.5, 0, image.shape[0] - 1)
        wrapped = np.concatenate([image[:, -1:], image, image[:, :1]], axis=1)
        expected = np.stack([map_coordinates(wrapped[..., k], [row, column + 1.0], order=1) for k in range(3)], axis=1)
        levels = [255.0 * gamma_coded(light) for light in (colours[labelled], 0.8 * expected[labelled])]
        assert labelled.sum() > 400
        assert np.abs(levels[0] - levels[1]).max() < 2.0  # rounded to a level, on facets
        bare = linear_light(np.array(190.0) / 255.0)
        np.testing.assert_allclose(colours[on_side & (np.abs(z - 0.005) > 0.036)], 0.8 * bare, atol=0.004)


def test_light_depends_on_the_normal_in_the_camera_frame_only() -> None:
    """Lambert's law, on a ball whose normals are known, wherever it stands and however it is turned."""
    lamps = (Lamp((-1.0, -2.0, -2.0), 0.5), Lamp((2.0, 0.0, -1.0), 0.25))
    places = Places((Place(), Place((0.04, 0.03, 0.02), (40.0, 70.0, 110.0))))
    recipe = Recipe(BALL, view=VIEW, trajectory=places, sensor=None, colour="png")
    sequence = RenderedSequence(replace(recipe, photography=replace(STEADY, ambient=0.2, lamps=lamps)))
    bare = linear_light(np.array(190.0) / 255.0)
    for index in (0, 1):
        points_m, colours = seen(sequence, index)
        normals = (points_m - sequence.truth()[index][:3, 3]) / 0.05
        lit = 0.5 * np.maximum(normals @ [-1, -2, -2], 0.0) / 3.0 + 0.25 * np.maximum(normals @ [2, 0, -1], 0) / 5**0.5
        expected = 255.0 * gamma_coded(bare * (0.2 + lit))
        assert np.abs(255.0 * gamma_coded(colours[:, 1]) - expected).max() < 1.5


def test_highlights_lie_halfway_between_lamp_and_camera() -> None:
    lamp = np.array([-0.6, -0.8, -1.0]) / np.sqrt(2.0)
    glossy = Photography(ambient=0.0, lamps=(Lamp((-0.6, -0.8, -1.0), 1.0),), highlight=0.5, highlight_exponent=40.0)
    black, point_m = np.zeros((1, 3)), np.array([[0.1, 0.05, 0.6]])
    half = lamp - point_m[0] / np.linalg.norm(point_m)
    half /= np.linalg.norm(half)
    np.testing.assert_allclose(glossy.radiance(black, half[None], point_m), 0.5)
    np.testing.assert_allclose(glossy.radiance(black, -half[None], point_m), 0.5)  # of thin sheets both sides are seen
    aside = np.cross(half, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(half, [0.0, 0.0, 1.0]))
    tilted = np.cos(0.2) * half + np.sin(0.2) * aside
    np.testing.assert_allclose(glossy.radiance(black, tilted[None], point_m), 0.5 * np.cos(0.2) ** 40)


def test_highlights_stay_with_the_camera() -> None:
    """A glossy body without print looks the same however it is turned: facets must not show."""
    glossy = replace(STEADY, highlight=1.0, highlight_exponent=15.0, samples=3)
    for shape in (TIN, BALL):
        sequence = turned(shape, 0.0, 37.3, photography=glossy)
        first, second = (sequence.frame(index) for index in (0, 1))
        apart = np.abs(first.colour.astype(int) - second.colour.astype(int))[first.mask]
        assert np.mean(apart > 1) < 0.03  # edges, which are polygons
        assert np.ptp(first.colour[first.mask].astype(int)) > 40  # yet light varies


def test_a_print_without_contrast_is_paper() -> None:
    chart = Chart(0.2, 0.1, closed=True)
    plain, faint, strong = (
        Print(7, contrast, (200, 150, 100)).image(TIN.mesh(), chart, 0, 5e-4).astype(np.float64)
        for contrast in (0.0, 0.1, 1.0)
    )
    paper = np.array([200, 150, 100]) / 255.0
    np.testing.assert_allclose(plain, np.broadcast_to(paper, plain.shape), atol=1e-7)
    np.testing.assert_allclose(faint - paper, 0.1 * (strong - paper), atol=1e-6)
    assert strong.std(axis=(0, 1)).min() > 0.1


def test_prints_have_detail_at_all_scales() -> None:
    """Of every octave from 2 mm up to a quarter of the label, at least a fiftieth of the variance."""
    image = Print(1).image(TIN.mesh(), Chart(0.23, 0.1, closed=True), 0, 5e-4).mean(axis=2).astype(np.float64)
    power = np.abs(np.fft.fft2(image - image.mean())) ** 2
    along, across = (np.fft.fftfreq(n, 5e-4) for n in image.shape)
    period_m = 1.0 / np.maximum(np.hypot(along[:, None], across), 1e-9)
    for shortest_m in (0.003, 0.006, 0.012, 0.024):
        octave = (period_m >= shortest_m) & (period_m < 2.0 * shortest_m)
        assert power[octave].sum() > 0.02 * power.sum()


def test_prints_differ_by_seed_and_by_face_and_not_by_run() -> None:
    chart = Chart(0.08, 0.12)
    images = [Print(seed).image(BOX.mesh(), chart, face, 1e-3) for seed, face in ((1, 0), (1, 0), (1, 1), (2, 0))]
    np.testing.assert_array_equal(images[0], images[1])
    for other in images[2:]:
        assert np.abs(images[0] - other).mean() > 0.05


def test_the_border_of_a_closed_label_does_not_show() -> None:
    image = Print(2).image(TIN.mesh(), Chart(0.23, 0.1, closed=True), 0, 5e-4).astype(np.float64)
    steps = np.abs(np.roll(image, -1, axis=1) - image).mean(axis=(0, 2))
    assert steps[-1] < 2.0 * steps.mean()


def test_exposure_and_white_balance_drift_and_pixels_are_noisy() -> None:
    grey = np.full((30, 30, 3), 0.3)
    drifting = Photography(exposure_sigma=0.1, white_balance_sigma=0.05, noise_levels=2.0)
    images = np.array([drifting.image(grey, np.random.default_rng(k)) for k in range(400)]).astype(np.float64)
    level = 255.0 * gamma_coded(np.array(0.3))
    means = np.log(linear_light(images.mean(axis=(1, 2)) / 255.0) / 0.3)
    # Balances are relative to their mean, so that three gains of sigma 0.05 vary by 0.05 x sqrt(2/3) about exposure.
    assert means.mean(axis=1).std() == pytest.approx(0.1, rel=0.1)
    assert (means - means.mean(axis=1, keepdims=True)).std() == pytest.approx(0.05 * np.sqrt(2.0 / 3.0), rel=0.1)
    within = (images - images.mean(axis=(1, 2), keepdims=True)).std()
    assert within == pytest.approx(np.hypot(2.0, 1.0 / np.sqrt(12.0)), rel=0.02)
    assert images.mean() == pytest.approx(level, rel=0.02)


def test_photographs_leave_depth_and_motion_alone() -> None:
    recipe = load_recipe("label-box")
    plain = replace(recipe, label=None, photography=None, colour="none")
    with_light, without = RenderedSequence(recipe), RenderedSequence(plain)
    np.testing.assert_array_equal(with_light.frame(2).depth_m, without.frame(2).depth_m)
    np.testing.assert_array_equal(with_light.truth()[2], without.truth()[2])


def write_quarters(path: Path) -> Path:
    """Write an image whose quarters are red, green (above), blue and white (below)."""
    quarters = np.zeros((64, 64, 3), np.uint8)
    quarters[:32, :32], quarters[:32, 32:], quarters[32:, :32], quarters[32:, 32:] = (
        (255, 0, 0),
        (0, 255, 0),
        (0, 0, 255),
        (255, 255, 255),
    )
    Image.fromarray(quarters).save(path)
    return path


def side_view(shape: AnyShape, label: Label, turn_deg: float) -> np.ndarray:
    """Return the colour image of a shape seen from the -y side at its own height, cut to the object's mask."""
    view = Viewpoint(160, 160, 700.0, 0.6, elevation_deg=0.0, look_height_m=0.06)
    places = Places((Place(rotation_deg=(0.0, 0.0, turn_deg)),))
    recipe = Recipe(shape, view=view, table=None, trajectory=places, sensor=None, colour="png")
    frame = RenderedSequence(replace(recipe, label=label, photography=replace(FLAT, ambient=1.0))).frame(0)
    rows, columns = np.flatnonzero(frame.mask.any(axis=1)), np.flatnonzero(frame.mask.any(axis=0))
    return frame.colour[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]


def quarters_of(image: np.ndarray) -> list[list[int]]:
    """Return the colours in the middles of the quarters: upper left, upper right, lower left, lower right."""
    height, width = image.shape[:2]
    places = [(height // 4, width // 4), (height // 4, 3 * width // 4)]
    places += [(3 * height // 4, width // 4), (3 * height // 4, 3 * width // 4)]
    return [image[place].tolist() for place in places]


QUARTERS = [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]]


@pytest.mark.parametrize("turn_deg", [0.0, 90.0, 180.0, 270.0])
def test_pictures_on_faces_are_upright_and_not_mirrored(tmp_path: Path, turn_deg: float) -> None:
    label = Label(Picture((write_quarters(tmp_path / "q.png"),)), Faces())
    assert quarters_of(side_view(Box((0.08, 0.08, 0.12)), label, turn_deg)) == QUARTERS


@pytest.mark.parametrize(("shape", "wrap"), [(TIN, Cylindrical()), (Sphere(0.06), Spherical())])
def test_pictures_around_bodies_are_upright_and_not_mirrored(
    tmp_path: Path, shape: AnyShape, wrap: Cylindrical | Spherical
) -> None:
    """The picture's middle column is at the azimuth of half a turn: turned to face the camera at -90 degrees."""
    label = Label(Picture((write_quarters(tmp_path / "q.png"),)), wrap)
    assert quarters_of(side_view(shape, label, 90.0)) == QUARTERS


def unwrapped_square(path: Path, picture: Path) -> Path:
    """Write an upright slab in the plane y = 0 whose front, towards -y, shows all of a picture, the right way up."""
    corners = np.array([[-0.04, 0, 0], [0.04, 0, 0], [0.04, 0, 0.12], [-0.04, 0, 0.12]])
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    visual = TextureVisuals(uv=uv, image=Image.open(picture))
    trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False).export(path)
    return path


@pytest.mark.parametrize("kind", ["glb", "obj"])
def test_meshes_show_their_own_texture(tmp_path: Path, kind: str) -> None:
    picture = write_quarters(tmp_path / "q.png")
    mesh = unwrapped_square(tmp_path / f"square.{kind}", picture)
    image = Embedded() if kind == "glb" else Picture((picture,))
    assert quarters_of(side_view(MeshFile(mesh), Label(image, Unwrapped()), 0.0)) == QUARTERS


def test_a_broken_image_in_a_mesh_file_is_one_line(tmp_path: Path) -> None:
    whole = unwrapped_square(tmp_path / "square.glb", write_quarters(tmp_path / "q.png")).read_bytes()
    at = whole.index(b"IDAT")
    (tmp_path / "broken.glb").write_bytes(whole[: at + 8] + bytes(20) + whole[at + 28 :])
    with refused("broken.glb", "is not a readable mesh"):
        MeshFile(tmp_path / "broken.glb").mesh()


def test_pictures_finer_than_a_pixel_look_grey(tmp_path: Path) -> None:
    """Lines of black and white, 0.1 mm wide, where a pixel sees 2 mm."""
    lines = np.broadcast_to(np.tile(np.array([0, 255], np.uint8), 1160)[None, :, None], (500, 2320, 3))
    Image.fromarray(np.ascontiguousarray(lines)).save(tmp_path / "lines.png")
    label = Label(Picture((tmp_path / "lines.png",)), Cylindrical())
    points_m, colours = seen(turned(TIN, 0.0, label=label), 0)
    x, y, z = se3.transform(se3.inverse(turned(TIN, 0.0).truth()[0]), points_m).T
    side = (np.abs(np.hypot(x, y) - 0.037) < 1e-4) & (np.abs(z) < 0.054)
    lines_seen = 0.6 / 287.5 / 1e-4
    assert np.ptp(255.0 * gamma_coded(colours[side])) < 255.0 / lines_seen + 1.0  # one more or less, and rounding


def test_normals_are_those_of_the_round_surface_and_stop_at_edges() -> None:
    mesh = TIN.mesh()
    rng = np.random.default_rng(0)
    triangle, weights = rng.integers(0, len(mesh.triangles), 500), rng.dirichlet([1.0, 1.0, 1.0], 500)
    normals = SmoothNormals(mesh).at(triangle, weights)
    points_m = np.einsum("nc,nck->nk", weights, mesh.corners()[triangle])
    lid = np.abs(np.abs(points_m[:, 2]) - 0.055) < 1e-9
    assert 50 < lid.sum() < 450
    radial = points_m * [1, 1, 0] / np.linalg.norm(points_m[:, :2], axis=1, keepdims=True)
    np.testing.assert_allclose(normals[~lid], radial[~lid], atol=1e-4)
    np.testing.assert_allclose(normals[lid], np.sign(points_m[lid, 2:]) * [[0.0, 0.0, 1.0]], atol=1e-9)
    axes = np.abs(SmoothNormals(BOX.mesh()).corners)
    np.testing.assert_allclose(np.sort(axes, axis=-1), np.broadcast_to([0.0, 0.0, 1.0], axes.shape), atol=1e-12)


BODY = '"object": {"kind": "cylinder", "radius_m": 0.03, "height_m": 0.1}, "colour": "png"'
FAULTS = {
    "no photography": ('"label": {}', "photography"),
    "wrap": ('"photography": {}, "label": {"wrap": {"kind": "sheet"}}', "cylindrical, spherical, faces, unwrapped"),
    "contrast": ('"photography": {}, "label": {"image": {"kind": "print", "contrast": 2}}', "contrast"),
    "band": ('"photography": {}, "label": {"wrap": {"kind": "cylindrical", "bottom_m": 1, "top_m": 0}}', "top_m"),
    "pictures": ('"photography": {}, "label": {"image": {"kind": "picture", "paths": ["a.png", "b.png"]}}', "paths"),
    "dark lamp": ('"photography": {"lamps": [{"direction": [0, 0, 0], "strength": 1}]}', "direction"),
    "exponent": ('"photography": {"highlight_exponent": 0}', "highlight_exponent"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_labels_and_light_are_one_line(tmp_path: Path, fault: str) -> None:
    text, word = FAULTS[fault]
    (tmp_path / "r.json").write_text(f"{{{BODY}, {text}}}")
    with refused("r.json", word):
        load_recipe(tmp_path / "r.json")


@pytest.mark.parametrize(
    ("label", "word"),
    [
        ({"wrap": {"kind": "unwrapped"}}, "texture coordinates"),
        ({"image": {"kind": "embedded"}}, "no image"),
        ({"image": {"kind": "picture", "paths": ["missing.png"]}}, "missing.png"),
    ],
)
def test_labels_that_cannot_be_laid_are_refused(tmp_path: Path, label: dict[str, object], word: str) -> None:
    recipe = json.loads(f"{{{BODY}}}") | {"photography": {}, "label": label}
    (tmp_path / "r.json").write_text(json.dumps(recipe))
    sequence = RenderedSequence(load_recipe(tmp_path / "r.json"))
    with pytest.raises(InputError, match=word):
        sequence.frame(0)
