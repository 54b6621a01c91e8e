"""Models for pose estimators, simulators and printers: what is written holds what the mesh holds."""

import itertools
import json
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from command_runner import Run, refusal_of
from run_builders import ball, block
from scipy.spatial.transform import Rotation
from slow_cases import quick_first

from modeler import se3
from modeler.export import solids
from modeler.runs.presets import Checks, mesh_checks
from modeler.sequences import open_sequence
from modeler.system.pictures import encoded
from modeler.types import Array, InputError, ObjectModel

SIDES_M = np.array([0.06, 0.1, 0.2])


def brick(pose: Array | None = None) -> ObjectModel:
    """A solid box, at the origin unless a pose (4, 4) is given."""
    return block((0.06, 0.1, 0.2), np.eye(4) if pose is None else pose)


def box_inertia(mass_kg: float) -> Array:
    squares = SIDES_M**2
    return np.diag(mass_kg / 12.0 * (squares.sum() - squares))


def test_mass_and_inertia_of_a_box_are_those_of_the_closed_form_in_any_pose(rng: np.random.Generator) -> None:
    for _ in range(5):
        pose = se3.exp(rng.normal(size=6))
        body = solids.body_of(brick(pose), density_kg_m3=700.0)
        mass = 700.0 * SIDES_M.prod()
        assert body.mass_kg == pytest.approx(mass, rel=1e-9)
        assert body.volume_m3 == pytest.approx(SIDES_M.prod(), rel=1e-9)
        np.testing.assert_allclose(body.centre_m, pose[:3, 3], atol=1e-9)
        expected = pose[:3, :3] @ box_inertia(mass) @ pose[:3, :3].T
        np.testing.assert_allclose(body.inertia_kg_m2, expected, atol=1e-9 * mass)
        assert solids.is_possible_inertia(body.inertia_kg_m2)
        given = solids.body_of(brick(pose), density_kg_m3=1.0, mass_kg=2.0)
        np.testing.assert_allclose(given.inertia_kg_m2, expected * 2.0 / mass, atol=1e-9)
    assert not solids.is_possible_inertia(np.diag([1.0, 1.0, 2.1]))
    assert not solids.is_possible_inertia(np.diag([-1.0, 1.0, 1.0]))


def test_an_open_mesh_is_no_solid() -> None:
    opened = replace(ball(), triangles=ball().triangles[1:])
    inside_out = replace(ball(), triangles=ball().triangles[:, ::-1])
    for wrong in (opened, inside_out):
        with pytest.raises(InputError, match="encloses no volume"):
            solids.body_of(wrong, density_kg_m3=1000.0)


def test_without_its_library_a_body_collides_as_its_convex_hull(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    parts = solids.convex_parts(ball())
    ((vertices_m, triangles),) = parts.meshes
    hull = trimesh.Trimesh(vertices_m, triangles)
    assert "one convex hull" in parts.method
    assert "not installed" in parts.method
    assert hull.is_convex
    assert len(triangles) <= solids.HULL_TRIANGLES
    assert hull.volume == pytest.approx(4.0 / 3.0 * np.pi * 0.05**3, rel=0.06)


def test_concave_bodies_become_several_convex_parts() -> None:
    pytest.importorskip("coacd")
    ring = trimesh.creation.torus(0.05, 0.015, 48, 24)
    model = replace(ball(coloured=False), vertices_m=np.asarray(ring.vertices), triangles=np.asarray(ring.faces))
    parts = solids.convex_parts(model)
    assert len(parts.meshes) > 3
    pieces = [trimesh.Trimesh(*mesh) for mesh in parts.meshes]
    assert all(piece.is_convex for piece in pieces)
    assert sum(piece.volume for piece in pieces) == pytest.approx(ring.volume, rel=0.25)
    assert not any(piece.contains([[0.0, 0.0, 0.0]])[0] for piece in pieces)  # the hole stays open


@pytest.mark.parametrize("laid_m", [1e-3, None])
def test_a_print_stands_flat_and_stays_closed(laid_m: float | None) -> None:
    fine = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    places_m = fine.vertices + np.array([0.0, 0.0, 0.0485])  # 1.5 mm of it below the plane
    lifted = replace(ball(), vertices_m=places_m, triangles=np.asarray(fine.faces))
    flat = solids.with_flat_bottom(lifted, laid_m)
    mesh = trimesh.Trimesh(flat.vertices_m, flat.triangles)
    assert mesh.is_watertight
    assert flat.vertices_m[:, 2].min() == 0.0
    assert solids.bottom_area_m2(flat.vertices_m, flat.triangles) > 3e-4
    assert solids.bottom_area_m2(lifted.vertices_m, lifted.triangles) == 0.0
    assert mesh.volume == pytest.approx(fine.volume, rel=0.01)


def written(folder: Path) -> tuple[solids.PhysicsFiles, solids.Body]:
    """A box that leans, 2 kg, written for simulators; its inertia has products of every sign."""
    pose = se3.exp(np.array([0.3, -0.2, 0.5, 0.02, 0.01, 0.1]))
    body = solids.body_of(brick(pose), density_kg_m3=1.0, mass_kg=2.0)
    of, parts = (
        solids.PhysicsFiles(folder / "a box", coloured=False),
        solids.ConvexParts(((brick(pose).vertices_m, brick().triangles),), "itself"),
    )
    solids.write_parts(of, parts)
    of.visual.write_bytes(of.part(0).read_bytes())
    solids.write_mjcf(of, body, parts)
    solids.write_urdf(of, body, parts)
    solids.write_sdf(of, body, parts)
    return of, body


def test_simulators_files_hold_mass_and_inertia_in_their_own_order(tmp_path: Path) -> None:
    of, body = written(tmp_path)
    inertial = ElementTree.parse(of.model(".xml")).find(".//inertial")
    xx, yy, zz, xy, xz, yz = map(float, inertial.attrib["fullinertia"].split())
    np.testing.assert_allclose([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], body.inertia_kg_m2, rtol=1e-7)
    tree = ElementTree.parse(of.model(".urdf"))
    tags = {name: tree.find(f".//inertial/{name}") for name in ("inertia", "origin", "mass")}
    found = {name: tag.attrib for name, tag in tags.items() if tag is not None}
    for row, column in itertools.combinations_with_replacement(range(3), 2):
        stated = float(found["inertia"][f"i{'xyz'[row]}{'xyz'[column]}"])
        assert stated == pytest.approx(body.inertia_kg_m2[row, column], rel=1e-6)
    assert float(found["mass"]["value"]) == pytest.approx(2.0)
    np.testing.assert_allclose(list(map(float, found["origin"]["xyz"].split())), body.centre_m, rtol=1e-6)
    assert of.model(".xml").name == "a_box.xml"


def test_mujoco_takes_the_body_as_it_is(tmp_path: Path) -> None:
    mujoco = pytest.importorskip("mujoco")
    of, body = written(tmp_path)
    model = mujoco.MjModel.from_xml_path(str(of.folder / solids.MUJOCO_SCENE))
    assert model.body_mass[1] == pytest.approx(2.0)
    np.testing.assert_allclose(np.sort(model.body_inertia[1]), np.linalg.eigvalsh(body.inertia_kg_m2), rtol=1e-6)
    assert solids.settled_in_mujoco(of.folder / solids.MUJOCO_SCENE).at_rest


def test_pybullet_takes_the_body_as_it_is(tmp_path: Path) -> None:
    pybullet = pytest.importorskip("pybullet")
    of, _ = written(tmp_path)
    client = pybullet.connect(pybullet.DIRECT)
    number = pybullet.loadURDF(str(of.model(".urdf")), flags=pybullet.URDF_USE_INERTIA_FROM_FILE)
    dynamics = pybullet.getDynamicsInfo(number, -1)
    pybullet.disconnect(client)
    assert dynamics[0] == pytest.approx(2.0)
    assert dynamics[1] == pytest.approx(solids.FRICTION[0])
    assert solids.settled_in_pybullet(of.model(".urdf"), 0.2).at_rest


def test_drake_takes_the_body_of_gazebo_as_it_is(tmp_path: Path) -> None:
    """Drake reads SDF with the library of Gazebo, libsdformat."""
    pytest.importorskip("pydrake")
    from pydrake.multibody.parsing import Parser  # pyright: ignore[reportMissingImports]
    from pydrake.planning import RobotDiagramBuilder  # pyright: ignore[reportMissingImports]

    of, body = written(tmp_path)
    builder = RobotDiagramBuilder()
    Parser(builder.plant(), builder.scene_graph()).AddModels(str(of.folder / "model.sdf"))
    builder.plant().Finalize()
    link = builder.plant().GetBodyByName("link")
    assert link.default_mass() == pytest.approx(2.0)
    inertia = link.default_spatial_inertia()
    np.testing.assert_allclose(inertia.get_com(), body.centre_m, rtol=1e-6)
    about_centre = inertia.Shift(inertia.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
    np.testing.assert_allclose(about_centre, body.inertia_kg_m2, rtol=1e-5)
    inspector = builder.scene_graph().model_inspector()
    shapes = [inspector.GetShape(number) for number in inspector.GetAllGeometryIds()]
    assert [Path(shape.source().path()) for shape in shapes] == [of.visual, of.part(0)]
    assert ElementTree.parse(of.folder / "model.config").findtext("sdf") == "model.sdf"


@pytest.mark.parametrize("coloured", [True, False])
def test_usd_holds_a_rigid_body_in_metres(tmp_path: Path, coloured: bool) -> None:
    Usd, UsdGeom, UsdPhysics, UsdShade = (
        pytest.importorskip(f"pxr.{name}") for name in ("Usd", "UsdGeom", "UsdPhysics", "UsdShade")
    )
    from modeler.export.mesh import linear_rgb, textured
    from modeler.export.usd import write_usd

    pose = se3.exp(np.array([0.3, -0.2, 0.5, 0.02, 0.01, 0.1]))
    body = solids.body_of(brick(pose), density_kg_m3=1.0, mass_kg=2.0)
    parts = solids.ConvexParts(((brick(pose).vertices_m, brick().triangles),) * 2, "itself, twice")
    model, of, texture = ball(), solids.PhysicsFiles(tmp_path / "a ball", coloured), None
    if coloured:
        red = np.array([200, 20, 90], dtype=np.uint8)
        model, texture = textured(model, lambda at, *_: (np.tile(red, (len(at), 1)), np.ones(len(at), dtype=bool)), 64)
        of.folder.mkdir()
        of.texture.write_bytes(encoded(texture.image, "PNG"))
    write_usd(of, model, texture, body, parts)

    stage = Usd.Stage.Open(str(of.model(".usd")))
    assert (UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)) == (1.0, "Z")
    root = stage.GetDefaultPrim()
    mass = UsdPhysics.MassAPI(root)
    x, y, z = mass.GetPrincipalAxesAttr().Get().GetImaginary()
    axes = Rotation.from_quat([x, y, z, mass.GetPrincipalAxesAttr().Get().GetReal()]).as_matrix()
    assert mass.GetMassAttr().Get() == pytest.approx(2.0)
    np.testing.assert_allclose(mass.GetCenterOfMassAttr().Get(), body.centre_m, rtol=1e-6)
    inertia = axes @ np.diag(mass.GetDiagonalInertiaAttr().Get()) @ axes.T
    np.testing.assert_allclose(inertia, body.inertia_kg_m2, atol=1e-8)
    with warnings.catch_warnings():  # its successor cannot be called from Python yet
        warnings.simplefilter("ignore", DeprecationWarning)
        parsed = UsdPhysics.LoadUsdPhysicsFromRange(stage, [root.GetPath()])
    (bodies,) = (found[1] for kind, found in parsed.items() if kind == UsdPhysics.ObjectType.RigidBody)
    assert len(bodies[0].collisions) == 2
    (shapes,) = (found[1] for kind, found in parsed.items() if kind == UsdPhysics.ObjectType.MeshShape)
    assert {shape.approximation for shape in shapes} == {"convexHull"}
    assert all(len(shape.materials) == 1 for shape in shapes)

    mesh = UsdGeom.Mesh(root.GetChild("visual"))
    corners = np.array(mesh.GetPointsAttr().Get())[np.reshape(mesh.GetFaceVertexIndicesAttr().Get(), (-1, 3))]
    np.testing.assert_allclose(corners, model.vertices_m[model.triangles], atol=1e-6)
    bound = UsdShade.MaterialBindingAPI(root.GetChild("visual")).ComputeBoundMaterial()[0]
    if texture is None:
        assert not bound
        assert model.vertex_colours is not None
        shown = mesh.GetDisplayColorAttr().Get()
        np.testing.assert_allclose(shown, linear_rgb(model.vertex_colours), atol=1e-6)
        return
    image = UsdShade.Shader(stage.GetPrimAtPath(bound.GetPath().AppendChild("texture")))
    assert Path(image.GetInput("file").Get().resolvedPath) == of.texture
    np.testing.assert_allclose(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get(), texture.uv, atol=1e-6)
    surface = bound.ComputeSurfaceSource()[0]
    assert (surface.GetInput("metallic").Get(), surface.GetInput("roughness").Get()) == (0.0, 1.0)


def test_a_missing_library_is_said_before_any_work(
    refusal: Callable[..., str], built: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    said = refusal("export", built, "--for", "isaac", "--out", tmp_path / "out")
    assert "usd-core is not installed" in said
    assert "-m pip install 'modeler[usd]'" in said


def test_checks_tell_what_does_not_hold(tmp_path: Path) -> None:
    path = tmp_path / "ball.ply"
    trimesh.Trimesh(ball().vertices_m * 1000.0, [*ball().triangles, [0, 0, 1]], process=False).export(path)
    checks = mesh_checks(path, most_triangles=10)
    assert len(checks.failed) == 3  # size, number, degenerate
    assert not checks.held
    assert "FAILED" in checks.words
    in_mm = mesh_checks(path, unit_m=1e-3, most_triangles=10**6)
    assert [words for words in in_mm.failed if "degenerate" not in words] == []

    def refuses() -> tuple[bool, str]:
        raise ValueError("no\nsuch thing")

    def is_absent() -> tuple[bool, str]:
        raise ImportError

    assert Checks().attempt(refuses, "false_surface").failed == ("no such thing",)
    assert Checks().attempt(is_absent, "false_surface").held == ("false_surface",)


def test_both_bop_exports_have_one_frame(cli: Run, built: Path, tmp_path: Path) -> None:
    single, preset = tmp_path / "models" / "obj_000001.ply", tmp_path / "bop"
    assert cli("export", built, "--bop", "--out", single).status == 0
    assert cli("export", built, "--for", "bop", "--out", preset).status == 0
    one, other = (trimesh.load_mesh(path) for path in (single, preset / "models" / "obj_000001.ply"))
    np.testing.assert_allclose(one.bounds, other.bounds, atol=0.5)  # mm; the preset fuses again
    entries = [json.loads(path.with_name("models_info.json").read_text())["1"] for path in (
        single, preset / "models" / "obj_000001.ply"
    )]  # fmt: skip
    np.testing.assert_allclose(*(entry["object_from_mesh"] for entry in entries), atol=5e-4)


@pytest.mark.parametrize(
    ("purpose", "name", "files"),
    quick_first(
        [
            ("foundationpose", "fp", {"model.obj", "model.mtl", "model.png", "model_seen.png", "model.obj.pose.json"}),
            ("print", "solid", {"model.stl", "model.stl.pose.json"}),
            ("mujoco", "mj", {"mj.xml", "scene.xml", "visual.obj", "visual.obj.pose.json"}),
            ("isaac", "is", {"is.usd", "is.usd.pose.json"}),
            ("urdf", "ur", {"ur.urdf", "visual.obj", "visual.obj.pose.json"}),
            ("gazebo", "gz", {"model.sdf", "model.config", "visual.obj", "visual.obj.pose.json"}),
            ("bop", "bop", {"models", "onboarding_static"}),
        ],
        4,
    ),
)
def test_every_preset_ends_with_what_was_checked(
    cli: Run, built: Path, tmp_path: Path, purpose: str, name: str, files: set[str]
) -> None:
    if purpose == "isaac":
        pytest.importorskip("pxr")
    out = tmp_path / name
    ended = cli("export", built, "--for", purpose, "--out", out, "--texture-px", "256")
    last = ended.err.splitlines()[-1]
    assert (ended.status, ended.out) == (0, ""), ended.err
    assert last.startswith("modeler: checked: ")
    coloured = ("part_", "visual.mtl", "visual.png", "visual_seen.png")
    there = {path.name for path in out.iterdir() if not path.name.startswith(coloured)}
    assert there == files
    if purpose == "print":
        mesh = trimesh.load_mesh(out / "model.stl")
        assert mesh.is_watertight
        assert 20.0 < mesh.extents.max() < 400.0  # mm
    if purpose == "bop":
        _check_bop(out, built)
    again = cli("export", built, "--for", purpose, "--out", out, "--texture-px", "256")
    assert "exists already" in refusal_of(again)


def _check_bop(out: Path, built: Path) -> None:
    """The poses of the scene take the model, in mm, to the depth that its frames show."""
    (entry,) = json.loads((out / "models" / "models_info.json").read_text()).values()
    mesh = trimesh.load_mesh(out / "models" / "obj_000001.ply", process=False)
    np.testing.assert_allclose(mesh.bounds.sum(axis=0), 0.0, atol=1e-3)
    assert mesh.extents[2] == pytest.approx(entry["size_z"], rel=1e-6)
    scene = out / "onboarding_static" / "obj_000001_up"
    sequence = open_sequence(scene)
    truth, info = sequence.truth(), json.loads((scene / "scene_gt_info.json").read_text())
    assert {str(index) for index in sequence.indices} == {*info}
    for index in sequence.indices:
        frame = sequence.frame(index)
        points = se3.transform(truth[index], np.asarray(mesh.vertices) / 1000.0)
        column = np.rint(points[:, 0] / points[:, 2] * frame.camera.fx + frame.camera.cx).astype(int)
        row = np.rint(points[:, 1] / points[:, 2] * frame.camera.fy + frame.camera.cy).astype(int)
        inside = (column >= 0) & (row >= 0) & (column < frame.camera.width) & (row < frame.camera.height)
        row, column, depth = row[inside], column[inside], points[inside, 2]
        facing = frame.mask[row, column] & (np.abs(frame.depth_m[row, column] - depth) < 0.01)
        assert facing.mean() > 0.2  # the side that this frame sees
        (stated,) = info[str(index)]
        assert stated["px_count_visib"] == frame.mask.sum()
        assert 0.5 < stated["visib_fract"] <= 1.0
        left, top, width, height = stated["bbox_obj"]
        assert left - 2 <= column.min()
        assert column.max() <= left + width + 2
        assert top - 2 <= row.min()
        assert row.max() <= top + height + 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--for", "print", "--out", "a.stl"), "writes a folder"),
        (("--for", "print", "--out", "a", "--up", "y"), "decides on --up"),
        (("--for", "prints", "--out", "a"), "one of bop, colmap, foundationpose"),
        (("--for", "bop", "--out", "a", "--mass-kg", "1"), "goes with --for mujoco"),
        (("--for", "urdf", "--out", "a", "--mass-kg", "0"), "out of range"),
        (("--for", "urdf", "--out", "a", "--mass-kg", "1", "--density-kg-m3", "1"), "give one of them"),
        (("--out", "a.ply", "--mass-kg", "1"), "go with --for mujoco"),
        (("--texture", "--out", "a.stl"), "--texture goes with"),
        (("--bop", "--out", "a.obj"), "BOP models are PLY files"),
        (("--tint", "views", "--out", "a.stl"), "STL carries no colour"),
        (("--triangles", "2", "--out", "a.stl"), "--triangles 2 is too few"),
        (("--voxel-m", "-1", "--out", "a.stl"), "--voxel-m -1 is out of range"),
        (("--texture", "--tint", "views", "--out", "a.glb"), "give one of them"),
        (("--watertight", "--sequence", "nowhere", "--out", "a.stl"), "give its new place with --sequence"),
    ],
)
def test_exports_that_cannot_be_are_said_in_one_line(
    refusal: Callable[..., str], built: Path, tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    given = [tmp_path / word if word.partition(".")[0] == "a" else word for word in arguments]
    assert words in refusal("export", built, *given)
    assert not list(tmp_path.iterdir())
