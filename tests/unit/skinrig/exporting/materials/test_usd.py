"""OpenUSD read back by usd-core: geometry, blend shapes, both materials, units."""

import sys

import numpy as np
import pytest

from skinrig.errors import EXIT_EXTRA_MISSING, MissingExtra, exit_code
from skinrig.exporting.materials import usd
from skinrig.exporting.materials.material import Material
from skinrig.exporting.options import ExportSettings


@pytest.fixture(scope="module")
def material(simulated_face, shapes_file):
    return Material.of(simulated_face, shapes_file)


@pytest.fixture(scope="module")
def stage(simulated_face, shapes_file, tmp_path_factory):
    pxr = pytest.importorskip("pxr.Usd")
    out = tmp_path_factory.mktemp("usd")
    order = ExportSettings(mesh=shapes_file, unit="cm", normal_y="dx", udim="dot", with_errors=True)
    left_out = usd.write(simulated_face, out, order)
    assert ["blend shapes" in what for what, _ in left_out] == [False]
    return pxr.Stage.Open(str(out / "skin.usdc"))


def test_points_are_in_stated_unit_texture_v_upwards(stage, material):
    from pxr import UsdGeom

    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.01
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Skin/Face"))
    np.testing.assert_allclose(
        np.array(mesh.GetPointsAttr().Get()), material.mesh.vertices_mm * 0.1, atol=1e-6
    )
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get())
    assert len(indices) == 3 * len(mesh.GetFaceVertexCountsAttr().Get())
    assert np.array_equal(indices.reshape(-1, 3), material.mesh.faces)
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get()
    np.testing.assert_allclose(np.array(st), material.mesh.uv, atol=1e-7)


def test_blend_shapes_under_usd_skinning_match_mesh(stage, material):
    from pxr import Usd, UsdGeom, UsdSkel

    skeleton = UsdSkel.Animation(stage.GetPrimAtPath("/Skin/Skeleton/Neutral"))
    assert list(skeleton.GetBlendShapesAttr().Get()) == ["jawOpen", "smile_left"]
    skeleton.GetBlendShapeWeightsAttr().Set([1.0, 0.5])
    assert UsdSkel.BakeSkinning(UsdSkel.Root(stage.GetPrimAtPath("/Skin")))
    baked = UsdGeom.Mesh(stage.GetPrimAtPath("/Skin/Face")).GetPointsAttr()
    points = np.array(baked.Get(Usd.TimeCode.EarliestTime()))
    moved = material.mesh.vertices_mm + material.shapes["jawOpen"]
    moved = moved + 0.5 * material.shapes["smile left"]
    np.testing.assert_allclose(points, 0.1 * moved, atol=1e-5)


def test_preview_flips_directx_map_and_reads_srgb_color(stage):
    from pxr import UsdShade

    def node(name):
        return UsdShade.Shader(stage.GetPrimAtPath(f"/Skin/Materials/Skin/{name}"))

    normal = node("normal")
    assert tuple(normal.GetInput("scale").Get()) == (2.0, -2.0, 2.0, 1.0)
    assert tuple(normal.GetInput("bias").Get()) == (-1.0, 1.0, -1.0, 0.0)
    assert normal.GetInput("sourceColorSpace").Get() == "raw"
    assert node("base_color").GetInput("sourceColorSpace").Get() == "sRGB"
    assert node("base_color").GetInput("file").Get().path == "./textures/base_color.<UDIM>.png"
    assert node("Preview").GetInput("ior").Get() == pytest.approx(1.4)


def test_the_openpbr_network_uses_nodes_that_materialx_has(stage, material):
    mx = pytest.importorskip("MaterialX")
    from pxr import UsdShade

    library = mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    known = {definition.getName() for definition in library.getNodeDefs()}
    used = {
        shader.GetIdAttr().Get()
        for shader in map(UsdShade.Shader, stage.Traverse())
        if shader and shader.GetIdAttr().Get().startswith("ND_")
    }
    assert len(used) == 5
    assert used <= known
    shader = UsdShade.Shader(stage.GetPrimAtPath("/Skin/Materials/Skin/OpenPBR"))
    definition = library.getNodeDef("ND_open_pbr_surface_surfaceshader")
    assert {i.GetBaseName() for i in shader.GetInputs()} <= {
        i.getName() for i in definition.getInputs()
    }
    radius = shader.GetInput("subsurface_radius").Get()
    assert radius == pytest.approx(0.1 * material.radius_mm[material.covered].max(), rel=1e-6)


def test_usd_validators_report_only_missing_plugin_nodes(simulated_face, shapes_file, tmp_path):
    validation = pytest.importorskip("pxr.UsdValidation")
    from pxr import Usd

    usd.write(simulated_face, tmp_path, ExportSettings(mesh=shapes_file))
    stage = Usd.Stage.Open(str(tmp_path / "skin.usdc"))
    registry = validation.ValidationRegistry()
    errors = validation.ValidationContext(registry.GetOrLoadAllValidators()).Validate(stage)
    assert {error.GetName() for error in errors} <= {"MissingShaderIdInRegistry"}
    assert all("'ND_" in error.GetMessage() for error in errors)


def test_sigma_tr_is_in_the_materials_custom_data(stage, material):
    told = stage.GetPrimAtPath("/Skin/Materials/Skin").GetCustomDataByKey("sigma_tr_per_mm")
    depth = np.median(material.translucency_mm[material.valid], axis=0)
    np.testing.assert_allclose(np.array(told), 1.0 / depth, rtol=1e-6)


def test_missing_usd_names_extra_and_writes_nothing(simulated_face, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(MissingExtra, match=r"skinrig\[usd\]") as error:
        usd.write(simulated_face, tmp_path, ExportSettings())
    assert exit_code(error.value) == EXIT_EXTRA_MISSING
    assert list(tmp_path.iterdir()) == []
