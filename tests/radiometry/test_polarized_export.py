"""Exported scenes of the flash and the gradient rig, rendered by Mitsuba.

Rationale: a process that imports nothing of the project renders the stock scenes, another with the
project's plugins those with polarization. Expected: flash images are those of compiled formulas at
each camera hit, with the rig's polarizers, or for stock materials without polarization; gradient
images are those of the session's renderer, of which stock materials are independent. Tolerance: as
in `test_mitsuba_export`, fixed beforehand.
"""

import dataclasses
import shutil
from functools import cache

import numpy as np
import pytest
from exported_scenes import change_map, end_renderers, render, replace_in, sum_blocks, worst_z

from capture.session import Session
from model import spectra
from rigsim import shading
from rigsim.as_built.polarizers import absorbing_axis, draw_polarizers
from rigsim.as_built.sphere import PATTERN_WEIGHTS, build_sphere
from rigsim.geometry.atlas import dilate_texture, sample
from rigsim.light.observed_skin import ObservedSkin
from rigsim.light.subsurface_radiance import direction_and_falloff, inner_albedo
from rigsim.mitsuba.variant import choose_renderer
from rigsim.needs.effects import SceneEffects
from rigsim.population import files as subject_file
from rigsim.render import Caster, camera_rays, visibility
from rigsim.scenes.flash.scene import METERING_LEVEL, FlashScene
from rigsim.scenes.flash.surfaces import FastSurface, flash_lights
from rigsim.scenes.gradient.reference import NO_POLARIZERS
from rigsim.scenes.gradient.scene import GradientScene
from rigsim.tissue.skin_layers import ETA
from rigsim.world.taped_skin import GripState
from skinrig.exporting import export as exporting
from skinrig.simulating.gradient import make_scene
from skinrig.simulating.simulation import simulate_session
from skinrig.simulating.subject_records import COARSE_FACE_TEXELS

pytestmark = [pytest.mark.render, pytest.mark.long]

POLARIZERS = ("parallel", "crossed")
SEED = 3


@pytest.fixture(scope="module", autouse=True)
def ended_renderers():
    yield
    end_renderers()


# flash rig --------------------------------------------------------------------------------------


def make_export(tmp_path_factory, rig, **options):
    out = tmp_path_factory.mktemp(rig) / f"session-{rig}"
    simulate_session(rig, out, seed=SEED, subject="V", **options)
    exporting.export(out, out.parent / "scene", "mitsuba", use="research")
    return Session.open(out), out.parent / "scene"


@pytest.fixture(scope="module")
def flash(tmp_path_factory):
    return make_export(tmp_path_factory, "flash", width_px=96)


@pytest.fixture
def flash_folder(flash, tmp_path):
    return shutil.copytree(flash[1], tmp_path / "scene")


@pytest.fixture(scope="module")
def face():
    return subject_file.load_subject("V").face(seed=SEED, size=COARSE_FACE_TEXELS)


def skin_layers(session, face):
    """Return the textures of the face, continued beyond its charts."""
    rig, view = session.rig, session.rig.views[0]
    skin = ObservedSkin(face, "neutral", view.spectral_sensitivity, rig.lights[0].illuminant)
    layers = {"normals": face.normal, "roughness": face.roughness, "hair": face.hair}
    layers |= {"albedo": inner_albedo(face, skin.reflectance())}
    return {name: dilate_texture(layer, face.atlas.covered) for name, layer in layers.items()}


def flash_image(session, face, layers, subpixels, *, stock):
    """Return both images by the compiled formulas at each hit: S0 of a stock scene, or analyzed."""
    rig, view = session.rig, session.rig.views[0]
    films = NO_POLARIZERS if stock else draw_polarizers(rig)
    caster, flashes = Caster(face.mesh, choice=choose_renderer("fast")), flash_lights(rig, films)
    surface = FastSurface(caster, flashes)
    hits = surface.trace(view, subpixels, (0, view.height_px))
    everywhere = np.ones(hits.count, np.bool_)
    seen = {name: sample(layer, hits.uv, everywhere) for name, layer in layers.items()}
    normal = seen["normals"] / np.linalg.norm(seen["normals"], axis=1, keepdims=True)
    entered, shadows = np.zeros(hits.count), []
    for light, weight in zip(rig.lights, flashes.weights, strict=True):
        disc = {} if stock else {"radius_mm": light.radius_mm, "samples": 16}
        lit = visibility(caster, hits.position_mm, hits.traced[0], light.position_mm, **disc)
        to_light, falloff = direction_and_falloff(light, hits.position_mm)
        cosine = np.maximum(np.sum(normal * to_light, axis=1), 0.0)
        entered += (weight * falloff * cosine * lit) * shading.entry_transmittance(
            normal,
            to_light,
            eta=ETA,
            light_absorbs=absorbing_axis(light),
            extinction=films.light_extinction,
        )
        shadows.append(lit)
    leaving, facets = surface.skin_stokes(hits, view, seen | {"shadows": np.stack(shadows, 1)})
    matt = leaving[:, :, None] * (entered[:, None] * seen["albedo"])[:, None]
    images = {}
    for name in ("parallel", "crossed"):
        if stock:  # each of two polarizers transmits half
            light = 0.25 * matt[:, 0] + (0.5 * facets[:, :1] if name == "parallel" else 0.0)
        else:
            stokes = np.moveaxis(matt + facets[:, :, None], 1, 2)
            light = shading.apply_analyzer(
                stokes,
                np.repeat(hits.traced[1][:, None], 3, axis=1),
                passes_deg=films.analyzer_axis_deg(view, name, None),
                image_right=view.axes[0],
                image_up=view.axes[1],
                extinction=films.analyzer_extinction,
            )
        images[name] = 4.0 * hits.average(light) * hits.coverage()[..., None]
    return {name: image * white_rgb(session) for name, image in images.items()}


def white_rgb(session):
    """The white reference that faces the camera has `METERING_LEVEL` in its strongest channel."""
    view = session.rig.views[0]
    rgb = spectra.camera_white(view.spectral_sensitivity, session.rig.lights[0].illuminant)
    return METERING_LEVEL * rgb / rgb.max()


@pytest.fixture(scope="module")
def flash_sums(flash, face):
    """Block sums at the finest grid of rays with their deviation, by image and kind of scene."""
    found, layers = {}, skin_layers(flash[0], face)
    for kind in ("", "stock-"):
        grids = [flash_image(flash[0], face, layers, n, stock=bool(kind)) for n in (6, 7, 8)]
        for name in grids[0]:
            sums = [sum_blocks(grid[name]) for grid in grids]
            found[f"scene-{kind}{name}.xml"] = sums[-1], np.std(sums, axis=0, ddof=1)
    return found


FLASH_FILES = [f"scene-{kind}{name}.xml" for kind in ("", "stock-") for name in POLARIZERS]


def render_polarized(folder, file, light="all"):
    finest = {} if "stock" in file else {"subpixels": 8, "is_exact": True}
    return render(folder, light, 0, file, **finest)


@pytest.fixture(scope="module")
def flash_renders(flash):
    """Images of the exported scenes; each is rendered once."""
    return cache(lambda file: render_polarized(flash[1], file))


@pytest.mark.parametrize("file", FLASH_FILES)
def test_flash_scenes_have_the_compiled_image(flash_renders, flash_sums, file):
    worst, limit = worst_z(flash_sums[file], flash_renders(file))
    print(f"{file}: {worst:.2f} of {limit:.2f}")
    assert worst < limit


FLASH_DEFECTS = {
    "1 % paler": ("scene-crossed.xml", change_map("r_d", lambda m: np.float32(1.01) * m)),
    "3 % rougher": ("scene-parallel.xml", change_map("roughness", lambda m: np.float32(1.03) * m)),
    "analyzer turned by 5 degrees": (
        "scene-crossed.xml",
        replace_in("scene-crossed.xml", r'(name="analyzer_deg") value="[^"]*"', r'\1 value="5"'),
    ),
    "stock scene 1 % paler": (
        "scene-stock-crossed.xml",
        change_map("stock_diffuse", lambda m: np.float32(1.01) * m),
    ),
    "stock scene 5 % shinier": (
        "scene-stock-parallel.xml",
        change_map("stock_specular", lambda m: np.float32(1.05) * m),
    ),
}


@pytest.mark.parametrize("defect", list(FLASH_DEFECTS))
def test_defects_of_flash_scenes_are_detected(flash_folder, flash_sums, defect):
    file, edit = FLASH_DEFECTS[defect]
    edit(flash_folder)
    worst, limit = worst_z(flash_sums[file], render_polarized(flash_folder, file))
    print(f"{defect}: {worst:.2f} of {limit:.2f}")
    assert worst > limit


def test_flash_scenes_miss_the_session_little(flash, face, flash_renders):
    """Interreflection, lateral scattering and lens; stock scenes also polarization."""
    scene = FlashScene(flash[0].rig, face, seed=SEED, subpixels=6)
    for name in POLARIZERS:
        full = sum_blocks(scene.radiance(name))
        for file in (f"scene-{name}.xml", f"scene-stock-{name}.xml"):
            found = sum_blocks(flash_renders(file)).mean(axis=0)
            missed = np.sqrt(np.mean((found - full) ** 2)) / full.mean()
            print(f"{file}: {100 * missed:.1f} % of the mean")
            assert 0.001 < missed < 0.1


# gradient rig -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def gradient(tmp_path_factory):
    return make_export(tmp_path_factory, "gradient", width_px=64, steps=(0, 0))


@pytest.fixture
def gradient_folder(gradient, tmp_path):
    return shutil.copytree(gradient[1], tmp_path / "scene")


@pytest.fixture(scope="module")
def gradient_renders(gradient):
    """Images of the exported scenes; each is rendered once."""

    @cache
    def render_once(file, pattern="full"):
        return render(gradient[1], pattern, 0, file, is_exact="stock" not in file)

    return render_once


PLAIN_PATCH = {"lateral": False, "optics": False, "interreflections": False}
GRIP = GripState(0.0, 0, 8.0, 1.0, True, False)


def patch_light(session, subpixels=1, *, stock=False):
    """Return diffuse and specular Stokes vectors of each moment, (4, 3, H, W), of the session."""
    scene = make_scene(session.rig, subject="V", seed=SEED, plan=session.plan, without=PLAIN_PATCH)
    if stock:
        sphere = build_sphere(session.rig, seed=SEED)
        sphere = dataclasses.replace(sphere, radius_mm=np.full_like(sphere.radius_mm, 1e-3))
        effects = SceneEffects(**PLAIN_PATCH)
        about = {"films": NO_POLARIZERS, "motion": scene.motion, "effects": effects}
        scene = GradientScene(session.rig, scene.subject, sphere=sphere, seed=SEED, **about)
    margin = 40 * subpixels
    wide = scene.surface(GRIP, subpixels=subpixels, border_px=40)
    grid = {"margin": margin, "pitch_um": scene.lens.pixel_on_subject_um / subpixels}
    lighting = scene.lighting()
    total, direct = lighting.stokes(wide, **grid), lighting.direct.packed(wide, **grid)[:12]
    direct = np.where(wide.crop(margin).skin, direct, 0.0)
    side = session.rig.views[0].width_px
    shape = (4, 3, side, subpixels, side, subpixels)
    return [
        scene.unit * part.reshape(shape).mean(axis=(3, 5), dtype=np.float64)
        for part in (total - direct, direct)
    ]


@pytest.fixture(scope="module")
def session_stokes(gradient):
    return sum(patch_light(gradient[0]))


@pytest.mark.parametrize("name", POLARIZERS)
@pytest.mark.parametrize("pattern", ["full", "x", "-z"])
def test_gradient_scene_has_the_sessions_image(
    gradient, gradient_renders, session_stokes, name, pattern
):
    """Rationale: the plugins render the files, and `ledmoments` the session's own topography.
    Tolerance: 1e-3 of the mean at 99.9 % of pixels; rays at edges of triangles differ."""
    session, _ = gradient
    view, films = session.rig.views[0], draw_polarizers(session.rig)
    stokes = np.einsum("m,msij->ijs", PATTERN_WEIGHTS[pattern], session_stokes)
    to_camera = -camera_rays(view)[1]
    passes_deg = films.analyzer_axis_deg(view, name, None)
    axes = {"image_right": view.axes[0], "image_up": view.axes[1]}
    leak = {"extinction": films.analyzer_extinction}
    expected = shading.apply_analyzer(stokes, to_camera, passes_deg=passes_deg, **axes, **leak)
    image = gradient_renders(f"scene-{name}.xml", pattern)[0].mean(axis=-1)
    error = np.abs(image - expected) / expected.mean()
    print(f"{name} {pattern}: {np.quantile(error, 0.999):.1e}, worst {error.max():.1e}")
    assert np.quantile(error, 0.999) < 1e-3
    assert np.std(expected) > 0.02 * expected.mean()


@pytest.fixture(scope="module")
def patch_sums(gradient):
    """Block sums of stock scenes by the session's renderer, with deviations over three grids."""
    grids = [patch_light(gradient[0], n, stock=True) for n in (1, 2, 3)]
    found = {}
    for name, glossy in (("parallel", 0.5), ("crossed", 0.0)):
        images = [0.25 * matt[0, 0] + glossy * shiny[0, 0] for matt, shiny in grids]
        sums = [sum_blocks(np.repeat(image[..., None], 3, axis=2)) for image in images]
        found[name] = sums[-1], np.std(sums, axis=0, ddof=1)
    return found


@pytest.mark.parametrize("name", POLARIZERS)
def test_stock_gradient_scene_has_unpolarized_image(gradient_renders, patch_sums, name):
    worst, limit = worst_z(patch_sums[name], gradient_renders(f"scene-stock-{name}.xml"))
    print(f"{name}: {worst:.2f} of {limit:.2f}")
    assert worst < limit


@pytest.fixture(scope="module")
def patch_scene(gradient):
    session, _ = gradient
    return make_scene(session.rig, subject="V", seed=SEED, plan=session.plan)


@pytest.mark.parametrize("name", POLARIZERS)
def test_gradient_scenes_miss_the_sessions_contrast(gradient_renders, patch_scene, name):
    """Lateral scattering fills grooves; interreflection, diffraction, for stock polarization."""
    full = patch_scene.radiance(
        "full", grip=GRIP, analyzer_deg={"parallel": 0.0, "crossed": 90.0}[name]
    )
    for file in (f"scene-{name}.xml", f"scene-stock-{name}.xml"):
        found = gradient_renders(file).mean(axis=(0, 3))
        missed = np.sqrt(np.mean((found - full) ** 2)) / full.mean()
        print(f"{file}: {100 * missed:.1f} %, mean {100 * (found.mean() / full.mean() - 1):.1f} %")
        assert 0.001 < missed < 0.3


def test_swapped_gradient_scenes_are_detected(gradient_folder, gradient_renders, patch_sums):
    worst, limit = worst_z(patch_sums["parallel"], gradient_renders("scene-stock-crossed.xml"))
    assert worst > limit
    change_map("stock_diffuse", lambda m: np.float32(1.02) * m)(gradient_folder)
    worst, limit = worst_z(
        patch_sums["crossed"], render(gradient_folder, "full", 0, "scene-stock-crossed.xml")
    )
    print(f"2 % paler: {worst:.2f} of {limit:.2f}")
    assert worst > limit
