"""Estimators mean the same whatever an array's layout, and one bad number spoils no others."""

import numpy as np
import pytest
from twins import sliding_histograms

from model.facial_color import deviation_ratio, histogram_matching
from reconstruction import photometric_stereo
from reconstruction.chromophores import model_error
from reconstruction.correspondence.expression_alignment import Alignment
from reconstruction.facial_color import perfusion_fit
from reconstruction.facial_color import registration_error as misplacement
from reconstruction.facial_color.perfusion_curves import CurveError
from reconstruction.photometric_stereo import half_vectors as half_vector_normals
from reconstruction.registration import affine_fit


def strided(array):
    wide = np.empty([2 * side for side in array.shape], array.dtype)
    view = wide[tuple(slice(None, None, 2) for _ in array.shape)]
    view[...] = array
    return view


def read_only(array):
    kept = array.copy()
    kept.flags.writeable = False
    return kept


LAYOUTS = {
    "Fortran": np.asfortranarray,
    "strided": strided,
    "read-only": read_only,
    "reversed": lambda array: array[::-1].copy()[::-1],
    "of the other byte order": lambda array: array.astype(array.dtype.newbyteorder()),
}


def lit(layout, rng):
    lights = rng.normal(size=(9, 3)) * [0.4, 0.4, 0.1] + [0, 0, 1]
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    normal = np.array([0.1, -0.2, 0.97])
    seen = 0.5 * (lights @ normal)[:, None, None] * np.linspace(0.5, 1.0, 12).reshape(3, 4)
    near = {
        "light_positions_mm": layout(500.0 * lights),
        "points_mm": layout(rng.normal(size=(3, 4, 3))),
    }
    far = photometric_stereo.estimate_normals(layout(seen), layout(lights), robust=True)
    close = photometric_stereo.estimate_normals(layout(seen), layout(lights), **near)
    return far.normals, far.stderr_rad, close.normals


def halfway(layout, rng):
    lights = rng.normal(size=(2, 12, 3)) * 0.3 + [0, 0, 1]
    lights /= np.linalg.norm(lights, axis=-1, keepdims=True)
    out = np.broadcast_to([0.0, 0.0, 1.0], lights.shape).copy()
    values = lights[..., 2] ** 20
    found = half_vector_normals.estimate(
        layout(values), layout(lights), layout(out), np.repeat([0, 1, 2], 4)
    )
    return found.normals, found.stderr_rad


def matched(layout, rng):
    neutral, target = rng.random((2, 24, 20))
    return (
        histogram_matching.match(layout(neutral), layout(target), 4.0).hemoglobin,
        sliding_histograms.match_sliding(layout(neutral), layout(target), 3.0).hemoglobin,
    )


@pytest.mark.long
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("made", [lit, halfway, matched])
def test_the_layout_of_an_array_changes_nothing(made, layout):
    plain = made(np.ascontiguousarray, np.random.default_rng(3))
    found = made(LAYOUTS[layout], np.random.default_rng(3))
    for one, other in zip(found, plain, strict=True):
        # byte orders that are not the machine's are computed in float32
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)


def test_half_precision_is_computed_in_single(rng):
    lights = rng.normal(size=(2, 12, 3)) * 0.3 + [0, 0, 1]
    lights /= np.linalg.norm(lights, axis=-1, keepdims=True)
    out = np.broadcast_to([0.0, 0.0, 1.0], lights.shape)
    view = np.repeat([0, 1, 2], 4)
    values = (lights[..., 2] ** 20).astype(np.float16)
    half = half_vector_normals.estimate(values, lights, out, view)
    single = half_vector_normals.estimate(values.astype(np.float32), lights, out, view)
    assert half.normals.dtype == np.float32
    np.testing.assert_array_equal(half.normals, single.normals)


@pytest.fixture
def skin(rng):
    return 0.3 + 0.02 * rng.random((40, 40, 3))


@pytest.mark.parametrize(("color", "noise"), [(None, np.nan), (None, np.inf), (5e-324, None)])
def test_pixel_with_nan_noise_keeps_other_errors(skin, color, noise):
    variance, valid = np.full(skin.shape, 1e-5), np.ones(skin.shape[:2], bool)
    without = valid.copy()
    without[20, 20] = False
    wanted = model_error.image_covariance(skin, variance, without)
    rgb, told = skin.copy(), variance.copy()
    rgb[20, 20, 1] = rgb[20, 20, 1] if color is None else color
    told[20, 20, 1] = told[20, 20, 1] if noise is None else noise
    found = model_error.image_covariance(rgb, told, valid)
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("noise", [np.nan, np.inf])
def test_pixel_with_nan_noise_keeps_other_misplacements(skin, noise):
    rows, columns = np.indices(skin.shape[:2])
    place = np.stack([columns, rows], axis=-1).astype(np.float32)
    off, there = np.full(skin.shape[:2], 0.2, np.float32), np.ones(skin.shape[:2], bool)
    laid = Alignment(place, there, off, off, there, 0.0, {}, 0.0, "landmarks", off.shape)
    variance = np.full(skin.shape, 1e-5)
    without = there.copy()
    without[20, 20] = False
    wanted = misplacement.registration_covariance(skin, variance, without, laid)
    variance[20, 20, 1] = noise
    found = misplacement.registration_covariance(skin, variance, there, laid)
    np.testing.assert_array_equal(found, wanted)
    assert (found[20, 20] == 0.0).all()
    assert found[10, 10, 0, 0] > 0.0


def test_nan_positions_are_refused_by_name(rng):
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), -1).reshape(-1, 2)
    for place in range(2):
        given = [grid.copy(), grid + 0.1 * rng.normal(size=grid.shape)]
        given[place][3, 1] = np.nan
        with pytest.raises(ValueError, match="points_px, found"):
            affine_fit.fit_affine(*given, window_px=1.0)


def cycle():
    phase = np.arange(20) * 0.5
    true = np.where(phase < 5, 1 - np.exp(-phase / 2), np.exp(-(phase - 5) / 2))
    return phase, 0.03 + 0.01 * true


def test_a_sample_without_a_time_is_left_out():
    phase, blood = cycle()
    whole = perfusion_fit.fit_cycle(np.delete(phase, 7), np.delete(blood, 7), cycle_s=10.0)
    for missing in (np.nan, np.inf):
        phase[7] = missing
        found = perfusion_fit.fit_cycle(phase, blood, cycle_s=10.0)
        assert found.known == whole.known == "estimated"
        assert found.time_constant_s == pytest.approx(whole.time_constant_s, rel=0.02)
        course = perfusion_fit.fit_course(phase, blood)
        assert np.isfinite(course.start).all()


@pytest.mark.parametrize(("cycle_s", "change_s"), [(0.0, None), (np.nan, None), (10.0, 10.0)])
def test_cycle_without_both_changes_is_refused_by_name(cycle_s, change_s):
    with pytest.raises(CurveError, match=r"c(ycle|hange)_s"):
        perfusion_fit.fit_cycle(*cycle(), cycle_s=cycle_s, change_s=change_s)


@pytest.mark.parametrize("part", [0, 1, 2])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_nan_position_gets_ratio_of_others(rng, part, bad):
    given = [1.5 * rng.random(30), rng.random(30), np.full(30, 1e-4)]
    held = np.ones(30, bool)
    without = held.copy()
    without[4] = False
    wanted = deviation_ratio.estimate_ratio(*given, without)
    given[part][4] = bad
    found = deviation_ratio.estimate_ratio(*given, held)
    assert np.isfinite(found.value).all()
    assert found.prior == wanted.prior
    np.testing.assert_array_equal(found.value, wanted.value)
    np.testing.assert_array_equal(found.stderr, wanted.stderr)
