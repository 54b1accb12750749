"""Lens, horizons, moments and resolved detail of the gradient rig."""

import dataclasses
import math

import numpy as np
import pytest

from capture.rig import load_rig
from rigsim.as_built.sphere import SphereError, build_sphere, nominal_sphere
from rigsim.light.lobe_moments import (
    MicrofacetSurface,
    MomentError,
    lattice_ripple,
    sum_led_moments,
    tabulate_moments,
)
from rigsim.light.relief_shadow import HorizonError, horizon_tangent
from rigsim.render.lens_blur import BlurError, Lens, blur_images, focused_lens
from rigsim.scenes.gradient.resolution import slope_transfer
from rigsim.scenes.gradient.scene import GradientScene
from rigsim.skin_patch.motion import PatchMotion, shift_image
from rigsim.targets.glass_ball import draw_ball_center_mm


@pytest.fixture(scope="module")
def rig():
    return load_rig("gradient")


@pytest.fixture(scope="module")
def sphere(rig):
    return nominal_sphere(rig)


def surface(rig, alpha):
    view = rig.views[0]
    return MicrofacetSurface(alpha, 1.4, view.position_mm, view.axes[0], 3000.0)


@pytest.fixture(scope="module")
def lens(rig):
    return focused_lens(rig.views[0], "LED-B3")


def one_wavelength(lens, wavelength_nm=550.0):
    return dataclasses.replace(lens, wavelengths_nm=(wavelength_nm,), weights=(1.0,))


# lens ---------------------------------------------------------------------------------------------


def test_a_circle_in_focus_has_the_closed_form(lens):
    """(2 / pi) (acos s - s sqrt(1 - s^2)) of the frequency over the cutoff."""
    green = one_wavelength(lens)
    cutoff = 1e3 / green.cutoff_period_um
    s = np.linspace(0.0, 1.2, 49)
    inside = np.minimum(s, 1.0)
    expected = 2.0 / math.pi * (np.arccos(inside) - inside * np.sqrt(1.0 - inside**2))
    np.testing.assert_allclose(green.otf(s * cutoff), expected, atol=1e-4)


def test_defocus_follows_stokseth_s_limit_of_geometry(lens):
    """Far out of focus the OTF is that of an even disc, 2 J1(x) / x, at low frequencies."""
    from scipy.special import j1

    green = one_wavelength(lens)
    depth_mm = 12.0
    diameter_mm = depth_mm * green.magnification / green.working_f_number
    f = np.linspace(0.2, 2.5, 20)
    x = math.pi * diameter_mm * f
    np.testing.assert_allclose(green.otf(f, depth_mm=depth_mm), 2.0 * j1(x) / x, atol=0.03)
    assert green.otf(f, depth_mm=0.0).min() > 0.9


@pytest.mark.parametrize("subpixels", [1, 2, 3])
def test_blurred_waves_keep_phase_with_otf_amplitude(lens, subpixels):
    side, period_px = 96, 8.0
    x = (np.arange(side * subpixels) + 0.5) / subpixels - 0.5
    phase = 2.0 * math.pi / period_px
    wave = np.broadcast_to(1.0 + 0.5 * np.cos(phase * x), (side * subpixels,) * 2)
    seen = blur_images(wave[None].astype(np.float32), lens, subpixels=subpixels)[0]
    f = 1e3 / (period_px * lens.pixel_on_subject_um)
    left = float(lens.otf(f)) * np.sinc(1.0 / period_px)
    expected = 1.0 + 0.5 * left * np.cos(phase * np.arange(side))
    np.testing.assert_allclose(seen[side // 2, 16:-16], expected[16:-16], atol=2e-3)


def test_depth_slices_match_single_depth(lens, rng):
    """A step of 0.5 mm: far from it each side is blurred as if it were alone."""
    image = rng.random((1, 96, 96), np.float32)
    depth = np.where(np.arange(96) < 48, 0.0, 0.5).astype(np.float32) * np.ones((96, 1), np.float32)
    both = blur_images(image, lens, depth_mm=depth)[0]
    near = blur_images(image, lens, depth_mm=np.zeros((96, 96), np.float32))[0]
    far = blur_images(image, lens, depth_mm=np.full((96, 96), 0.5, np.float32))[0]
    assert np.abs(both[:, :36] - near[:, :36]).max() < 2e-3
    assert np.abs(both[:, 60:] - far[:, 60:]).max() < 2e-3
    assert np.abs(near - far).max() > 5e-3


def test_invalid_lens_is_refused(lens):
    with pytest.raises(BlurError, match="weights"):
        Lens(30.0, 300.0, 0.9, 5.5, (550.0,), (0.5,))
    with pytest.raises(BlurError, match="images"):
        blur_images(np.zeros((1, 9, 9), np.float32), lens, subpixels=2)
    with pytest.raises(BlurError, match="depth_mm"):
        blur_images(
            np.zeros((1, 9, 9), np.float32), lens, depth_mm=np.full((9, 9), np.nan, np.float32)
        )


@pytest.mark.long
def test_slope_transfer_matches_lens_and_pixel_mtf(lens):
    """The whole chain is linear in small slopes, so it is the OTF; tolerance 0.02."""
    periods = [60.0, 30.0, 20.0]
    found = slope_transfer(periods)
    f = 1e3 / np.array(periods)
    expected = lens.otf(f) * np.sinc(f * 1e-3 * lens.pixel_on_subject_um)
    np.testing.assert_allclose(found, expected, atol=0.02)


@pytest.mark.long
def test_ten_micrometers_are_not_resolved(lens):
    """Features of 10 um, waves of 20 um, keep a twentieth; below 15 um nothing is left."""
    assert 17.0 < lens.cutoff_period_um < 19.0
    twenty, fourteen = slope_transfer([20.0, 14.0])
    assert twenty < 0.07
    assert fourteen < 0.005
    assert np.sinc(6.0 / 20.0) > 0.8  # the pixels alone would show them


# horizons -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("azimuth_deg", [0.0, 90.0, 180.0, 270.0, 33.0, 141.0, 250.0])
def test_wall_horizon_is_height_over_distance(azimuth_deg):
    """A disc of 40 um stands in the middle; seen from 0.2 mm off, against the light."""
    pixel_um = 5.0
    y, x = np.mgrid[60:-61:-1, -60:61] * pixel_um
    height = np.where(np.hypot(x, y) <= 60.0, 40.0, 0.0).astype(np.float32)
    tangent = horizon_tangent(height, pixel_um=pixel_um, azimuth_rad=math.radians(azimuth_deg))
    back = np.radians(azimuth_deg) + np.pi
    column = round(60 + 200.0 / pixel_um * math.cos(back))
    row = round(60 - 200.0 / pixel_um * math.sin(back))
    distance = math.hypot(x[row, column], y[row, column]) - 60.0
    assert tangent[row, column] == pytest.approx(40.0 / distance, rel=0.05)
    # nothing is hidden on the disc and on the side of the light
    assert tangent[60, 60] == 0.0
    assert tangent[120 - row, 120 - column] == 0.0


@pytest.mark.parametrize("azimuth_deg", [0.0, 45.0, 90.0, 200.0, 290.0])
def test_horizons_of_hills_are_those_of_marching_rays(rng, azimuth_deg):
    """Against a march of quarter pixels; a line is at most half a pixel off, so 0.02 rms."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    height = gaussian_filter(rng.standard_normal((90, 110)), 6.0, mode="wrap") * 250.0
    height = height.astype(np.float32)
    angle = math.radians(azimuth_deg)
    found = horizon_tangent(height, pixel_um=6.0, azimuth_rad=angle)
    y, x = np.mgrid[0:90, 0:110].astype(float)
    best = np.zeros(height.shape)
    for step in np.arange(1.0, 140.0, 0.25):
        column, row = x + step * math.cos(angle), y - step * math.sin(angle)
        inside = (column > -1e-6) & (column < 109 + 1e-6) & (row > -1e-6) & (row < 89 + 1e-6)
        level = map_coordinates(height, [row, column], order=1, mode="nearest")
        best = np.where(inside, np.maximum(best, (level - height) / (6.0 * step)), best)
    assert best.std() > 0.1
    assert np.sqrt(np.mean((found - best) ** 2)) < 0.02


def test_level_ground_has_zero_horizon_invalid_input_refused():
    flat = np.zeros((8, 8), np.float32)
    assert not horizon_tangent(flat, pixel_um=6.0, azimuth_rad=0.3).any()
    with pytest.raises(HorizonError, match="height_um"):
        horizon_tangent(np.full((8, 8), np.nan, np.float32), pixel_um=6.0, azimuth_rad=0.0)


# moments ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("alpha", "size", "most"),
    [(0.25, 65, 0.002), pytest.param(0.15, 129, 0.003, marks=pytest.mark.long)],
)
def test_tables_match_sums_over_leds(rig, sphere, rng, alpha, size, most):
    """RMS over normals of 14 degrees of tilt, over the mean of moment 1, in the whole field."""
    count = 600
    slopes = rng.normal(0.0, 0.25, (count, 2))
    normals = np.column_stack([-slopes, np.ones(count)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    x, y = rng.uniform(-6.0, 6.0, (2, count)).astype(np.float32)
    look = surface(rig, alpha)
    table = tabulate_moments(sphere, look, half_field_mm=6.2, size=size)
    direct = sum_led_moments(normals, np.column_stack([x, y, 0 * x]), sphere, look).packed()
    held = table.covers(normals.astype(np.float32))
    assert held.mean() > 0.99
    found = table.lookup(normals.astype(np.float32), x, y)
    error = np.sqrt(np.mean((found - direct)[held] ** 2, axis=0))
    assert error[:12].max() < most * direct[:, 0].mean()
    assert error[12:].max() < 1e-3 * direct[:, 12].mean()
    coarse = tabulate_moments(sphere, look, half_field_mm=6.2, size=17, fields=2)
    rough = np.sqrt(np.mean((coarse.lookup(normals, x, y) - direct)[held] ** 2, axis=0))
    assert rough[0] > 2.0 * error[0]


def test_roughness_between_the_table_s_nodes_is_interpolated(rig, sphere, rng):
    normals = np.array([[0.1, -0.2, 0.97468]], np.float32)
    zero = np.zeros(1, np.float32)
    table = tabulate_moments(
        sphere, surface(rig, 0.25), half_field_mm=1.0, alpha_range=(0.22, 0.28), size=65, fields=2
    )
    for alpha in (0.22, 0.235, 0.26, 0.28):
        direct = sum_led_moments(normals, np.zeros(3), sphere, surface(rig, alpha)).packed()
        found = table.lookup(normals, zero, zero, np.array([alpha], np.float32))
        np.testing.assert_allclose(found, direct, rtol=1e-3, atol=0.003 * direct[0, 0])


def test_the_leds_lattice_shows_in_narrow_lobes_only(rig, sphere):
    """About 2 % at roughness 0.2, three times as much at half of it."""
    assert lattice_ripple(sphere, surface(rig, 0.2)) < 0.02
    assert lattice_ripple(sphere, surface(rig, 0.1)) > 0.05


def test_tables_without_nodes_are_refused(rig, sphere):
    with pytest.raises(MomentError, match="size"):
        tabulate_moments(sphere, surface(rig, 0.25), half_field_mm=1.0, size=4)
    with pytest.raises(MomentError, match="half_field_mm"):
        tabulate_moments(sphere, surface(rig, 0.25), half_field_mm=0.0)


# sphere, motion, ball -----------------------------------------------------------------------------


def test_actual_sphere_is_near_but_never_equals_nominal(rig, sphere):
    built = build_sphere(rig, seed=5, dead=("G007",), weak=("G008",))
    off = built.position_mm - sphere.position_mm
    assert 0.8 < off.std() < 1.2
    alive = np.delete(built.intensity, [7, 8])
    assert 0.035 < np.log(alive).std() < 0.065
    turn = np.degrees(np.arccos(np.abs(np.sum(built.absorbs * sphere.absorbs, axis=1)).clip(0, 1)))
    assert 0.3 < turn.mean() < 2.0
    assert built.dead == ("G007",)
    assert built.intensity[8] < 0.5
    again = build_sphere(rig.subset(lights=["G003", "G009"]), seed=5)
    np.testing.assert_array_equal(again.position_mm, built.position_mm[[3, 9]])
    with pytest.raises(SphereError, match="position_mm"):
        dataclasses.replace(built, position_mm=built.position_mm[:5])


def test_shifts_of_blurred_image_are_within_one_percent():
    y, x = np.mgrid[0:48, 0:48].astype(float)

    def scene(x, y):
        return 1.0 + 0.5 * np.cos(2 * np.pi * (x + 0.3 * y) / 5.0)

    image = scene(x, y).astype(np.float32)
    moved = shift_image(image, (0.006 * 1.4, -0.006 * 0.7), pixel_um=6.0, border_px=8)
    expected = scene(x - 1.4, y - 0.7)[8:-8, 8:-8]
    assert np.abs(moved - expected).max() < 0.01
    assert np.abs(image[8:-8, 8:-8] - expected).max() > 0.3


def test_poses_and_drift_depend_on_seed_and_state():
    one, same, other = PatchMotion(1), PatchMotion(1), PatchMotion(2)
    assert one.pose(45.0, 2) == same.pose(45.0, 2)
    assert one.pose(45.0, 2) != one.pose(45.0, 3)
    assert one.pose(45.0, 2) != other.pose(45.0, 2)
    times = np.arange(0.0, 60.0, 0.25)
    drift = 1e3 * np.array([one.drift_mm(t) for t in times])
    assert 0.7 < drift.std() < 1.3


def test_ball_shows_leds_at_mirror_reflection_positions(rig):
    """Spots' middles of light against half-vectors, from the middle of the pupil; 0.3 px."""
    from scipy.ndimage import center_of_mass, label

    from rigsim.targets.mirror_ball import reflection_point

    small = rig.cropped(512)
    scene = GradientScene(small, "ball", seed=2)
    image = scene.radiance("full")
    spots, count = label(image > 0.05 * image.max())
    found = np.array(center_of_mass(image, spots, range(1, count + 1)))[:, ::-1]
    eye, center = np.array(small.views[0].position_mm), draw_ball_center_mm(2)
    expected = []
    for place in scene.sphere.position_mm:
        point = reflection_point(eye, place, center, 6.0)
        seen = (eye + eye[2] / (eye[2] - point[2]) * (point - eye))[:2] / 0.006
        expected.append([255.5 + seen[0], 255.5 - seen[1]])
    expected = np.array(expected)
    inner = expected[(np.abs(expected - 255.5) < 235).all(axis=1)]
    assert len(inner) >= 6
    distance = np.linalg.norm(found[None] - inner[:, None], axis=2).min(axis=1)
    assert distance.max() < 0.3


def test_crossed_polarizers_dim_ball_thousandfold_not_to_zero(rig):
    scene = GradientScene(rig.cropped(256), "ball")
    parallel, crossed = (scene.radiance("full", analyzer_deg=a) for a in (0.0, 90.0))
    assert 1e-4 < crossed.max() / parallel.max() < 5e-3


def test_led_weights_scale_ball_image(rig):
    """The spot of a LED that gives half is half as bright, a dead one's is gone."""
    scene = GradientScene(rig.cropped(256), "ball")
    full = scene.radiance("full")
    shares = tuple(0.5 for _ in rig.lights)
    np.testing.assert_allclose(scene.radiance("full", led_shares=shares), 0.5 * full, rtol=1e-5)
    none = tuple(0.0 for _ in rig.lights)
    assert not scene.radiance("full", led_shares=none).any()
