"""The chromophore fit: exact without noise, efficient with it, silent about what it cannot see."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from twins import chromophores as chromophore_reference

from model import color_table
from model.tissue_optics import PAPER_CONSTANTS
from model.tissue_optics.layers import ANISOTROPY_SKIN, C_HD_MAX, C_M_MAX
from reconstruction.chromophores.inversion import ChromophoreError, compute_identifiability, invert
from reconstruction.chromophores.model_error import DEFAULT_RELATIVE_NOISE

CAMERA = "Nikon 5100 (NPL)"
MODES = [None, "known"]


@pytest.fixture(scope="module")
def table():
    return color_table.build(
        CAMERA,
        "xenon flash",
        anisotropy=ANISOTROPY_SKIN,
        constants=PAPER_CONSTANTS,
        exact_optics=True,
    )


def grid_of_skin(size, lowest=0.001):
    """Return volume fractions evenly spaced in their cube roots over Table 1's ranges."""
    c_m = np.linspace(np.cbrt(lowest), np.cbrt(0.999 * C_M_MAX), size) ** 3
    c_hd = np.linspace(np.cbrt(lowest), np.cbrt(0.999 * C_HD_MAX), size) ** 3
    return np.broadcast_arrays(c_m[:, None], c_hd[None, :])


def weights_of(variance_relative, free):
    """Return the inverse covariance of independent relative errors, gray projected out."""
    weights = np.eye(3) / np.asarray(variance_relative)[..., None]
    if free:
        row = weights.sum(axis=-1)
        weights = weights - row[..., :, None] * row[..., None, :] / row.sum(-1)[..., None, None]
    return weights


@pytest.mark.long
@pytest.mark.parametrize("light", ["xenon flash", "D65", "A"])
@pytest.mark.parametrize("shading", MODES)
def test_round_trip_is_exact_where_skin_is_determined(shading, light):
    table = color_table.build(
        CAMERA, light, anisotropy=ANISOTROPY_SKIN, constants=PAPER_CONSTANTS, exact_optics=True
    )
    c_m, c_hd = grid_of_skin(160)
    maps = invert(table.lookup(c_m, c_hd), table, shading=shading)
    told = maps.valid & maps.identifiable  # standard errors below 100 % at 1 % noise
    assert told.mean() > (0.3 if shading is None else 0.6)
    np.testing.assert_allclose(maps.melanin[told], c_m[told], rtol=1e-3)
    np.testing.assert_allclose(maps.hemoglobin[told], c_hd[told], rtol=1e-3)
    np.testing.assert_allclose(maps.shading[told], 1.0, rtol=2e-3)


@pytest.mark.parametrize("shading", MODES)
def test_single_precision_color_rounding_is_below_standard_error(shading, table, rng):
    c_m, c_hd = grid_of_skin(60, lowest=0.004)
    colors = table.lookup(c_m, c_hd)
    half_a_step = 2.0**-24 * rng.choice([-1.0, 1.0], colors.shape)  # relative, of single precision
    maps = invert(colors, table, shading=shading)
    moved = invert(colors * (1.0 + half_a_step), table, shading=shading)
    told = maps.valid & maps.identifiable & moved.identifiable
    assert maps.melanin.dtype == maps.stderr_melanin.dtype == np.float32
    for name in ("melanin", "hemoglobin"):
        change = np.abs(getattr(moved, name) - getattr(maps, name))[told]
        assert change.any()
        assert (change / getattr(maps, f"stderr_{name}")[told]).max() < 1e-4


def test_known_shading_lets_every_color_find_melanin(table):
    c_m, c_hd = grid_of_skin(160)
    maps = invert(table.lookup(c_m, c_hd), table, shading="known")
    assert maps.valid.all()
    np.testing.assert_allclose(maps.melanin, c_m, rtol=1e-3)
    assert maps.gamut_distance.max() < 1e-3


@pytest.mark.parametrize("shading", MODES)
def test_kernel_finds_same_minimum_as_plain_numpy(shading, table, rng):
    c_m, c_hd = grid_of_skin(24, lowest=0.004)
    color = table.lookup(c_m, c_hd).reshape(-1, 3)
    noisy = (color * (1.0 + 0.01 * rng.standard_normal(color.shape))).astype(np.float32)
    maps = invert(noisy, table, shading=shading, variance=(0.01 * noisy) ** 2)
    weights = weights_of(np.full((len(noisy), 3), 1e-4), shading is None)
    melanin, hemoglobin, factor, cost = chromophore_reference.fit(
        noisy.astype(np.float64), table, weights, free_shading=shading is None
    )
    compared = maps.valid & maps.identifiable
    assert compared.mean() > 0.25
    # Where blood is hardly seen the sum has flat and double minima: one pixel in 100 may differ.
    for estimate, other, stderr in (
        (maps.melanin, melanin, maps.stderr_melanin),
        (maps.hemoglobin, hemoglobin, maps.stderr_hemoglobin),
    ):
        assert np.quantile((np.abs(estimate - other) / stderr)[compared], 0.99) < 0.15
    assert np.quantile(np.abs(maps.shading / factor - 1.0)[compared], 0.99) < 0.02
    assert np.quantile((maps.residual**2 - cost)[compared], 0.99) < 0.06


@pytest.mark.parametrize("shading", MODES)
def test_noise_never_yields_a_trusted_wrong_minimum(shading, table, rng):
    # The true chromophores are one candidate: a minimum that leaves more than they do is wrong.
    c_m, c_hd = (x[..., None] for x in grid_of_skin(20, lowest=0.004))
    color = table.lookup(c_m, c_hd)
    noisy = color * (1.0 + 0.01 * rng.standard_normal((20, 20, 30, 3)))
    maps = invert(noisy, table, shading=shading, variance=(0.01 * noisy) ** 2)
    error = noisy / color
    if shading is None:
        error = error / np.exp(np.log(error).mean(axis=-1, keepdims=True))
    weights = weights_of(np.full((*noisy.shape[:-1], 3), 1e-4), shading is None)
    at_truth = np.einsum("...c,...cd,...d->...", error - 1.0, weights, error - 1.0)
    wrong = maps.valid & (maps.residual**2 > at_truth + 0.1)
    # Blood that is hardly seen has two flat minima, and a color beyond the fold two solutions:
    # both have standard errors of the order of the value or are flagged.
    assert wrong.mean() < 5e-3
    assert (wrong & maps.identifiable).mean() < 5e-4
    sure = np.maximum(maps.stderr_melanin / maps.melanin, maps.stderr_hemoglobin / maps.hemoglobin)
    assert not (wrong & maps.identifiable & (sure < 0.3)).any()


@pytest.mark.parametrize("shading", MODES)
def test_scatter_matches_cramer_rao_bound(shading, table, rng):
    # 4000 draws a point: a ratio of root mean squares has a standard error of 1.1 %; the limit of
    # 1.2 leaves room for the curvature of the model at these errors.
    draws, noise = 4000, 0.004
    c_m = np.array([0.01, 0.02, 0.03, 0.05])[:, None, None]
    c_hd = np.array([0.02, 0.05, 0.12])[None, :, None]
    color = table.lookup(c_m, c_hd)
    noisy = color * (1.0 + noise * rng.standard_normal((4, 3, draws, 3)))
    maps = invert(noisy, table, shading=shading, variance=(noise * color) ** 2)
    exact = invert(color, table, shading=shading, variance=(noise * color) ** 2)
    for estimate, truth, bound in (
        (maps.melanin, c_m, exact.stderr_melanin),
        (maps.hemoglobin, c_hd, exact.stderr_hemoglobin),
    ):
        seen = (bound / truth)[..., 0] < 0.15
        assert seen.sum() >= 4
        efficiency = np.sqrt(np.mean((estimate - truth) ** 2, axis=-1)) / bound[..., 0]
        assert np.all(efficiency[seen] < 1.2)
        assert np.all(efficiency[seen] > 0.9)


def test_68_percent_intervals_cover_the_truth(table, rng):
    c_m, c_hd, noise = 0.1, 0.08, 0.005
    color = np.broadcast_to(table.lookup(c_m, c_hd), (40_000, 3))
    noisy = color * (1.0 + noise * rng.standard_normal(color.shape))
    maps = invert(noisy, table, shading="known", variance=(noise * color) ** 2)
    # Binomial standard error 0.0023, plus what the curvature of the model costs.
    for estimate, stderr, truth in (
        (maps.melanin, maps.stderr_melanin, c_m),
        (maps.hemoglobin, maps.stderr_hemoglobin, c_hd),
    ):
        assert 0.66 < np.mean(np.abs(estimate - truth) < stderr) < 0.71


@settings(max_examples=40, deadline=None)
@given(st.floats(0.01, 100.0), st.floats(0.003, 0.06), st.floats(0.01, 0.3))
def test_a_free_shading_takes_up_any_factor(table, factor, c_m, c_hd):
    color = table.lookup([c_m], [c_hd])
    plain, scaled = invert(color, table), invert(factor * color, table)
    np.testing.assert_allclose(scaled.melanin, plain.melanin, rtol=2e-3)
    np.testing.assert_allclose(scaled.hemoglobin, plain.hemoglobin, rtol=2e-3)
    np.testing.assert_allclose(scaled.shading, factor * plain.shading, rtol=2e-3)


def test_known_shading_is_divided_out_with_noise(table, rng):
    c_m, c_hd = grid_of_skin(6, lowest=0.005)
    factor = rng.uniform(0.2, 1.0, c_m.shape)
    color = table.lookup(c_m, c_hd)
    lit = invert(color, table, shading="known", variance=1e-6 / factor[..., None] ** 2)
    shaded = invert(color * factor[..., None], table, shading=factor, variance=[1e-6] * 3)
    np.testing.assert_allclose(shaded.melanin, lit.melanin, rtol=1e-3)
    np.testing.assert_allclose(shaded.stderr_hemoglobin, lit.stderr_hemoglobin, rtol=0.02)
    np.testing.assert_allclose(shaded.shading, factor, rtol=1e-6)


def test_vaguely_known_shading_equals_free_shading(table):
    color = table.lookup([0.02, 0.04], [0.05, 0.1])
    free = invert(color, table)
    vague = invert(color, table, shading="known", model_error=np.full((3, 3), 100.0))
    exact = invert(color, table, shading="known")
    np.testing.assert_allclose(vague.stderr_melanin, free.stderr_melanin, rtol=0.02)
    np.testing.assert_allclose(vague.stderr_hemoglobin, free.stderr_hemoglobin, rtol=0.02)
    assert np.all(exact.stderr_melanin < 0.9 * free.stderr_melanin)


def test_a_model_error_widens_the_errors_like_noise(table):
    color = table.lookup([0.02], [0.05])
    noise = invert(color, table, variance=(0.03 * color) ** 2)
    model = invert(color, table, variance=[0.0] * 3, model_error=0.03)
    np.testing.assert_allclose(model.stderr_melanin, noise.stderr_melanin, rtol=1e-3)
    assert invert(color, table, variance=[0.0] * 3).stderr_melanin < 1e-3 * model.stderr_melanin


def test_color_only_model_error_gives_its_implied_errors(table):
    # One direction of log color, without brightness: singular in the two others.
    direction = np.array([0.8, -0.25, -0.55])
    covariance = 1e-5 * np.outer(direction, direction) + 1e-9 * (3.0 * np.eye(3) - 1.0)
    color = table.lookup([0.02], [0.05])
    jacobian = table.jacobian([0.02], [0.05])[0] / color[0][:, None]
    by_all = np.linalg.inv(np.column_stack([jacobian, np.ones(3)]))
    implied = np.sqrt(np.diag(by_all @ covariance @ by_all.T))
    maps = invert(color, table, variance=[0.0] * 3, model_error=covariance)
    np.testing.assert_allclose(maps.stderr_melanin, implied[0], rtol=0.02)
    np.testing.assert_allclose(maps.stderr_hemoglobin, implied[1], rtol=0.02)
    bounds = compute_identifiability(table, variance=[0.0] * 3, model_error=covariance)
    assert np.isfinite(bounds.stderr_melanin).all()


@pytest.mark.parametrize("shading", MODES)
def test_unusable_pixels_are_masked_without_affecting_neighbors(shading, table):
    good = table.lookup(0.03, 0.05)
    bad = [[np.nan, 0.2, 0.1], [0.0, 0.2, 0.1], [0.3, -0.01, 0.1], [np.inf, 0.2, 0.1], good]
    rgb = np.array([good, *bad])
    maps = invert(rgb, table, shading=shading, valid=np.array([True] * 5 + [False]))
    assert maps.valid.tolist() == [True] + [False] * 5
    assert np.isnan(maps.melanin[1:]).all()
    assert np.isnan(maps.stderr_hemoglobin[1:]).all()
    assert not maps.identifiable[1:].any()
    assert np.isfinite(maps.melanin[0])


def test_a_bad_variance_or_shading_masks_its_pixel(table):
    color = np.broadcast_to(table.lookup(0.03, 0.05), (3, 3))
    maps = invert(
        color,
        table,
        shading=np.array([0.0, 1.0, 1.0]),
        variance=np.array([[1e-6] * 3, [1e-6, np.nan, 1e-6], [1e-6] * 3]),
    )
    assert maps.valid.tolist() == [False, False, True]


@pytest.mark.parametrize("shading", MODES)
def test_impossible_skin_color_is_flagged_with_distance(shading, table):
    blue = np.array([[0.05, 0.1, 0.4]])
    maps = invert(blue, table, shading=shading)
    assert maps.outside.all()
    assert not maps.valid.any()
    assert maps.gamut_distance[0] > 0.3
    assert np.isfinite(maps.melanin).all()


def test_gamut_distance_is_relative_to_nearest_color(table):
    paler = 1.05 * table.lookup(0.0, 0.0)  # paler than the palest skin
    maps = invert(paler[None], table, shading="known")
    assert maps.gamut_distance[0] == pytest.approx(0.05, rel=0.1)
    assert maps.outside.all()


def test_dark_free_shading_skin_is_ambiguous_light_not(table):
    light = invert(table.lookup([0.01, 0.02], [0.03, 0.06]), table)
    dark = invert(table.lookup([0.25, 0.4], [0.03, 0.06]), table)
    assert not light.ambiguous.any()
    assert dark.ambiguous.all()
    assert not dark.identifiable.any()


def test_shading_maximum_excludes_darker_solution(table):
    color = table.lookup([0.0622], [0.005])
    assert invert(color, table).ambiguous.all()
    assert not invert(color, table, shading_max=1.2).ambiguous.any()


def test_no_confident_number_for_blood_under_heavy_melanin(table):
    maps = invert(table.lookup([0.3], [0.01]), table, shading="known")
    assert maps.melanin_identifiable.all()
    assert not maps.hemoglobin_identifiable.any()


@pytest.mark.parametrize("shading", MODES)
def test_bounds_are_standard_errors_of_fit(shading, table):
    bounds = compute_identifiability(table, shading=shading, size=24)
    c_m, c_hd = np.broadcast_arrays(bounds.c_m[:, None], bounds.c_hd[None, :])
    inner = (slice(4, -1), slice(4, -1))
    maps = invert(
        table.lookup(np.minimum(c_m, C_M_MAX), np.minimum(c_hd, C_HD_MAX))[inner],
        table,
        shading=shading,
    )
    told = maps.valid & maps.identifiable & bounds.melanin_identifiable[inner]
    assert told.mean() > 0.2
    relative = maps.stderr_melanin / maps.melanin, maps.stderr_hemoglobin / maps.hemoglobin
    np.testing.assert_allclose(relative[0][told], bounds.stderr_melanin[inner][told], rtol=0.02)
    np.testing.assert_allclose(relative[1][told], bounds.stderr_hemoglobin[inner][told], rtol=0.02)


def test_bounds_follow_the_noise_model(table):
    few = compute_identifiability(table, shading=1.0, variance=lambda rgb: 1e-4 * rgb, size=8)
    many = compute_identifiability(table, shading=1.0, variance=lambda rgb: 1e-6 * rgb, size=8)
    np.testing.assert_allclose(few.stderr_melanin, 10.0 * many.stderr_melanin, rtol=1e-3)
    dim = compute_identifiability(table, shading=0.25, variance=lambda rgb: 1e-6 * rgb, size=8)
    np.testing.assert_allclose(dim.stderr_melanin, 2.0 * many.stderr_melanin, rtol=1e-3)


@pytest.mark.parametrize("shape", [(), (5,), (2, 3), (2, 3, 4)])
def test_leading_shape_gives_same_result_as_pixel_list(shape, table, rng):
    c_m = rng.uniform(0.01, 0.04, shape)
    rgb = table.lookup(c_m, 0.05)
    kept = rgb.copy()
    maps = invert(rgb, table)
    assert maps.melanin.shape == maps.valid.shape == shape
    np.testing.assert_allclose(maps.melanin, c_m, rtol=1e-3)
    np.testing.assert_array_equal(rgb, kept)


def test_empty_image_gives_empty_maps(table):
    assert invert(np.empty((0, 3)), table).melanin.shape == (0,)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rgb": np.ones((4, 4))}, r"rgb: got shape \(4, 4\), expected \(..., 3\)"),
        ({"shading": "free"}, "shading"),
        ({"shading": np.ones(3)}, r"shading: got \(3,\), .* broadcasts to \(4,\)"),
        ({"variance": np.ones((2, 3))}, "variance"),
        ({"valid": np.ones(4)}, "valid: got float64 .*expected bool"),
        ({"model_error": -0.1}, "model_error"),
        ({"model_error": np.diag([1.0, 1.0, -1.0])}, "model_error"),
        ({"model_error": np.ones(2)}, "model_error"),
        ({"shading_max": 0.0}, "shading_max"),
    ],
)
def test_mismatched_arguments_are_refused_by_name(arguments, message, table):
    with pytest.raises(ChromophoreError, match=message):
        invert(**({"rgb": np.full((4, 3), 0.2), "table": table} | arguments))


def test_default_noise_is_one_percent(table):
    color = table.lookup([0.02], [0.05])
    stated = invert(color, table, variance=(DEFAULT_RELATIVE_NOISE * color) ** 2)
    np.testing.assert_allclose(
        invert(color, table).stderr_melanin, stated.stderr_melanin, rtol=1e-4
    )


def test_single_shading_map_serves_map_stack(table, rng):
    known = rng.uniform(0.5, 1.0, (3, 4)).astype(np.float32)
    rgb = table.lookup(rng.uniform(0.01, 0.1, (2, 3, 4)), 0.05) * known[..., None]
    found = invert(rgb, table, shading=known)
    for one, whole in zip(rgb, found.melanin, strict=True):
        np.testing.assert_array_equal(whole, invert(one, table, shading=known).melanin)
