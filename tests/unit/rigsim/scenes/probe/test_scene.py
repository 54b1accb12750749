"""From light in the fibers to raw frames of the fiber probe, against closed forms."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.stats import ncx2

from capture.rig import load_rig
from model import spectra
from rigsim.as_built.probe import SPOT_RADIUS_PX, ProbeBuildError, ProbeTolerances, build_probe
from rigsim.boxes.contact_probe.source_shutter import SourceLight
from rigsim.fiber.probe_tissue import HomogeneousTissue
from rigsim.scenes.exposing import SceneError
from rigsim.scenes.probe.detector import render_fiber_images
from rigsim.scenes.probe.scene import DARK_CURRENT_E_PER_S, PROBE_METER_RATE_PER_S, ProbeScene
from rigsim.world.suction import HeadState

RIG = load_rig("probe")
VIEW = RIG.views[0]
AIR = HeadState("", 0.0, False, 0.0, 5.0)
CHEEK = HeadState("cheek", 0.0, True, 60.0, 5.0)
NOMINAL = ProbeTolerances(
    gain=0.0,
    position_px=0.0,
    shift_px=0.0,
    rotation_deg=0.0,
    radius=0.0,
    crosstalk=0.0,
    wings=0.0,
    veil=0.0,
)
AREA_PX = math.pi * SPOT_RADIUS_PX**2
FALSE_ALARM = 4.0  # standard deviations: 6e-5 of normal values lie beyond


@pytest.fixture(scope="module")
def scene():
    return ProbeScene(RIG, HomogeneousTissue(0.04, 1.5), build=build_probe(RIG, seed=3), photons=1)


@pytest.fixture(scope="module")
def noiseless(scene):
    quiet = dataclasses.replace(
        scene.sensor(), prnu=0.0, dsnu_e=0.0, vignetting=0.0, dark_e_per_s=0.0, read_noise_e=0.0
    )
    build = dataclasses.replace(scene.build, ripple=0.0)
    return ProbeScene(RIG, scene.tissue, build=build, sensor=quiet, photons=1)


def lit(exposure_s, *, level=1.0, fiber=None):
    return [SourceLight(level, 0.0, exposure_s, fiber)]


def test_spot_center_reaches_eight_tenths_in_shortest_exposure():
    build = build_probe(RIG, seed=0, tolerances=NOMINAL)
    scene = ProbeScene(RIG, HomogeneousTissue(0.04, 1.5), build=build, photons=1)
    light = (
        scene.image(scene.transmit_through_fibers(np.full((28, 3), 2.0)))
        * 30.0
        * 2.0 ** (-22 * 2 / 3)
    )
    middle = light[64, 33]
    assert middle.max() == pytest.approx(0.8, rel=3e-3)  # samples of the flux
    white = spectra.camera_white(VIEW.spectral_sensitivity, RIG.lights[0].illuminant)
    np.testing.assert_allclose(middle / middle.max(), white, rtol=1e-5)


def test_spot_flux_is_its_area_at_any_position():
    ideal = dataclasses.replace(build_probe(RIG, seed=3), wings=0.0, veil=0.0)
    flux = render_fiber_images(ideal, VIEW).sum(axis=(1, 2), dtype=np.float64)
    np.testing.assert_allclose(flux, AREA_PX, rtol=1e-5)


@pytest.fixture(scope="module")
def even_ends():
    even = np.zeros((28, 3))
    return dataclasses.replace(build_probe(RIG, seed=3), wings=0.0, veil=0.0, unevenness=even)


def blurred_disc(build, fiber):
    """The exact image of a disc blurred by a Gaussian and by the pixels' width.

    A Gaussian around a pixel falls into the disc with the probability of a noncentral chi-square.
    """
    y, x = np.mgrid[: VIEW.height_px, : VIEW.width_px]
    square = (x - build.spot_px[fiber, 0]) ** 2 + (y - build.spot_px[fiber, 1]) ** 2
    variance = build.edge_px**2 + 1.0 / 12.0
    near = square < 20.0**2
    exact = np.zeros(near.shape)
    exact[near] = ncx2.cdf(build.radius_px[fiber] ** 2 / variance, 2, square[near] / variance)
    return exact * AREA_PX / exact.sum()


@pytest.mark.parametrize("fiber", [0, 9, 27])
def test_spot_is_disc_convolved_with_lens_and_pixel(even_ends, fiber):
    image = render_fiber_images(even_ends, VIEW)[fiber]

    def misfit(**change):
        exact = blurred_disc(dataclasses.replace(even_ends, **change), fiber)
        near = exact > 0.0
        return np.sqrt(np.mean((image - exact)[near] ** 2))

    assert misfit() < 3e-3
    assert misfit(edge_px=1.25) > 3e-3
    assert misfit(radius_px=1.005 * even_ends.radius_px) > 3e-3


def test_light_over_fiber_end_is_tilted_as_built(even_ends):
    tilted = dataclasses.replace(even_ends, unevenness=np.tile([0.1, -0.05, 0.08], (28, 1)))
    image, even = (render_fiber_images(build, VIEW)[9] for build in (tilted, even_ends))
    x, y = even_ends.spot_px[9].round().astype(int)
    u, v = (np.array([[x, y]]) - even_ends.spot_px[9])[0] / even_ends.radius_px[9]
    away = 6.0 / even_ends.radius_px[9]

    def light(u, v):
        return 1.0 + 0.1 * u - 0.05 * v + 0.08 * (2.0 * (u * u + v * v) - 1.0)

    for right, down in ((0, 0), (6, 0), (-6, 0), (0, 6), (0, -6)):
        expected = light(u + right / 6 * away, v + down / 6 * away)
        found = image[y + down, x + right] / even[y + down, x + right]
        assert found == pytest.approx(expected, abs=0.01)


def test_touching_spots_are_rendered_apart(even_ends):
    """A spot's image does not have light of a neighbor 10 pixels away."""
    near = np.array(even_ends.spot_px)
    near[10] = near[9] + [10.0, 0.0]
    close = render_fiber_images(dataclasses.replace(even_ends, spot_px=near), VIEW)
    np.testing.assert_allclose(close.sum(axis=(1, 2)), AREA_PX, rtol=1e-5)
    alone = render_fiber_images(even_ends, VIEW)
    assert np.abs(close[9] - alone[9]).max() < 0.02


def test_wings_and_veil_add_stated_light():
    build = dataclasses.replace(build_probe(RIG, seed=3), wings=0.0, veil=5e-5)
    image = render_fiber_images(build, VIEW)[4]
    assert image[0, 1000] == np.float32(5e-5)
    winged = dataclasses.replace(build, wings=0.01, veil=0.0)
    # the sensor holds all of the disc and the part of the wings that a wide strip catches
    flux = render_fiber_images(winged, VIEW)[14].sum(dtype=np.float64) / AREA_PX
    assert 0.997 < flux < 1.0
    place = build.spot_px[14].round().astype(int)
    near, far = render_fiber_images(winged, VIEW)[14][place[1], place[0] + np.array([150, 300])]
    assert near / far == pytest.approx(8.0, rel=0.05)


def test_spots_are_at_actual_positions_off_nominal(scene):
    images = render_fiber_images(
        dataclasses.replace(scene.build, wings=0.0, veil=0.0, unevenness=np.zeros((28, 3))), VIEW
    )
    y, x = np.mgrid[: VIEW.height_px, : VIEW.width_px]
    flux = images.sum(axis=(1, 2))
    found = np.stack([(images * x).sum(axis=(1, 2)), (images * y).sum(axis=(1, 2))], axis=1)
    np.testing.assert_allclose(found / flux[:, None], scene.build.spot_px, atol=0.015)
    nominal = np.array([fiber.spot_px for fiber in RIG.probe.fibers])
    off = np.linalg.norm(scene.build.spot_px - nominal, axis=1)
    assert 0.5 < off.mean() < 6.0


def test_frame_is_linear_in_light_up_to_rounding(noiseless):
    head = CHEEK
    light = noiseless.fiber_radiance(head)
    one, both = noiseless.image(light), noiseless.image(light + 2.0 * light[::-1])
    np.testing.assert_allclose(both, one + 2.0 * noiseless.image(light[::-1]), rtol=2e-4, atol=1e-9)
    half = [*lit(1.0, level=0.5), SourceLight(0.5, 1.0, 2.0, None)]
    rng_free = [noiseless.image(noiseless.fiber_radiance(head) * e) for e in (1.0, 0.5)]
    np.testing.assert_allclose(rng_free[0], 2.0 * rng_free[1], rtol=1e-6)
    frames = [
        noiseless.exposure("cam", pops=pops, exposure_s=2.0, seed=s, head=head)
        for pops, s in ((lit(1.0), 1), (half, 2))
    ]
    sums = [(frame.astype(float) - VIEW.black_level).sum() for frame in frames]
    noise = math.sqrt(2.0 * max(sums) / VIEW.gain_e_per_dn)
    assert abs(sums[0] - sums[1]) < FALSE_ALARM * noise


def test_reflectance_reaches_the_pixels_in_the_channels_ratio(noiseless):
    """The sum over a spot's pixels of each color is R_f times gain, white and unit image."""
    exposure_s = 0.008
    frame = noiseless.exposure(
        "cam", pops=lit(exposure_s), exposure_s=exposure_s, seed=5, head=CHEEK
    )
    reflectance = noiseless.profile(CHEEK).reflectance_per_mm2
    taken = noiseless.build.crosstalk @ (noiseless.build.gain[:, None] * reflectance)
    light = PROBE_METER_RATE_PER_S * exposure_s * taken * noiseless.white
    images = render_fiber_images(noiseless.build, VIEW)
    x, y = noiseless.build.spot_px[2].round().astype(int)
    box = np.s_[y - 16 : y + 16, x - 16 : x + 16]
    full = VIEW.white_level - VIEW.black_level
    assert frame[box].max() < VIEW.white_level
    for channel, cells in enumerate(([(0, 0)], [(0, 1), (1, 0)], [(1, 1)])):
        mask = np.zeros(frame.shape, bool)
        for row, column in cells:
            mask[row::2, column::2] = True
        mask = mask[box]
        expected = full * np.einsum("f,fyx->yx", light[:, channel], images[:, *box])[mask].sum()
        got = (frame[box].astype(float) - VIEW.black_level)[mask].sum()
        rounding = mask.sum() / 12.0
        sigma = math.sqrt(expected / VIEW.gain_e_per_dn + rounding)
        assert abs(got - expected) < FALSE_ALARM * sigma


def test_noise_is_that_of_electrons(scene):
    """Differences of equal frames, without the source's ripple, which is common to all pixels."""
    steady = ProbeScene(
        RIG, scene.tissue, photons=1, build=dataclasses.replace(scene.build, ripple=0.0)
    )
    first, second = (
        steady.exposure("cam", pops=lit(1.0), exposure_s=1.0, seed=s, head=CHEEK).astype(float)
        for s in (1, 2)
    )
    mean = 0.5 * (first + second) - VIEW.black_level
    inside = (mean > 100.0) & (mean < 3500.0)
    gain = VIEW.gain_e_per_dn
    expected = mean[inside] / gain + VIEW.read_noise_e**2 / gain**2 + 1.0 / 12.0
    ratio = 0.5 * (first - second)[inside] ** 2 / expected
    assert inside.sum() > 1000
    assert abs(ratio.mean() - 1.0) < FALSE_ALARM * math.sqrt(2.0 / inside.sum())


def test_dark_current_doubles_every_6_5_kelvin(scene):
    sensors = [scene.sensor(camera_c=c) for c in (5.0, 11.5, 18.0)]
    assert [s.dark_e_per_s / DARK_CURRENT_E_PER_S for s in sensors] == pytest.approx(
        [1.0, 2.0, 4.0]
    )
    cold, warm = (
        np.median(
            scene.exposure(
                "cam", pops=[], exposure_s=30.0, seed=1, head=dataclasses.replace(CHEEK, camera_c=c)
            ).astype(float),
            axis=None,
        )
        for c in (5.0, 31.0)
    )
    assert warm - cold == pytest.approx(
        DARK_CURRENT_E_PER_S * 30.0 * 15.0 / VIEW.gain_e_per_dn, rel=0.04
    )


def test_hot_pixels_keep_same_positions(scene):
    frames = [
        scene.exposure("cam", pops=[], exposure_s=30.0, seed=s, head=CHEEK).astype(float)
        for s in (1, 2)
    ]
    hot = [frame > np.median(frame) + 15.0 for frame in frames]
    assert 30 < hot[0].sum() < 400
    assert (hot[0] & hot[1]).sum() > 0.9 * hot[0].sum()


def test_covered_fibers_transmit_a_hundred_thousandth(scene):
    uncovered, masked = scene.fiber_radiance(CHEEK), scene.fiber_radiance(CHEEK, fiber=0)
    share = masked[:, 1] / uncovered[:, 1]
    assert share[0] == pytest.approx(1.0, rel=2e-3)
    leak = scene.build.crosstalk[1, 0] * scene.build.gain[0]
    reflectance = scene.profile(CHEEK).reflectance_per_mm2[:, 1]
    assert masked[1, 1] / (PROBE_METER_RATE_PER_S * scene.white[1]) == pytest.approx(
        leak * reflectance[0] + 1e-5 * scene.build.gain[1] * reflectance[1], rel=1e-3
    )


def test_head_in_air_receives_room_light_not_source(scene):
    lights = [
        scene.exposure("cam", pops=pops, exposure_s=1.0, seed=1, head=AIR).astype(float)
        for pops in (lit(1.0), [])
    ]
    assert (lights[0] == lights[1]).mean() > 0.2
    x, y = scene.build.spot_px[27].round().astype(int)
    middle = lights[1][y - 4 : y + 4, x - 4 : x + 4].mean() - VIEW.black_level
    assert middle > 50.0
    closed = scene.exposure("cam", pops=[], exposure_s=1.0, seed=1, head=CHEEK).astype(float)
    assert abs(closed[y - 4 : y + 4, x - 4 : x + 4].mean() - VIEW.black_level) < 5.0


def test_equal_seeds_give_equal_frames_whatever_came_before(scene):
    other = ProbeScene(RIG, scene.tissue, build=scene.build, photons=1)
    scene.exposure(
        "cam", pops=lit(0.1), exposure_s=0.1, seed=9, head=dataclasses.replace(CHEEK, site="chin")
    )
    frames = [
        s.exposure("cam", pops=lit(0.1), exposure_s=0.1, seed=4, head=CHEEK) for s in (scene, other)
    ]
    np.testing.assert_array_equal(*frames)
    again = scene.exposure("cam", pops=lit(0.1), exposure_s=0.1, seed=5, head=CHEEK)
    assert (frames[0] != again).any()


def test_invalid_exposure_requests_are_refused(scene):
    with pytest.raises(SceneError, match="view"):
        scene.exposure("left", pops=[], exposure_s=1.0, seed=0, head=CHEEK)
    with pytest.raises(SceneError, match="level"):
        scene.exposure("cam", pops=lit(1.0, level=1.5), exposure_s=1.0, seed=0, head=CHEEK)
    with pytest.raises(SceneError, match="end after its beginning"):
        scene.exposure(
            "cam", pops=[SourceLight(1.0, 1.0, 0.5, None)], exposure_s=1.0, seed=0, head=CHEEK
        )
    with pytest.raises(SceneError, match="fiber: got 28"):
        scene.exposure("cam", pops=lit(1.0, fiber=28), exposure_s=1.0, seed=0, head=CHEEK)
    with pytest.raises(SceneError, match="contact probe"):
        ProbeScene(load_rig("dome"), scene.tissue)
    with pytest.raises(ProbeBuildError, match="gain"):
        dataclasses.replace(scene.build, gain=np.zeros(28))
