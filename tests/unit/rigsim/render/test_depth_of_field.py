"""A lens's blur by depth against rays through all of its pupil, Airy's pattern and energy."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.special import j1

from capture.rig import Rig, load_rig
from rigsim.light.olat import pixel_order
from rigsim.mitsuba.variant import VariantChoice
from rigsim.needs import face as face_needs
from rigsim.needs.effects import PixelNoise, SceneEffects
from rigsim.render.caster import Caster
from rigsim.render.depth_of_field import (
    DefocusKernels,
    LensImage,
    depth_before_focus,
    tabulate_defocus,
    tabulate_lens_defocus,
)
from rigsim.render.lens_blur import BlurError, focused_lens
from rigsim.render.lens_kernels import MOSAIC_LIGHTS
from rigsim.render.rays import GBuffer, camera_rays, g_buffer, trace
from rigsim.scenes.flash.scene import FlashScene
from rigsim.sensor import apply_cfa, filter_channels
from rigsim.subject.person import make_subject

EMBREE = VariantChoice("scalar_rgb", "asked for by the test", "")
K = 2
NEAR_MM, FAR_MM = 25.0, -85.0


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("flash").resized(128)


@pytest.fixture(scope="module")
def caster():
    return Caster(make_subject("II", seed=0, size=64).mesh, choice=EMBREE)


def planes(spread: DefocusKernels, depth_mm: np.ndarray) -> LensImage:
    """Return a picture of what stands at depths given for each sample, NaN for nothing."""
    order, pixel, first, slot = pixel_order(np.isfinite(depth_mm), K)
    shape = (depth_mm.shape[0] // K, depth_mm.shape[1] // K)
    toward = depth_mm.reshape(-1)[order].astype(np.float32)
    return LensImage(spread, shape, pixel, first, slot, toward)


def see(spread: DefocusKernels, depth_mm: np.ndarray, light: np.ndarray) -> np.ndarray:
    order = pixel_order(np.isfinite(depth_mm), K)[0]
    rows = np.ascontiguousarray(light.reshape(-1, 1)[order], np.float32)
    return planes(spread, depth_mm).render(rows)[..., 0]


def wide_open(rig: Rig, f_number: float) -> DefocusKernels:
    view = dataclasses.replace(rig.views[0], f_number=f_number)
    return tabulate_defocus(view, "D55", subpixels=K, depths_mm=[FAR_MM, NEAR_MM])


@pytest.mark.parametrize("depth_mm", [0.0, 25.0, -85.0])
def test_fully_visible_plate_keeps_light_at_any_depth(rig, depth_mm):
    spread = wide_open(rig, 2.0)
    depth = np.full((60, 60), np.nan)
    depth[20:40, 20:40] = depth_mm
    picture = see(spread, depth, np.ones((60, 60)))
    assert picture.sum() == pytest.approx(100.0, rel=1e-5)
    assert picture[15, 15] == pytest.approx(1.0, abs=1e-5)


def test_black_pixel_brightens_with_defocus_of_surroundings(rig):
    spread = wide_open(rig, 4.0)
    hole = np.ones((40, 40))
    hole[20:22, 20:22] = 0.0
    dark = [see(spread, np.full((40, 40), d), hole)[10, 10] for d in (0.0, 12.0, -40.0, -85.0)]
    assert (np.diff(dark) > 0.01).all()


def test_center_of_focused_image_is_airy_disk(rig):
    """Ratio of what a point sends to its own pixel and to the next, by integrating Airy's pattern.

    The table is renormalized to what the picture holds, which ratios do not see. The sample's
    square has a 32nd of the pixel's side, the integral 64 x 64 nodes: 1 % together.
    """
    view = dataclasses.replace(rig.views[0], f_number=64.0)
    lens = dataclasses.replace(focused_lens(view, "D55"), wavelengths_nm=(550.0,), weights=(1.0,))
    k = 31
    spread = tabulate_lens_defocus(lens, subpixels=k, depths_mm=[0.0])
    wide, middle = 2 * spread.radius + 1, k * k // 2
    table = spread.table[0, :, middle].reshape(wide, wide)[::-1, ::-1]
    x = (np.arange(64) + 0.5) / 64 - 0.5
    pixels = lens.pixel_on_subject_um / lens.cutoff_period_um

    def airy(dx: float) -> float:
        r = np.maximum(np.hypot(x[:, None], x + dx) * math.pi * pixels, 1e-9)
        return float(((2.0 * j1(r) / r) ** 2).mean())

    row = table[spread.radius, spread.radius :]
    assert row[1] / row[0] == pytest.approx(airy(1.0) / airy(0.0), rel=0.01)


def by_rays(caster, view, shade, *, points: int, k: int) -> np.ndarray:
    """Return what a thin lens sees: the mean over its pupil of sharp pictures, focused alike."""
    way = camera_rays(view, subpixels=k)[1]
    right, up, back = (np.asarray(axis) for axis in view.axes)
    eye = np.asarray(view.position_mm)
    focus = eye + way * (view.focus_distance_mm / -(way @ back))[..., None]
    pupil_mm = 0.5 * view.focal_mm / (1 + view.focal_mm / view.distance_mm) / view.f_number
    total = np.zeros((view.height_px, view.width_px))
    for n in range(points):
        radius, angle = pupil_mm * math.sqrt((n + 0.5) / points), n * math.pi * (3 - 5**0.5)
        at = eye + radius * (math.cos(angle) * right + math.sin(angle) * up)
        rays = focus - at
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        start = np.broadcast_to(at.astype(np.float32), rays.shape)
        light = shade(trace(caster, start, rays.astype(np.float32)))
        total += light.reshape(view.height_px, k, view.width_px, k).mean(axis=(1, 3)) / points
    return total


def patterned(buffers: GBuffer) -> np.ndarray:
    x, y = buffers.position_mm[..., 0], buffers.position_mm[..., 1]
    light = (1.2 + np.sin(0.5 * x) * np.sin(0.6 * y)) * np.clip(buffers.normal[..., 2], 0.1, 1.0)
    return np.where(buffers.mask, light, 0.0)


@pytest.mark.long
@pytest.mark.parametrize("f_number", [2.0, 1.4])
def test_defocused_face_matches_rays_through_whole_pupil(rig, caster, f_number):
    """RMS over the face, and where blur shows, against 40 x 16 rays a pixel.

    Diffraction is small there. Both have 16 samples a pixel, since coarse sampling is an error
    without a lens too; 0.4 of the sharp picture's error is the bound, which that fails by far.
    """
    k = 4
    view = dataclasses.replace(rig.views[0], f_number=f_number)
    buffers = g_buffer(caster, view, subpixels=k)
    order, pixel, first, slot = pixel_order(buffers.mask, k)
    toward = depth_before_focus(view, buffers.position_mm.reshape(-1, 3)[order])
    spread = tabulate_defocus(view, "D55", subpixels=k, depths_mm=[toward.min(), toward.max()])
    lens = LensImage(spread, (view.height_px, view.width_px), pixel, first, slot, toward)
    light = patterned(buffers)
    mine = lens.render(light.reshape(-1, 1)[order].astype(np.float32))[..., 0]
    sharp = light.reshape(view.height_px, k, view.width_px, k).mean(axis=(1, 3))
    truth = by_rays(caster, view, patterned, points=40, k=k)
    assert mine.sum() == pytest.approx(sharp.sum(), rel=1e-3)
    edge = (truth > 0) & (sharp != 0) & (np.abs(sharp - truth) > 0.05)
    for part in (truth > 0, edge):
        error, blur = (float(np.sqrt(np.mean((p - truth)[part] ** 2))) for p in (mine, sharp))
        assert error < 0.4 * blur


def test_an_evenly_bright_face_stays_evenly_bright_inside(rig, caster):
    view = dataclasses.replace(rig.views[0], f_number=2.0)
    buffers = g_buffer(caster, view, subpixels=K)
    depth = depth_before_focus(view, buffers.position_mm.reshape(-1, 3)).reshape(buffers.mask.shape)
    spread = wide_open(rig, 2.0)
    ones = see(spread, np.where(buffers.mask, depth, np.nan), np.ones(buffers.mask.shape))
    cover = buffers.mask.reshape(view.height_px, K, view.width_px, K).mean(axis=(1, 3))
    r = spread.radius
    around = np.lib.stride_tricks.sliding_window_view(cover, (2 * r + 1, 2 * r + 1))
    inside = around.min(axis=(2, 3)) == 1.0
    np.testing.assert_allclose(ones[r:-r, r:-r][inside], 1.0, atol=1e-4)
    assert ones.max() < 1.05


def test_focused_foreground_hides_bright_blurred_background(rig):
    """A black sheet in focus covers the left half of a white wall far behind."""
    spread = wide_open(rig, 2.0)
    depth = np.full((40, 60), -85.0)
    depth[:, :30] = 0.0
    light = (depth < -1.0).astype(float)
    picture = see(spread, depth, light)
    middle = picture[10]
    r = spread.radius
    assert middle[: 15 - 1].max() < 0.02  # but for diffraction
    assert middle[15 + 1] > 0.9  # the hidden wall is as bright as the seen one
    np.testing.assert_allclose(middle[15 + r :], 1.0, atol=1e-3)
    bare = spread.table[spread.slices(-85.0)].reshape(2 * r + 1, 2 * r + 1, -1).sum(axis=(0, 2))
    assert bare[: r + 1 - 1].sum() > 0.1  # spreading alone would have let this much through


def test_blurred_foreground_covers_area_of_its_blur_circle(rig):
    """The same wall in focus, the sheet before it: light at the edge follows the sheet's blur."""
    spread = wide_open(rig, 1.4)
    depth = np.zeros((40, 60))
    depth[:, :30] = NEAR_MM
    picture = see(spread, depth, (depth < 1.0).astype(float))[10]
    r = spread.radius
    alone = np.full((40, 60), np.nan)
    alone[:, :30] = NEAR_MM
    sheet = see(spread, alone, np.ones((40, 60)))[10]
    np.testing.assert_allclose(picture[15 - r : 15 + r], 1.0 - sheet[15 - r : 15 + r], atol=0.02)
    assert 0.02 < picture[14] < 0.5


def test_scene_blurs_as_needed_and_truth_stays_sharp(rig):
    face = make_subject("II", seed=0, size=64)
    plain = SceneEffects(lateral=False, interreflections=False)
    blurred = FlashScene(rig, face, effects=plain, choice=EMBREE)
    bare = dataclasses.replace(plain, optics=False)
    sharp = FlashScene(rig, face, effects=bare, choice=EMBREE)
    assert blurred.needs[face_needs.LENS_EFFECT].verdict == "built"
    assert sharp.needs[face_needs.LENS_EFFECT].verdict == "asked"
    change = np.abs(blurred.radiance() - sharp.radiance())
    sigma = PixelNoise.of(blurred.sensor()).sigma(blurred.radiance())
    over = float((change / sigma).max())
    told = blurred.needs[face_needs.LENS_EFFECT].over_noise or 0.0
    assert 1.0 < over <= told
    one, two = blurred.truth(), sharp.truth()
    for name in ("melanin", "reflectance", "shading", "normals"):
        np.testing.assert_array_equal(one[name], two[name])
    assert (one["mask"] <= two["mask"]).all()
    assert one["mask"].sum() > 0.9 * two["mask"].sum()


def test_small_holes_and_noisy_sensors_need_no_lens(rig):
    face = make_subject("II", seed=0, size=64)
    view = dataclasses.replace(rig.views[0], f_number=90.0, full_well_e=30.0, read_noise_e=300.0)
    poor = dataclasses.replace(rig, views=(view,))
    needs = FlashScene(
        poor, face, choice=EMBREE, effects=SceneEffects(lateral=False, interreflections=False)
    ).needs
    assert needs[face_needs.LENS_EFFECT].verdict == "negligible"


def test_depths_behind_the_camera_are_refused(rig):
    with pytest.raises(BlurError, match="depths_mm"):
        tabulate_defocus(rig.views[0], "D55", subpixels=2, depths_mm=[0.0, 1000.0])
    with pytest.raises(BlurError, match="subpixels"):
        tabulate_defocus(rig.views[0], "D55", subpixels=0, depths_mm=[0.0])


def test_focus_is_at_target_unless_view_overrides(rig):
    cam = rig.views[0]
    nearer = dataclasses.replace(cam, focus_mm=cam.distance_mm - 25.0)
    tip = np.array([[0.0, 0.0, 25.0]], np.float32)
    assert depth_before_focus(cam, tip)[0] == pytest.approx(25.0, abs=1e-3)
    assert depth_before_focus(nearer, tip)[0] == pytest.approx(0.0, abs=1e-3)


def test_mosaics_have_channels_of_each_image(rig):
    """Bit for bit, at an edge in depth, with pixels that lack samples, and an odd size."""
    rng = np.random.default_rng(4)
    depth = np.where(np.arange(46) < 20, NEAR_MM, FAR_MM) * np.ones((38, 1))
    depth[rng.random(depth.shape) < 0.1] = np.nan
    order = pixel_order(np.isfinite(depth), K)[0]
    light = rng.random((3, len(order), MOSAIC_LIGHTS), np.float32)
    lens = planes(wide_open(rig, 2.0), depth)
    images = [lens.render(light[..., k].T) for k in range(MOSAIC_LIGHTS)]
    for cfa in ("RGGB", "GBRG"):
        mosaics = lens.render_mosaics(light, filter_channels(cfa))
        for k, image in enumerate(images):
            assert np.array_equal(mosaics[..., k], apply_cfa(image, cfa))
        one = lens.render_mosaics(light[..., 3:4], filter_channels(cfa))
        assert np.array_equal(one, mosaics[..., 3:4])
    assert not np.array_equal(mosaics[..., 0], apply_cfa(images[0], "RGGB"))


def test_mosaics_without_samples_are_dark(rig):
    lens = planes(wide_open(rig, 2.0), np.full((8, 8), np.nan))
    dark = np.zeros((3, 0, MOSAIC_LIGHTS), np.float32)
    assert not lens.render_mosaics(dark, filter_channels("RGGB")).any()
    with pytest.raises(BlurError, match="light: got 2"):
        lens.render_mosaics(dark[..., :2], filter_channels("RGGB"))


def test_weights_of_plain_sum_agree_with_kernel(rig):
    """Far from gaps in depth, a pixel is the sum of table times samples around it."""
    spread = wide_open(rig, 4.0)
    light = np.random.default_rng(5).random((40, 40))
    seen = see(spread, np.full((40, 40), FAR_MM), light)
    own = spread.table[spread.slices(FAR_MM)]
    wide = 2 * spread.radius + 1
    weights = own.reshape(wide, wide, K, K).transpose(0, 2, 1, 3).reshape(wide * K, wide * K)
    top = K * (10 - spread.radius)
    window = light[top : top + wide * K, top : top + wide * K]
    assert seen[10, 10] == pytest.approx(float((weights * window).sum()), rel=1e-5)
