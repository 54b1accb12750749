"""A mesh with its material and blend shapes as OpenUSD.

Two materials in one: UsdPreviewSurface, which every reader knows and which has no subsurface light,
and the OpenPBR surface of the MaterialX export as a network of render context ``mtlx``. sigma_tr is
also in the customData of the material.

References
----------
OpenUSD: UsdGeom, UsdSkel (blend shapes), UsdPreviewSurface specification 2.6.
"""

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from model.skin import SkinAppearance
from skinrig.errors import MissingExtra
from skinrig.exporting.images import ImageFolder
from skinrig.exporting.materials import blender, materialx
from skinrig.exporting.materials.material import Material
from skinrig.exporting.options import M_PER_MM, UNITS_M, Delivery

USD_FILE, DOCUMENT_FILE = "skin.usdc", "usd.json"
SCHEMA: Final = "skinrig.export.usd/1"
ROOT_PRIM: Final = "/Skin"


def write(appearance: SkinAppearance, folder: Path, delivery: Delivery) -> list[tuple[str, str]]:
    """Write skin.usdc with its textures.

    Parameters
    ----------
    appearance
        Of a dome, or a fitted model.
    folder
        Existing, empty.
    delivery
        Scene unit (m by default), names of tiles, green of the normal map, another mesh; blend
        shapes come from it.

    Returns
    -------
    list of (str, str)
        What was left out, and why.

    Raises
    ------
    skinrig.errors.MissingExtra
        Without usd-core.
    ValueError
        See :meth:`skinrig.exporting.materials.material.Material.of`.
    """
    try:
        from pxr import Usd
    except ImportError as error:
        raise MissingExtra("export to USD", "usd") from error
    material = Material.of(appearance, delivery.mesh)
    unit_m = UNITS_M[delivery.unit_or("m")]
    per_mm = M_PER_MM / unit_m
    tiles = material.left_out_of_mesh(delivery)
    out = ImageFolder(folder, delivery, tiles=material.tiles)
    scale = materialx.write_textures(material, out)
    out.png(material.image("specular_roughness", delivery), materialx.TEXTURE_FOLDER)
    stage = Usd.Stage.CreateNew(str(folder / USD_FILE))
    names = _geometry(stage, material, per_mm, unit_m)
    _materials(stage, material, scale * per_mm, delivery)
    stage.GetRootLayer().Save()
    del stage
    textures = (
        ("Subsurface Radius", _place(delivery, "subsurface_radius_scale", "exr"), 1.0),
        # Blender's level of 0.5 is the reflection of a dielectric
        ("Specular IOR Level", _place(delivery, "specular_weight", "exr"), 0.5),
    )
    script = blender.Import(USD_FILE, scale, None, textures).script()
    (folder / blender.SCRIPT_FILE).write_text(script, encoding="utf-8")
    facts = materialx.facts(material, appearance, delivery, SCHEMA, scale)
    out.document(DOCUMENT_FILE, appearance, {**facts, "blend_shapes": names})
    what = "subsurface light and specular weight of UsdPreviewSurface"
    in_blender = f"the mtlx network holds both; {blender.SCRIPT_FILE} sets them"
    left_out = [*tiles, (what, f"it has no place for them: {in_blender}")]
    if not material.shapes:
        left_out.append(("blend shapes", "the mesh has none; name one with --mesh"))
    return left_out


def _geometry(stage: Any, material: Material, per_mm: float, unit_m: float) -> dict[str, str]:
    """Add mesh, blend shapes and skeleton; return the shapes' names in the file by their own."""
    from pxr import Gf, Sdf, Tf, UsdGeom, UsdSkel, Vt

    def array3(values: NDArray[Any]) -> Any:
        return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values, np.float32))

    UsdGeom.SetStageMetersPerUnit(stage, unit_m)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    root = UsdSkel.Root.Define(stage, ROOT_PRIM)
    stage.SetDefaultPrim(root.GetPrim())
    mesh = UsdGeom.Mesh.Define(stage, f"{ROOT_PRIM}/Face")
    framed = material.mesh
    points = framed.vertices_mm * per_mm
    mesh.CreatePointsAttr(array3(points))
    counts = np.full(len(framed.faces), 3, np.int32)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(counts))
    flat = np.ascontiguousarray(framed.faces.reshape(-1), np.int32)
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(flat))
    mesh.CreateNormalsAttr(array3(framed.normals))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    extent = array3(np.stack([points.min(axis=0), points.max(axis=0)]))
    mesh.CreateExtentAttr(extent)
    root.CreateExtentAttr(extent)
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
        "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
    )
    st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(framed.uv, np.float32)))
    names = {name: Tf.MakeValidIdentifier(name) for name in material.shapes}
    if not names:
        return names
    skeleton = UsdSkel.Skeleton.Define(stage, f"{ROOT_PRIM}/Skeleton")
    skeleton.CreateJointsAttr(["root"])
    one = Vt.Matrix4dArray([Gf.Matrix4d(1.0)])
    skeleton.CreateBindTransformsAttr(one)
    skeleton.CreateRestTransformsAttr(one)
    rest = UsdSkel.Animation.Define(stage, f"{ROOT_PRIM}/Skeleton/Neutral")
    rest.CreateJointsAttr(["root"])
    rest.SetTransforms([Gf.Matrix4d(1.0)])
    rest.CreateBlendShapesAttr(list(names.values()))
    rest.CreateBlendShapeWeightsAttr([0.0] * len(names))
    bound = UsdSkel.BindingAPI.Apply(skeleton.GetPrim())
    bound.CreateAnimationSourceRel().SetTargets([rest.GetPath()])
    skinned = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    skinned.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    skinned.CreateJointIndicesPrimvar(True, 1).Set([0])
    skinned.CreateJointWeightsPrimvar(True, 1).Set([1.0])
    targets = []
    for name, moved in material.shapes.items():
        shape = UsdSkel.BlendShape.Define(stage, f"{ROOT_PRIM}/Face/{names[name]}")
        shape.CreateOffsetsAttr(array3(moved * per_mm))
        targets.append(shape.GetPath())
    skinned.CreateBlendShapesAttr(list(names.values()))
    skinned.CreateBlendShapeTargetsRel().SetTargets(targets)
    return names


def _materials(stage: Any, material: Material, radius: float, delivery: Delivery) -> None:
    from pxr import Sdf, UsdShade, Vt

    place = f"{ROOT_PRIM}/Materials/Skin"
    made = UsdShade.Material.Define(stage, place)
    told = material.sigma_tr()
    for key in ("sigma_tr_per_mm", "translucency_mm"):
        made.GetPrim().SetCustomDataByKey(key, Vt.DoubleArray(told[key]))
    made.GetPrim().SetCustomDataByKey("materialx", Sdf.AssetPath(f"./{materialx.MATERIALX_FILE}"))
    mesh = stage.GetPrimAtPath(f"{ROOT_PRIM}/Face")
    UsdShade.MaterialBindingAPI.Apply(mesh).Bind(made)
    preview = _preview(stage, place, material, delivery)
    made.CreateSurfaceOutput().ConnectToSource(preview.ConnectableAPI(), "surface")
    openpbr = _openpbr(stage, place, material, radius, delivery)
    made.CreateSurfaceOutput("mtlx").ConnectToSource(openpbr.ConnectableAPI(), "out")


def _place(delivery: Delivery, name: str, suffix: str) -> str:
    return f"{materialx.TEXTURE_FOLDER}/{delivery.referred(name, suffix)}"


def _texture(delivery: Delivery, name: str, suffix: str) -> Any:
    from pxr import Sdf

    return Sdf.AssetPath(f"./{_place(delivery, name, suffix)}")


def _preview(stage: Any, place: str, material: Material, delivery: Delivery) -> Any:
    from pxr import Gf, Sdf, UsdShade

    types = Sdf.ValueTypeNames
    reader = UsdShade.Shader.Define(stage, f"{place}/st")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    reader.CreateOutput("result", types.Float2)
    shader = UsdShade.Shader.Define(stage, f"{place}/Preview")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateOutput("surface", types.Token)
    shader.CreateInput("metallic", types.Float).Set(0.0)
    shader.CreateInput("ior", types.Float).Set(float(material.eta))
    y = delivery.y
    rows = (
        ("diffuseColor", types.Color3f, "base_color", "rgb", types.Float3, "sRGB"),
        ("roughness", types.Float, "specular_roughness", "r", types.Float, "raw"),
        ("normal", types.Normal3f, "normal", "rgb", types.Float3, "raw"),
    )
    for parameter, kind, texture, output, output_kind, space in rows:
        node = UsdShade.Shader.Define(stage, f"{place}/{texture}")
        node.CreateIdAttr("UsdUVTexture")
        node.CreateInput("file", types.Asset).Set(_texture(delivery, texture, "png"))
        node.CreateInput("sourceColorSpace", types.Token).Set(space)
        for axis in ("wrapS", "wrapT"):
            node.CreateInput(axis, types.Token).Set("clamp")
        node.CreateInput("st", types.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
        if parameter == "normal":
            node.CreateInput("scale", types.Float4).Set(Gf.Vec4f(2.0, 2.0 * y, 2.0, 1.0))
            node.CreateInput("bias", types.Float4).Set(Gf.Vec4f(-1.0, -y, -1.0, 0.0))
        node.CreateOutput(output, output_kind)
        shader.CreateInput(parameter, kind).ConnectToSource(node.ConnectableAPI(), output)
    return shader


def _openpbr(stage: Any, place: str, material: Material, radius: float, delivery: Delivery) -> Any:
    from pxr import Gf, Sdf, UsdShade

    types = Sdf.ValueTypeNames

    def image(name: str, kind: Any, definition: str, suffix: str = "exr") -> Any:
        node = UsdShade.Shader.Define(stage, f"{place}/mtlx_{name}")
        node.CreateIdAttr(definition)
        file = node.CreateInput("file", types.Asset)
        file.Set(_texture(delivery, name, suffix))
        if name == "base_color":
            file.GetAttr().SetColorSpace(materialx.LINEAR_SRGB_NAME)
        node.CreateOutput("out", kind)
        return node.ConnectableAPI()

    shader = UsdShade.Shader.Define(stage, f"{place}/OpenPBR")
    shader.CreateIdAttr("ND_open_pbr_surface_surfaceshader")
    shader.CreateOutput("out", types.Token)
    for name, value in (
        ("specular_ior", float(material.eta)),
        ("subsurface_weight", 1.0),
        ("subsurface_radius", radius),
        ("subsurface_scatter_anisotropy", 0.0),
    ):
        shader.CreateInput(name, types.Float).Set(float(value))
    color = image("base_color", types.Color3f, "ND_image_color3")
    for name in ("base_color", "subsurface_color"):
        shader.CreateInput(name, types.Color3f).ConnectToSource(color, "out")
    for name in ("specular_weight", "specular_roughness"):
        source = image(name, types.Float, "ND_image_float")
        shader.CreateInput(name, types.Float).ConnectToSource(source, "out")
    scale = image("subsurface_radius_scale", types.Color3f, "ND_image_color3")
    shader.CreateInput("subsurface_radius_scale", types.Color3f).ConnectToSource(scale, "out")
    codes = image("normal", types.Float3, "ND_image_vector3", "png")
    bump = UsdShade.Shader.Define(stage, f"{place}/mtlx_normalmap")
    bump.CreateIdAttr("ND_normalmap_vector2")
    bump.CreateInput("in", types.Float3).ConnectToSource(codes, "out")
    bump.CreateInput("scale", types.Float2).Set(Gf.Vec2f(1.0, delivery.y))
    bump.CreateOutput("out", types.Float3)
    shader.CreateInput("geometry_normal", types.Float3).ConnectToSource(
        bump.ConnectableAPI(), "out"
    )
    return shader
