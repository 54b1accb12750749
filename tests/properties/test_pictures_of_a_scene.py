"""Steps on pictures and surfaces over all that their inputs may be: no scene is needed for them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model import texture_resampling
from reconstruction import registration
from reconstruction.correspondence import common_parameterization
from reconstruction.gradient_normals import channels as gradient_channels
from reconstruction.gradient_normals.noise import SensorNoise
from reconstruction.normal_integration import discontinuities as discontinuity_integration
from reconstruction.normal_integration import lens_restoration
from reconstruction.photometric_stereo import estimate_normals
from reconstruction.registration import dense_flow
from reconstruction.surface import errors as surface_errors
from reconstruction.wrinkles import texels as wrinkle_texels

CHEAP = settings(derandomize=True, deadline=None, max_examples=20, database=None)
FEW = settings(CHEAP, max_examples=8)
SEED = st.integers(0, 9999)
SIDES = st.tuples(st.integers(1, 9), st.integers(1, 9))
NO_NUMBER = st.sampled_from([np.nan, np.inf, -np.inf])


def unit_normals(rng, shape, spread=0.3):
    n = np.concatenate([spread * rng.standard_normal((*shape, 2)), np.ones((*shape, 1))], axis=-1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


# pictures of several channels


@CHEAP
@given(seed=SEED, sides=SIDES, channels=st.integers(1, 4), bad=NO_NUMBER)
def test_channels_are_summed_where_all_are_known(seed, sides, channels, bad):
    rng = np.random.default_rng(seed)
    images = {key: rng.random((*sides, channels)) for key in ("x", "y")}
    images["x"].flat[0] = bad
    kept = images["x"].copy()
    valid = rng.random((*sides, channels)) < 0.8
    variance = rng.random((*sides, channels))
    samples = gradient_channels.PatternSamples(images, variance, valid, 0.95)
    assert samples.channels == channels
    flat = gradient_channels.PatternSamples({"x": np.zeros(sides)}, None, None, None)
    assert flat.channels is None
    whole = samples.sum_channels()
    found, noise = whole.patterns, whole.variance
    np.testing.assert_array_equal(images["x"], kept)
    for key, image in images.items():
        with np.errstate(invalid="ignore"):
            known = valid.all(axis=-1) & ~(image >= 0.95).any(axis=-1)
        np.testing.assert_array_equal(found[key][known], image.sum(axis=-1)[known])
        assert np.isnan(found[key][~known]).all()
    np.testing.assert_allclose(noise, variance.sum(axis=-1))
    noisy = gradient_channels.PatternSamples(images, SensorNoise(2.0, 3.0), None, None)
    sensor = noisy.sum_channels().variance
    assert sensor.read_variance == 3.0 * channels


@FEW
@given(seed=SEED, sides=SIDES, channels=st.integers(1, 3))
def test_channel_maps_are_separated_again(seed, sides, channels):
    rng = np.random.default_rng(seed)
    lights = unit_normals(rng, (5,))
    maps = [estimate_normals(rng.random((5, *sides)), lights) for _ in range(channels)]
    whole = gradient_channels.stack_channels(maps)
    for k, one in enumerate(maps):
        np.testing.assert_array_equal(whole.normals[..., k, :], one.normals)
        of_all = gradient_channels.PatternSamples({"albedo": whole.albedo}, None, None, None)
        albedo = of_all.channel(k).patterns["albedo"]
        np.testing.assert_array_equal(albedo, one.albedo)


# the lens


@FEW
@given(seed=SEED, spread=st.floats(0.0, 2.0), smooth=st.floats(0.0, 2.0), bad=NO_NUMBER)
def test_restored_normals_are_unit_and_ignore_invalid_input(seed, spread, smooth, bad):
    rng = np.random.default_rng(seed)
    normals, valid = unit_normals(rng, (21, 17), spread), rng.random((21, 17)) < 0.9
    lens = lens_restoration.Aperture(18.0, 6.0)
    first = lens_restoration.restore_normals(normals, lens=lens, valid=valid, smooth_px=smooth)
    np.testing.assert_allclose(np.linalg.norm(first.normals, axis=-1), 1.0, atol=1e-9)
    assert (first.normals[~valid] == (0.0, 0.0, 1.0)).all()
    assert 0.0 <= first.kept_noise <= lens_restoration.MAX_GAIN * first.noise * (1 + 1e-9)
    spoilt = np.where(valid[..., None], normals, bad)
    again = lens_restoration.restore_normals(spoilt, lens=lens, valid=valid, smooth_px=smooth)
    np.testing.assert_array_equal(again.normals, first.normals)
    spoilt = normals.copy()
    spoilt[10, 8, 0] = bad  # a valid normal that is none counts as not valid
    without = valid.copy()
    without[10, 8] = False
    one = lens_restoration.restore_normals(spoilt, lens=lens, valid=valid, smooth_px=smooth)
    other = lens_restoration.restore_normals(normals, lens=lens, valid=without, smooth_px=smooth)
    np.testing.assert_array_equal(one.normals, other.normals)


@CHEAP
@given(seed=SEED, sides=SIDES, factor=st.floats(-1e6, 1e6))
def test_waves_are_filtered_linearly_and_all_preserve_image(seed, sides, factor):
    rng = np.random.default_rng(seed)
    sides = tuple(side + 31 for side in sides)
    values = rng.standard_normal(sides)
    transfer = rng.random([side + 2 * lens_restoration.PAD_PX for side in sides])
    one = lens_restoration.filter_by_transfer(values, transfer)
    np.testing.assert_allclose(
        lens_restoration.filter_by_transfer(factor * values, transfer),
        factor * one,
        atol=1e-12 * max(1.0, abs(factor)),
    )
    np.testing.assert_allclose(
        lens_restoration.filter_by_transfer(values, np.ones_like(transfer)), values, atol=1e-12
    )


# pictures that are laid over each other


@CHEAP
@given(seed=SEED, sides=SIDES, unit=st.sampled_from([1e-40, 0.25, 4.0, 1e40, 1e300]), bad=NO_NUMBER)
def test_local_contrast_is_unit_invariant_and_ignores_nan(seed, sides, unit, bad):
    rng = np.random.default_rng(seed)
    image = rng.random([side + 15 for side in sides])
    plain = registration.normalize_local_contrast(image)
    scaled = registration.normalize_local_contrast(unit * image).astype(int)
    assert np.abs(scaled - plain).max() <= 1
    holed, dark = image.copy(), image.copy()
    holed[3, 4], dark[3, 4] = bad, 0.0
    np.testing.assert_array_equal(
        registration.normalize_local_contrast(holed), registration.normalize_local_contrast(dark)
    )
    with pytest.raises(registration.RegistrationError):
        registration.normalize_local_contrast(image[:15])


@FEW
@given(seed=SEED, count=st.integers(0, 30), bad=NO_NUMBER)
def test_points_are_chosen_once_per_cell_track_themselves(seed, count, bad):
    rng = np.random.default_rng(seed)
    even = registration.normalize_local_contrast(rng.random((64, 72)))
    points = rng.uniform(-5.0, 80.0, (60, 2))
    points[7, 0] = bad
    chosen = registration.select_textured_points(even, points, count=count)
    assert len(chosen) <= count
    assert len(set(chosen.tolist())) == len(chosen)
    inside = points[chosen]
    assert ((inside >= 12) & (inside <= [72 - 13, 64 - 13])).all()
    followed = registration.track_points(even, even, inside)
    assert followed.valid.all()
    np.testing.assert_allclose(followed.points_px, inside, atol=0.05)


@FEW
@given(seed=SEED, error=st.floats(0.0, 5.0))
def test_dense_flow_maps_image_onto_itself(seed, error):
    rng = np.random.default_rng(seed)
    even = registration.normalize_local_contrast(rng.random((40, 48)))
    here, there = dense_flow.pixel_grid(even.shape), np.ones(even.shape, bool)
    np.testing.assert_array_equal(dense_flow.sample_image(even, here), even)
    valid = rng.random(even.shape) < 0.95
    found = dense_flow.refine_flow(
        even, even, here, np.full(even.shape, error), valid=valid, valid_second=there
    )
    assert np.isfinite(found.source_px).all()
    assert (found.stderr_px > 0.0).all()
    assert not found.followed[~valid].any()
    away = np.linalg.norm(found.source_px - here, axis=-1)
    assert away[found.followed].max(initial=0.0) <= 0.2


# surfaces


@CHEAP
@given(
    seed=SEED,
    unit=st.sampled_from([1e-100, 1e-3, 1e3, 1e100]),
    rings=st.integers(0, 3),
    bad=NO_NUMBER,
)
def test_surface_gradient_scales_with_values_and_ignores_invalid(seed, unit, rings, bad):
    rng = np.random.default_rng(seed)
    points, values = rng.random((12, 3)), rng.standard_normal((12, 2))
    faces = rng.integers(0, 12, (15, 3))
    valid = rng.random(12) < 0.8
    told = {"pixel_mm": 0.1, "rings": rings}
    first = surface_errors.change_per_mm(values, points, faces, valid, **told)
    assert (first >= 0.0).all()
    scaled = surface_errors.change_per_mm(unit * values, points, faces, valid, **told)
    np.testing.assert_allclose(scaled, unit * first, rtol=1e-9)
    spoilt = np.where(valid[:, None], values, bad)
    again = surface_errors.change_per_mm(spoilt, points, faces, valid, **told)
    np.testing.assert_array_equal(again, first)
    noisy = surface_errors.change_per_mm(values, points, faces, valid, noise=np.abs(values), **told)
    assert (noisy <= first * (1 + 1e-12)).all()


@CHEAP
@given(seed=SEED, sides=SIDES, bad=NO_NUMBER)
def test_derivative_texels_omit_invalid_values(seed, sides, bad):
    rng = np.random.default_rng(seed)
    sides = tuple(side + 1 for side in sides)
    normals, valid = unit_normals(rng, sides), rng.random(sides) < 0.8
    stderr = rng.uniform(0.0, 0.1, sides)
    first = wrinkle_texels.measure_derivatives(normals, stderr_rad=stderr, valid=valid)
    assert not first.valid[~valid].any()
    spoilt = np.where(valid[..., None], normals, bad)
    again = wrinkle_texels.measure_derivatives(spoilt, stderr_rad=stderr, valid=valid)
    np.testing.assert_array_equal(again.values, first.values)
    np.testing.assert_array_equal(again.variance, first.variance)


@CHEAP
@given(seed=SEED, sides=SIDES, level=st.floats(-10.0, 10.0))
def test_uniform_derivatives_give_uniform_texels_gathering_is_transpose(seed, sides, level):
    rng = np.random.default_rng(seed)
    sides = tuple(side + 1 for side in sides)
    shape = tuple(int(rng.integers(1, side + 1)) for side in sides)
    weight = rng.uniform(0.5, 1.0, sides)
    even = np.repeat((weight * level)[..., None], 2, axis=-1)
    found = wrinkle_texels.fit_texels(weight, even, 0.0 * even, np.ones(sides), shape)
    assert found.valid.all()
    np.testing.assert_allclose(found.values, level, atol=1e-3 * max(1.0, abs(level)))
    by, bx = (texture_resampling.reading_matrix(t, p) for t, p in zip(shape, sides, strict=True))
    texels, image = rng.standard_normal(shape), rng.standard_normal(sides)
    read = by @ texels @ bx.T
    gathered = wrinkle_texels.gather_texels(by, bx, image)
    assert float((read * image).sum()) == pytest.approx(float((texels * gathered).sum()), abs=1e-9)
    matrix = wrinkle_texels.normal_matrix(by, bx, weight, shape)
    np.testing.assert_allclose(
        (matrix @ texels.ravel()).reshape(shape),
        wrinkle_texels.gather_texels(by, bx, weight * read),
        atol=1e-9,
    )


@FEW
@given(seed=SEED, sides=SIDES, slope=st.tuples(*[st.floats(-2.0, 2.0)] * 2), bad=NO_NUMBER)
def test_plane_has_no_jump_invalid_values_are_unread(seed, sides, slope, bad):
    rng = np.random.default_rng(seed)
    sides = tuple(side + 1 for side in sides)
    normals = np.broadcast_to([-slope[0], -slope[1], 1.0], (*sides, 3)).copy()
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    found = discontinuity_integration.integrate_with_discontinuities(normals)
    y, x = np.mgrid[: sides[0], : sides[1]]
    plane = slope[0] * x - slope[1] * y
    np.testing.assert_allclose(found.height, plane - plane.mean(), atol=1e-2)
    valid = rng.random(sides) < 0.9
    valid[0, 0] = True
    first = discontinuity_integration.integrate_with_discontinuities(normals, valid=valid)
    spoilt = np.where(valid[..., None], normals, bad)
    again = discontinuity_integration.integrate_with_discontinuities(spoilt, valid=valid)
    np.testing.assert_array_equal(again.height, first.height)


@FEW
@given(seed=SEED, faces=st.integers(1, 4), size=st.floats(0.5, 2.0))
def test_landmarks_common_to_faces_are_centered_on_nose(seed, faces, size):
    rng = np.random.default_rng(seed)
    names = [
        "nose tip",
        "left eye",
        "right eye",
        "chin",
        "left mouth",
        "right mouth",
        "brow",
        "left ear",
        "right ear",
        "lip",
    ]
    places = rng.normal(size=(10, 3)) * [30, 30, 5]
    places[0] = 0.0
    given_faces = [dict(zip(names, map(tuple, places), strict=True)) for _ in range(faces)]
    given_faces[0]["of one alone"] = (1.0, 2.0, 3.0)
    found, where = common_parameterization.average_landmarks(given_faces)
    assert set(found) == set(names) | ({"of one alone"} if faces == 1 else set())
    assert (where[found.index("nose tip")] == 0.0).all()
    assert np.isfinite(where).all()
    with pytest.raises(common_parameterization.ParameterizationError, match="nose tip"):
        common_parameterization.average_landmarks([{"chin": (0.0, 0.0, 0.0)}])
