"""MaterialX text: valid by MaterialX itself, and right in lengths, color spaces and greens."""

import json
from xml.etree import ElementTree

import cv2
import numpy as np
import OpenEXR
import pytest

from skinrig.exporting.materials import materialx
from skinrig.exporting.materials.material import Material
from skinrig.exporting.materials.subsurface_radius import translucency_mm
from skinrig.exporting.options import ExportSettings

MM = {"m": 1e-3, "cm": 0.1, "mm": 1.0}


def read(path):
    with OpenEXR.File(str(path)) as file:
        channels = file.channels()
        return channels["RGB" if "RGB" in channels else "Y"].pixels.copy()


def surface_inputs(text):
    shader = ElementTree.fromstring(text).find("open_pbr_surface")
    return {entry.get("name"): dict(entry.attrib) for entry in shader}


@pytest.fixture(scope="module")
def material(simulated_face):
    return Material.of(simulated_face)


@pytest.fixture(params=list(MM))
def written(request, simulated_face, tmp_path):
    materialx.write(simulated_face, tmp_path, ExportSettings(unit=request.param))
    return request.param, tmp_path


def test_radius_in_scene_units_recovers_sigma_tr(written, material):
    unit, folder = written
    inputs = surface_inputs((folder / "skin.mtlx").read_text())
    radius = float(inputs["subsurface_radius"]["value"])
    share = read(folder / "textures/subsurface_radius_scale.exr")
    assert 0.0 <= share.min() < share.max() <= 1.0
    color = read(folder / "textures/base_color.exr")
    depth = translucency_mm(radius * share / MM[unit], color, material.deficit)
    np.testing.assert_allclose(
        depth[material.valid], material.translucency_mm[material.valid], rtol=2e-5
    )
    told = json.loads((folder / "material.json").read_text())
    assert (told["scene_unit"], told["mm_per_scene_unit"]) == (unit, pytest.approx(1 / MM[unit]))


def test_exported_obj_mesh_has_scene_unit(written, material):
    import trimesh

    unit, folder = written
    read_back = trimesh.load(folder / "skin.obj", force="mesh", process=False)
    np.testing.assert_allclose(
        read_back.bounds,
        [material.mesh.vertices_mm.min(0) * MM[unit], material.mesh.vertices_mm.max(0) * MM[unit]],
        rtol=1e-5,
        atol=1e-6,
    )


def test_materialx_validates_documents(simulated_face, tmp_path):
    mx = pytest.importorskip("MaterialX")
    from skinrig.exporting import maps

    for number, udim in enumerate(("none", "dot", "underscore")):
        folder = tmp_path / str(number)
        folder.mkdir()
        delivery = ExportSettings(udim=udim, normal_y="dx")
        materialx.write(simulated_face, folder, delivery)
        maps.write(simulated_face, folder, delivery)
        library = mx.createDocument()
        mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
        for name in ("skin.mtlx", "maps.mtlx"):
            document = mx.createDocument()
            mx.readFromXmlFile(document, str(folder / name))
            document.setDataLibrary(library)
            assert document.validate() == (True, "")
            for image in images_of(document):
                file = image.getInput("file").getAttribute("value").replace("<UDIM>", "1001")
                assert (folder / file).is_file(), file
        broken = (folder / "skin.mtlx").read_text().replace("base_color_out", "nowhere", 1)
        document = mx.createDocument()
        mx.readFromXmlString(document, broken)
        document.setDataLibrary(library)
        assert not document.validate()[0]


def images_of(document):
    graphs = [document.getNodeGraph(name) for name in ("NG_skin", "NG_maps")]
    return [node for graph in graphs if graph for node in graph.getNodes("image")]


def test_an_essl_shader_is_generated_from_the_material(simulated_face, tmp_path):
    mx = pytest.importorskip("MaterialX")
    gen = pytest.importorskip("MaterialX.PyMaterialXGenGlsl")
    shading = pytest.importorskip("MaterialX.PyMaterialXGenShader")
    materialx.write(simulated_face, tmp_path, ExportSettings())
    document = mx.createDocument()
    mx.readFromXmlFile(document, str(tmp_path / "skin.mtlx"))
    library = mx.createDocument()
    search = mx.getDefaultDataSearchPath()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), search, library)
    document.setDataLibrary(library)
    generator = gen.EsslShaderGenerator.create()
    context = shading.GenContext(generator)
    context.registerSourceCodeSearchPath(search)
    shader = generator.generate("skin", document.getNode("Skin"), context)
    assert "subsurface" in shader.getSourceCode("pixel")


@pytest.mark.parametrize(("normal_y", "sign"), [("gl", 1.0), ("dx", -1.0)])
def test_node_decodes_either_green_to_same_normals(
    simulated_face, material, tmp_path, normal_y, sign
):
    materialx.write(simulated_face, tmp_path, ExportSettings(normal_y=normal_y))
    codes = cv2.imread(str(tmp_path / "textures/normal.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    xyz = codes / 65535.0 * 2.0 - 1.0
    assert np.corrcoef(xyz[..., 1].ravel(), material.normals[..., 1].ravel())[0, 1] * sign > 0.999
    graph = ElementTree.fromstring((tmp_path / "skin.mtlx").read_text()).find("nodegraph")
    node = graph.find("normalmap")
    scale = next(e.get("value") for e in node if e.get("name") == "scale")
    x, y = (float(part) for part in scale.split(","))
    np.testing.assert_allclose(xyz * [x, y, 1.0], material.normals, atol=1.01 / 65535)


def test_color_is_linear_srgb_and_data_untagged(simulated_face, tmp_path):
    materialx.write(simulated_face, tmp_path, ExportSettings())
    graph = ElementTree.fromstring((tmp_path / "skin.mtlx").read_text()).find("nodegraph")
    spaces = {node.get("name"): node[0].get("colorspace") for node in graph.findall("image")}
    assert spaces == {
        "base_color": "lin_rec709",
        "subsurface_radius_scale": None,
        "specular_roughness": None,
        "specular_weight": None,
        "normal_codes": None,
    }


def test_base_color_is_model_subsurface_reflectance(simulated_face, material):
    """Even light: the mean over directions of R_d F_t(l) F_t(v) / pi, over 1 - F(v)."""
    from model import fresnel

    mu, weight = np.polynomial.legendre.leggauss(200)
    mu, weight = 0.5 * (mu + 1.0), 0.5 * weight
    through = 2.0 * np.sum(weight * mu * (1.0 - fresnel.reflectance(mu, 1.4)))
    r_d = simulated_face.maps["r_d"].values
    np.testing.assert_allclose(material.base_color, r_d * through, rtol=1e-4)


def test_errors_and_mask_are_exported_on_request(simulated_face, tmp_path):
    materialx.write(simulated_face, tmp_path, ExportSettings(with_errors=True, udim="underscore"))
    mask = read(tmp_path / "textures/mask_1001.exr")
    assert (mask[0, 0], mask[32, 32]) == (0.0, 1.0)
    stderr = read(tmp_path / "textures/translucency_stderr_1001.exr")
    np.testing.assert_allclose(stderr[mask > 0], 0.05, rtol=1e-5)
