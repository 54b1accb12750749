"""Wrinkle maps and weights fitted to normals that the model made: round trips, errors, extremes."""

import numpy as np
import pytest
from scipy import stats
from scipy.ndimage import gaussian_filter

from model import texture_resampling as resampling
from model import wrinkles
from model.wrinkles.expressions import JIMENEZ2011_TABLE, WrinkleError
from model.wrinkles.partial_derivatives import WrinkleLayer
from reconstruction.normal_maps import NormalMaps
from reconstruction.wrinkles import fit as wrinkle_fit
from reconstruction.wrinkles import texels as wrinkle_texels
from reconstruction.wrinkles import weights as wrinkle_weights

SIDE = 128
CENTRES = [
    (0.2, 0.15),
    (0.8, 0.15),
    (0.2, 0.4),
    (0.8, 0.4),
    (0.2, 0.65),
    (0.8, 0.65),
    (0.3, 0.9),
    (0.7, 0.9),
]


@pytest.fixture(scope="module")
def face():
    """Return neutral derivatives and a layer with soft, overlapping zones."""
    rng = np.random.default_rng(7)
    base = gaussian_filter(rng.standard_normal((SIDE, SIDE, 2)), (2, 2, 0))
    wrinkle = gaussian_filter(rng.standard_normal((32, 32, 2)), (1.2, 1.2, 0))
    y, x = np.mgrid[:16, :16] / 15.0
    masks = np.stack([np.exp(-((x - a) ** 2 + (y - b) ** 2) / 0.02) for a, b in CENTRES])
    masks /= masks.sum(axis=0) + 0.05
    return base * 0.2 / base.std(), WrinkleLayer(0.5 * wrinkle / np.abs(wrinkle).max(), masks)


def shown(face, weights):
    base, layer = face
    return wrinkles.combine_layers(base, [layer], weights, clamp="signed")


def disturbed(normals, sigma_rad, rng):
    """Return unit normals turned by independent angles along two directions of the surface."""
    helper = np.where(np.abs(normals[..., :1]) < 0.5, [1.0, 0, 0], [0, 1.0, 0])
    u = np.cross(normals, helper)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    v = np.cross(normals, u)
    a, b = sigma_rad * rng.standard_normal((2, *normals.shape[:2], 1)) / np.sqrt(2)
    n = normals + a * u + b * v
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def pixels(texels, shape):
    return np.moveaxis(resampling.resample(np.moveaxis(texels, 2, 0), shape), 0, 2)


def low_passed(derivatives, shape, *, variance=0.0, valid=True):
    """Return the texels whose bilinear reading is nearest to some derivatives."""
    good = valid & np.isfinite(derivatives).all(axis=2)
    kept, ones = good[..., None], good.astype(float)
    noise = np.where(kept, variance, np.zeros(derivatives.shape))
    return wrinkle_texels.fit_texels(ones, np.where(kept, derivatives, 0.0), noise, ones, shape)


# --- texels ---------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(32, 32), (20, 31), (1, 1), (64, 128)])
def test_texels_come_back_from_their_own_bilinear_reading(rng, shape):
    texels = rng.standard_normal((*shape, 2))
    got = low_passed(pixels(texels, (128, 128)), shape)
    assert got.valid.all()
    np.testing.assert_allclose(got.values, texels, atol=1e-6)


@pytest.mark.parametrize(("steps", "warnings"), [(30, 0), (10, 1)])
def test_unsolved_texels_alone_warn(rng, monkeypatch, caplog, steps, warnings):
    """Thirty steps miss the tolerance of 1e-12 by a factor of 30, which does not matter."""
    monkeypatch.setattr(wrinkle_texels, "MAX_CG_STEPS", steps)
    texels = rng.standard_normal((12, 12, 2))
    ones, products = np.ones((32, 32)), pixels(texels, (32, 32))
    noise = np.zeros(products.shape)
    got = wrinkle_texels.fit_texels(ones, products, noise, ones, (12, 12))
    assert len(caplog.records) == warnings
    assert (np.abs(got.values - texels).max() < 1e-6) == (warnings == 0)


def test_a_map_at_full_resolution_is_kept(rng):
    d = rng.standard_normal((24, 17, 2))
    np.testing.assert_allclose(low_passed(d, (24, 17)).values, d, atol=1e-7)


def test_detail_finer_than_texel_is_averaged_without_aliasing():
    x = np.arange(256)
    ripple = np.zeros((256, 256, 2))
    ripple[..., 0] = np.cos(np.pi * x)  # one period in two pixels; sixteen pixels a texel
    got = low_passed(ripple, (16, 16)).values
    assert np.abs(got[:, 2:-2]).max() < 0.02
    assert np.abs(got).max() < 0.05  # half a texel's weights are missing at the border
    picked = ripple[::16, ::16]  # what taking every sixteenth pixel would keep
    assert np.abs(picked).max() == 1.0


def test_the_fitted_low_pass_reads_closer_than_averages(rng):
    d = gaussian_filter(rng.standard_normal((128, 128, 2)), (6, 6, 0))
    fitted = low_passed(d, (16, 16)).values
    averaged = np.moveaxis(resampling.resample(np.moveaxis(d, 2, 0), (16, 16)), 0, 2)
    misfit = [np.mean((pixels(t, (128, 128)) - d) ** 2) for t in (fitted, averaged)]
    assert misfit[0] < 0.8 * misfit[1]


def test_holes_do_not_leak_into_texels(rng):
    texels = rng.standard_normal((16, 16, 2))
    d = pixels(texels, (128, 128))
    valid = rng.random((128, 128)) > 0.4
    valid[30:60, 40:90] = False
    d[~valid] = 1e6
    got = low_passed(d, (16, 16), valid=valid)
    np.testing.assert_allclose(got.values[got.valid], texels[got.valid], atol=1e-5)
    assert not got.valid[5, 7]
    assert not got.values[~got.valid].any()
    assert np.isinf(got.stderr[~got.valid]).all()
    assert np.isfinite(got.stderr[got.valid]).all()
    nothing = low_passed(d, (16, 16), valid=np.zeros((128, 128), bool))
    assert not nothing.valid.any()


@pytest.mark.parametrize("side", [8, 16, 64, 128])
def test_texel_scatter_matches_its_standard_error(rng, side):
    sigma = 0.1
    noise = sigma * rng.standard_normal((128, 128, 2))
    got = low_passed(noise, (side, side), variance=np.full(noise.shape, sigma**2))
    edge = max(side // 8, 1)  # the error holds away from borders
    z = (got.values / got.stderr)[edge:-edge, edge:-edge]
    # neighbours scatter against each other: at least a quarter of the samples is independent
    freedom = z.size / 4
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], freedom) / freedom
    assert low < np.mean(z**2) < high


def test_more_texels_than_pixels_are_refused():
    with pytest.raises(WrinkleError, match="size"):
        low_passed(np.zeros((8, 8, 2)), (9, 8))


def test_errors_of_normals_become_errors_of_derivatives(rng):
    n = np.array([0.3, -0.5, 0.7])
    n /= np.linalg.norm(n)
    many = np.broadcast_to(n, (300, 300, 3))
    sigma = 0.01
    d = wrinkles.encode(disturbed(many, sigma, rng), limit=None)
    stated = wrinkle_texels.measure_derivatives(many, stderr_rad=np.full((300, 300), sigma))
    ratio = d.var(axis=(0, 1)) / stated.variance[0, 0]
    np.testing.assert_allclose(ratio, 1.0, atol=4 * np.sqrt(2 / 90_000) + 5e-3)  # 4 sigma, bend


def test_grazing_normals_and_unknown_errors_are_masked_counted():
    n = np.zeros((1, 5, 3))
    n[..., 2] = 1.0
    n[0, 1] = [0.99, 0, np.sqrt(1 - 0.99**2)]
    n[0, 2] = np.nan
    stderr = np.array([[0.01, 0.01, 0.01, np.nan, 0.01]])
    got = wrinkle_texels.measure_derivatives(n, stderr_rad=stderr)
    np.testing.assert_array_equal(got.valid, [[True, False, False, False, True]])
    assert got.too_steep_fraction == 0.25
    assert np.isfinite(got.values).all()
    assert np.isfinite(got.variance).all()
    same = wrinkle_texels.measure_derivatives(
        NormalMaps(n, n[..., 0], n[..., 0], np.ones((1, 5), bool), stderr)
    )
    np.testing.assert_array_equal(same.valid, got.valid)


# --- one expression -------------------------------------------------------------------------


@pytest.mark.parametrize("clamp", ["unit", "signed"])
def test_weights_of_a_new_expression_come_back(face, clamp):
    base, layer = face
    true = np.array([0.3, 1.0, 0.0, 0.7, 0.05, 0.5, 0.9, 0.2])
    if clamp == "signed":
        true[[1, 4]] = [-1.0, -0.4]
    got = wrinkle_fit.fit_weights(layer, wrinkles.decode(base), shown(face, true), clamp=clamp)
    np.testing.assert_allclose(got.weights, true, atol=1e-6)
    assert got.valid.all()
    assert got.explained > 1 - 1e-9


def test_weight_beyond_bounds_is_clamped_and_reported(face):
    base, layer = face
    asked = np.array([0.5, -0.6, 0.5, 0.5, 1.7, 0.5, 0.5, 0.5])
    twice = WrinkleLayer(2 * layer.wrinkle, layer.masks)
    n = wrinkles.combine_layers(base, [twice], asked / 2, clamp="signed")
    got = wrinkle_fit.fit_weights(layer, wrinkles.decode(base), n)
    np.testing.assert_array_equal(got.weights[[1, 4]], [0.0, 1.0])
    assert got.at_bound[[1, 4]].all()
    assert got.explained < 0.999
    free = wrinkle_fit.fit_weights(layer, wrinkles.decode(base), n, clamp="signed")
    np.testing.assert_allclose(free.weights[1], -0.6, atol=0.1)


def test_weight_scatter_matches_stderr_and_cramer_rao_bound(face):
    base, layer = face
    true = np.array([0.3, 0.8, 0.4, 0.7, 0.25, 0.5, 0.6, 0.2])
    sigma, draws = 0.1, 24
    neutral, clean = wrinkles.decode(base), shown(face, true)
    stderr_rad = np.full((SIDE, SIDE), sigma)
    z = []
    for seed in range(draws):
        noisy = disturbed(clean, sigma, np.random.default_rng(seed))
        measured = wrinkle_texels.measure_derivatives(noisy, stderr_rad=stderr_rad)
        got = wrinkle_fit.fit_weights(layer, neutral, measured, clamp="signed")
        z.append((got.weights - true) / np.sqrt(np.diag(got.covariance)))
        assert np.all(got.stderr >= np.sqrt(np.diag(got.covariance)) * (1 - 1e-12))
    z = np.array(z)
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], z.size) / z.size
    # the bent relation of angle and derivative at sigma = 0.1 adds about sigma^2 to the variance
    assert low < np.mean(z**2) < high * 1.05
    # the bound: inverse of the information of independent derivatives with known map and masks
    flat = shown(face, true)
    exact = wrinkle_texels.measure_derivatives(flat, stderr_rad=stderr_rad)
    read = pixels(np.asarray(layer.wrinkle), (SIDE, SIDE))
    full = np.stack([resampling.resample(m, (SIDE, SIDE)) for m in layer.masks])
    design = (full[..., None] * read / np.sqrt(exact.variance)).reshape(8, -1)
    bound = np.sqrt(np.diag(np.linalg.inv(design @ design.T)))
    ratio = np.sqrt(np.diag(got.covariance)) / bound
    assert np.all(ratio > 0.97)
    assert np.all(ratio < 1.1)


def test_zone_without_wrinkle_has_infinite_weight_error(face):
    base, layer = face
    wrinkle = np.array(layer.wrinkle)
    masks = np.zeros_like(layer.masks)
    masks[:, :8, :] = layer.masks[:, :8, :]
    masks[7] = 0.0
    masks[7, 10:, 10:] = 1.0
    wrinkle[18:, 18:] = 0.0
    flat_there = WrinkleLayer(wrinkle, masks)
    n = wrinkles.combine_layers(base, [flat_there], np.full(8, 0.5))
    got = wrinkle_fit.fit_weights(flat_there, wrinkles.decode(base), n)
    assert not got.valid[7]
    assert got.weights[7] == 0.0
    assert np.isinf(got.stderr[7])
    np.testing.assert_allclose(got.weights[:4], 0.5, atol=1e-6)


def test_fully_masked_zone_is_reported_and_others_kept(face):
    base, layer = face
    valid = np.ones((SIDE, SIDE), bool)
    # soft masks reach everywhere: cut this one to its own square, then take the square away
    masks = np.array(layer.masks)
    masks[0] = 0.0
    masks[0, :4, :4] = 1.0
    near = resampling.resample(masks[0], (SIDE, SIDE)) > 0
    valid[near] = False
    cut = WrinkleLayer(layer.wrinkle, masks)
    n = wrinkles.combine_layers(base, [cut], np.full(8, 0.5))
    n[~valid] = np.nan
    measured = wrinkle_texels.measure_derivatives(n, valid=valid)
    got = wrinkle_fit.fit_weights(cut, wrinkles.decode(base), measured)
    np.testing.assert_array_equal(got.valid, [False] + [True] * 7)
    np.testing.assert_allclose(got.weights, [0.0] + [0.5] * 7, atol=1e-6)


def test_zones_with_identical_masks_have_undetermined_weights(face):
    base, layer = face
    masks = np.array(layer.masks)
    masks[1] = masks[0]
    twins = WrinkleLayer(layer.wrinkle, masks)
    n = wrinkles.combine_layers(base, [twins], np.full(8, 0.4))
    got = wrinkle_fit.fit_weights(twins, wrinkles.decode(base), n)
    np.testing.assert_array_equal(got.valid, [False, False] + [True] * 6)
    assert np.isinf(got.stderr[:2]).all()
    np.testing.assert_allclose(got.weights[2:], 0.4, atol=1e-5)


def test_unmoved_face_has_zero_weights_and_explained_variance(face):
    base, layer = face
    got = wrinkle_fit.fit_weights(layer, wrinkles.decode(base), wrinkles.decode(base))
    np.testing.assert_allclose(got.weights, 0.0, atol=1e-12)
    assert got.explained == 0.0


def test_a_map_without_any_wrinkle_determines_nothing(face):
    base, layer = face
    still = WrinkleLayer(np.zeros_like(layer.wrinkle), layer.masks)
    got = wrinkle_fit.fit_weights(still, wrinkles.decode(base), shown(face, np.ones(8)))
    assert not got.valid.any()
    assert np.isinf(got.stderr).all()
    assert not got.weights.any()


# --- several expressions --------------------------------------------------------------------


@pytest.fixture(scope="module")
def fitted(face):
    base, layer = face
    states = {name: shown(face, {name: 1.0}) for name in JIMENEZ2011_TABLE.rows}
    fit = wrinkle_fit.fit_wrinkle_map(
        wrinkles.decode(base), states, layer.masks, size=(32, 32), clamp="signed"
    )
    return states, fit


def test_with_known_weights_the_map_comes_back(face):
    base, layer = face
    states = {name: shown(face, {name: 1.0}) for name in JIMENEZ2011_TABLE.rows}
    got = wrinkle_fit.fit_wrinkle_map(
        wrinkles.decode(base),
        states,
        layer.masks,
        size=(32, 32),
        table=JIMENEZ2011_TABLE,
        clamp="signed",
    )
    seen = got.layer.valid
    assert seen.mean() > 0.95
    np.testing.assert_allclose(got.layer.wrinkle[seen], layer.wrinkle[seen], atol=2e-5)
    assert got.explained > 1 - 1e-8
    for name, one in got.expressions.items():
        np.testing.assert_allclose(one.weights, JIMENEZ2011_TABLE.row(name), atol=1e-4)


def test_map_and_weights_together_show_every_expression(face, fitted):
    states, fit = fitted
    assert fit.outcome.converged
    model = fit.model()
    for name, normals in states.items():
        got = model.evaluate({name: 1.0}).normals
        angle = np.degrees(np.arccos(np.clip((got * normals).sum(axis=2), -1, 1)))
        assert angle.mean() < 0.1
        assert fit.expressions[name].explained > 0.999


def test_weights_are_recovered_up_to_zone_scale(fitted):
    _, fit = fitted
    got = np.array([fit.layer.table.rows[name] for name in JIMENEZ2011_TABLE.rows])
    true = np.array(list(JIMENEZ2011_TABLE.rows.values()))
    for z in range(8):
        scale = (got[:, z] @ true[:, z]) / (true[:, z] @ true[:, z])
        assert scale > 0.5
        np.testing.assert_allclose(got[:, z], scale * true[:, z], atol=0.04)


def test_single_expression_gives_own_map_with_unit_weights(face):
    base, layer = face
    joy = {"joy": shown(face, {"joy": 1.0})}
    fit = wrinkle_fit.fit_wrinkle_map(
        wrinkles.decode(base), joy, layer.masks, size=(32, 32), clamp="signed"
    )
    weights = fit.expressions["joy"]
    np.testing.assert_allclose(weights.weights[weights.valid], 1.0, atol=0.02)
    assert fit.explained > 0.999


def test_mismatched_names_sizes_or_tables_are_refused(face):
    base, layer = face
    n = wrinkles.decode(base)
    with pytest.raises(WrinkleError, match="expected at least one"):
        wrinkle_fit.fit_wrinkle_map(n, {}, layer.masks, size=(8, 8))
    with pytest.raises(WrinkleError, match="got shape"):
        wrinkle_fit.fit_wrinkle_map(n, {"joy": n[:64]}, layer.masks, size=(8, 8))
    with pytest.raises(WrinkleError, match=r"table\['joy'\]: got"):
        wrinkle_fit.fit_wrinkle_map(
            n, {"joy": n}, layer.masks[:5], size=(8, 8), table=JIMENEZ2011_TABLE
        )
    with pytest.raises(WrinkleError, match="got 1 names"):
        wrinkle_fit.fit_wrinkle_map(n, {"joy": n}, layer.masks, size=(8, 8), zones=("a",))
    with pytest.raises(WrinkleError, match="clamp"):
        wrinkle_fit.fit_weights(layer, n, n, clamp="tight")


def test_normal_equations_match_full_design(face, rng):
    _, layer = face
    d = rng.standard_normal((SIDE, SIDE, 2)).astype(np.float32)
    weight = rng.random((SIDE, SIDE)).astype(np.float32)
    difference = wrinkle_weights.Difference(d, np.zeros_like(d), weight)
    read = pixels(np.asarray(layer.wrinkle), (SIDE, SIDE))
    got = wrinkle_weights.build_equations(layer.masks, read, {"": difference})[""]
    full = np.stack([resampling.resample(m, (SIDE, SIDE)) for m in layer.masks])
    design = (full[..., None] * read).reshape(8, -1)
    v = np.repeat(weight.ravel().astype(float), 2)
    np.testing.assert_allclose(got.matrix, (design * v) @ design.T, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(got.vector, (design * v) @ d.ravel(), rtol=1e-6, atol=1e-9)
    w = rng.random(8)
    left = d.ravel() - w @ design
    assert got.misfit(w) == pytest.approx((v * left * left).sum(), rel=1e-6)
