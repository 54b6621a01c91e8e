"""Models as OpenUSD: mesh, texture, and a rigid body of UsdPhysics with convex colliders, as Isaac Sim reads them."""

# pyright: reportAttributeAccessIssue=false, reportMissingImports=false

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from modeler.export.files import write_atomically
from modeler.export.mesh import Texture, linear_rgb
from modeler.export.solids import FRICTION, Body, ConvexParts, PhysicsFiles
from modeler.types import Array, ObjectModel


def write_usd(files: PhysicsFiles, model: ObjectModel, texture: Texture | None, body: Body, parts: ConvexParts) -> None:
    """Write the object as one rigid body, in m and kg, z up; its texture is `files.texture` beside it.

    Mass, centre and principal moments of inertia are at the body, convex parts as they are at its colliders, for not
    every program heeds an approximation that it is asked to make.

    Raises:
        ImportError: if usd-core is not installed.
        InputError: if the file cannot be written.
    """
    from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    root = Sdf.Path(f"/{files.name}")
    top = UsdGeom.Xform.Define(stage, root).GetPrim()
    stage.SetDefaultPrim(top)
    Usd.ModelAPI(top).SetKind(Kind.Tokens.component)
    UsdPhysics.RigidBodyAPI.Apply(top)
    mass = UsdPhysics.MassAPI.Apply(top)
    moments, axes = np.linalg.eigh(body.inertia_kg_m2)
    axes = axes * np.sign(np.linalg.det(axes))
    x, y, z, w = Rotation.from_matrix(axes).as_quat().tolist()
    mass.CreateMassAttr(body.mass_kg)
    mass.CreateCenterOfMassAttr(Gf.Vec3f(*body.centre_m.tolist()))
    mass.CreateDiagonalInertiaAttr(Gf.Vec3f(*moments.tolist()))
    mass.CreatePrincipalAxesAttr(Gf.Quatf(w, x, y, z))

    visual = _mesh(stage, root.AppendChild("visual"), model.vertices_m, model.triangles)
    visual.CreateNormalsAttr(model.vertex_normals.astype(np.float32))
    visual.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    visual.CreateDoubleSidedAttr(True)
    primvars = UsdGeom.PrimvarsAPI(visual)
    if texture is not None:
        places = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
        places.Set(texture.uv.astype(np.float32))
        look = _surface(stage, root.AppendPath("Looks/surface"), f"./{files.texture.name}")
        UsdShade.MaterialBindingAPI.Apply(visual.GetPrim()).Bind(look)
    elif model.vertex_colours is not None:
        shown = visual.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
        shown.Set(linear_rgb(model.vertex_colours).astype(np.float32))
    else:
        visual.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([Gf.Vec3f(0.45)])  # linear

    rough = UsdShade.Material.Define(stage, root.AppendPath("Looks/friction"))
    contact = UsdPhysics.MaterialAPI.Apply(rough.GetPrim())
    contact.CreateStaticFrictionAttr(FRICTION[0])
    contact.CreateDynamicFrictionAttr(FRICTION[0])
    contact.CreateRestitutionAttr(0.0)
    UsdGeom.Scope.Define(stage, root.AppendChild("colliders"))
    for number, (vertices_m, triangles) in enumerate(parts.meshes):
        part = _mesh(stage, root.AppendPath(f"colliders/part_{number:03d}"), vertices_m, triangles)
        part.CreatePurposeAttr(UsdGeom.Tokens.guide)  # not drawn
        UsdPhysics.CollisionAPI.Apply(part.GetPrim())
        UsdPhysics.MeshCollisionAPI.Apply(part.GetPrim()).CreateApproximationAttr(UsdPhysics.Tokens.convexHull)
        UsdShade.MaterialBindingAPI.Apply(part.GetPrim()).Bind(rough, UsdShade.Tokens.weakerThanDescendants, "physics")
    with tempfile.TemporaryDirectory() as folder:
        usd = files.model(".usd")
        written = Path(folder) / usd.name
        stage.Export(str(written), addSourceFileComment=False)
        write_atomically(usd, written.read_bytes())


def _mesh(stage: Any, path: Any, vertices_m: Array, triangles: npt.NDArray[np.int64]) -> Any:
    """Return a new mesh of triangles at a path of a stage."""
    from pxr import UsdGeom

    mesh = UsdGeom.Mesh.Define(stage, path)
    corners = vertices_m.astype(np.float32)
    mesh.CreatePointsAttr(corners)
    mesh.CreateFaceVertexCountsAttr(np.full(len(triangles), 3, dtype=np.int32))
    mesh.CreateFaceVertexIndicesAttr(triangles.ravel().astype(np.int32))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateExtentAttr(np.stack([corners.min(axis=0), corners.max(axis=0)]))
    return mesh


def _surface(stage: Any, path: Any, image: str) -> Any:
    """Return a new matt material at a path of a stage that shows an image by the coordinates `st`."""
    from pxr import Sdf, UsdShade

    material = UsdShade.Material.Define(stage, path)
    shader, reader, texture = (
        UsdShade.Shader.Define(stage, path.AppendChild(name)) for name in ("shader", "reader", "texture")
    )
    kinds = Sdf.ValueTypeNames
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", kinds.String).Set("st")
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", kinds.Asset).Set(Sdf.AssetPath(image))
    texture.CreateInput("sourceColorSpace", kinds.Token).Set("sRGB")
    texture.CreateInput("st", kinds.Float2).ConnectToSource(reader.CreateOutput("result", kinds.Float2))
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", kinds.Color3f).ConnectToSource(texture.CreateOutput("rgb", kinds.Float3))
    shader.CreateInput("roughness", kinds.Float).Set(1.0)
    shader.CreateInput("metallic", kinds.Float).Set(0.0)
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", kinds.Token))
    return material


def opened_usd(path: Path) -> tuple[bool, str]:
    """Return whether OpenUSD finds all physics in a file, and words; `Checks.attempt` takes what this raises."""
    from pxr import Tf, Usd, UsdGeom, UsdPhysics, UsdShade

    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise ValueError(str(error)) from error
    colliders, images = 0, []
    for prim in stage.Traverse():
        colliders += prim.HasAPI(UsdPhysics.CollisionAPI)
        if prim.IsA(UsdShade.Shader) and (image := UsdShade.Shader(prim).GetInput("file")):
            images.append(image.Get().resolvedPath)
    body = stage.GetDefaultPrim()
    shown = UsdGeom.Mesh(body.GetChild("visual"))
    size_m = np.ptp(np.array(shown.GetPointsAttr().Get()), axis=0)
    in_metres = UsdGeom.GetStageMetersPerUnit(stage) == 1.0 and UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    whole = in_metres and colliders > 0 and all(images) and body.HasAPI(UsdPhysics.RigidBodyAPI)
    version = ".".join(map(str, Usd.GetVersion()[1:]))
    return whole, (
        f"OpenUSD {version} opens it: {' x '.join(f'{length:.3g}' for length in size_m)} m, z up, "
        f"{len(shown.GetFaceVertexCountsAttr().Get())} triangles, a rigid body of {colliders} convex parts"
    )
