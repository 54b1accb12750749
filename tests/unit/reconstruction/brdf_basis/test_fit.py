"""Fits of tabulated bases: against SciPy, against the truth, and at the extremes."""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import nnls

from model import fresnel
from model.brdf import tables as brdf_tables
from reconstruction import brdf_basis
from reconstruction.brdf_basis.fit import _factor
from skinrig.benchmarks.dome import brdf_truth


@pytest.fixture(scope="module")
def basis():
    return brdf_tables.default_basis()


@pytest.fixture(scope="module")
def face():
    rng = np.random.default_rng(6)
    return brdf_truth.sample_dome(
        40, r_d=brdf_truth.LIGHT_SKIN_ALBEDO, noise=0.02, samples=900, rng=rng
    )


def samples_of(p, **changes):
    given = {"variance": p.variance, "valid": p.valid, **changes}
    return brdf_basis.surface_samples(p.f, p.light, p.view, p.normals, p.r_d, eta=1.3, **given)


def matrix(s, basis, point):
    cos_l = s.light_dir[point].astype(float) @ s.normals[point]
    material = basis.evaluate(s.light_dir[point], s.view_dir[point], s.normals[point])
    return (material * cos_l[:, None])[s.valid[point]]


@pytest.mark.parametrize("known_noise", [True, False])
def test_plain_residuals_match_scipy_within_fifth_of_percent(face, basis, known_noise):
    s = samples_of(face) if known_noise else samples_of(face, variance=None)
    found = brdf_basis.fit_weights(s, basis, compress="none")
    for point in range(20):
        root = 1.0 / np.sqrt(s.variance[point][s.valid[point]]) if known_noise else 1.0
        a = matrix(s, basis, point) * np.reshape(root, (-1, 1))
        y = s.value[point][s.valid[point]] * root
        least = nnls(a, y.astype(float))[1]
        ours = np.linalg.norm(a @ found.weights[point] - y)
        assert ours <= 1.002 * least
        # the reported residual is the weighted RMS
        total = np.sum(np.square(root)) if known_noise else len(y)
        assert found.residual[point] == pytest.approx(ours / np.sqrt(total), rel=1e-3)


def test_weights_are_never_negative_and_few(face, basis):
    for compress in ("none", "cbrt"):
        weights = brdf_basis.fit_weights(samples_of(face), basis, compress=compress).weights
        assert np.all(weights >= 0.0)
        assert np.mean((weights > 0.0).sum(axis=1)) < 20


def test_full_set_of_materials_is_reported(face, basis, rng, caplog):
    brdf_basis.fit_weights(samples_of(face), basis)
    assert caplog.records == []
    light, view = rng.normal(size=(2, 4, 200, 3))
    for way in (light, view):
        way[..., 2] = np.abs(way[..., 2]) + 0.2
        way /= np.linalg.norm(way, axis=-1, keepdims=True)
    up = np.broadcast_to([0.0, 0.0, 1.0], (4, 3))
    every = np.einsum("pmk,pk->pm", basis.evaluate(light, view, up[:, None]), rng.random((4, 59)))
    s = brdf_basis.surface_samples(every[..., None], light, view, up, np.zeros((4, 1)), eta=1.0)
    brdf_basis.fit_weights(s, basis)
    assert ["of 4 points" in r.getMessage() for r in caplog.records] == [True]


def test_a_mixture_comes_back_through_the_whole_convention(face, basis):
    rng = np.random.default_rng(9)
    truth = np.zeros((len(face.f), 59))
    truth[:, [7, 16, 40]] = rng.uniform(0.2, 1.0, (len(face.f), 3))
    lobe = np.stack(
        [
            brdf_basis.evaluate(x, basis, to, at, n)
            for x, to, at, n in zip(truth, face.light, face.view, face.normals, strict=True)
        ]
    )
    through = np.ones(lobe.shape)
    for v in (face.light, face.view):
        cosine = np.clip(np.einsum("pmc,pc->pm", v, face.normals), 0.0, 1.0)
        through *= 1.0 - fresnel.reflectance(cosine, 1.3)
    f = through[..., None] * face.r_d[:, None] / np.pi + lobe[..., None]
    s = brdf_basis.surface_samples(
        f, face.light, face.view, face.normals, face.r_d, eta=1.3, valid=face.valid
    )
    for compress in ("none", "cbrt"):
        found = brdf_basis.fit_weights(s, basis, compress=compress)
        back = np.stack(
            [
                brdf_basis.evaluate(x, basis, to, at, n)
                for x, to, at, n in zip(
                    found.weights, face.light, face.view, face.normals, strict=True
                )
            ]
        )
        error = np.abs(back - lobe)[s.valid] / lobe[s.valid].mean()
        assert np.median(error) < 0.002
        # were F_r to multiply the tables once more, this would be near 1
        assert np.quantile(error, 0.99) < 0.05


def held_out(p, s, rng, basis, compress):
    """Fit without a fifth of the samples; return relative errors of all light there."""
    out = rng.random(s.valid.shape) < 0.2
    found = brdf_basis.fit_weights(
        dataclasses.replace(s, valid=s.valid & ~out), basis, compress=compress
    )
    surface = np.stack(
        [
            brdf_basis.evaluate(x, basis, to, at, n)
            for x, to, at, n in zip(found.weights, p.light, p.view, p.normals, strict=True)
        ]
    )
    total = p.surface + 0.9 * p.r_d[:, 1:2] / np.pi
    root = np.cbrt(surface) - np.cbrt(p.surface)
    at = s.valid & out
    return np.abs(surface - p.surface)[at] / total[at], np.sqrt(np.mean(root[at] ** 2))


def test_held_out_light_errs_below_5_percent(face, basis):
    s = samples_of(face)
    error, root = held_out(face, s, np.random.default_rng(1), basis, "cbrt")
    _, plain_root = held_out(face, s, np.random.default_rng(1), basis, "none")
    assert np.median(error) < 0.05
    assert np.quantile(error, 0.95) < 0.05
    assert root < plain_root


def test_the_scale_s_standard_error_covers_the_truth(basis):
    rng = np.random.default_rng(14)
    p = brdf_truth.sample_dome(
        150, r_d=brdf_truth.DARK_SKIN_ALBEDO, noise=0.0, samples=300, rng=rng
    )
    lobe = brdf_basis.evaluate(
        np.eye(59)[20],
        basis,
        p.light.reshape(-1, 3),
        p.view.reshape(-1, 3),
        np.repeat(p.normals, p.light.shape[1], axis=0),
    ).reshape(p.valid.shape)
    sigma = 0.05 * lobe[..., None] + 0.002
    f = lobe[..., None] + sigma * rng.standard_normal((*lobe.shape, 3))
    zero = np.zeros_like(p.r_d)
    s = brdf_basis.surface_samples(
        f,
        p.light,
        p.view,
        p.normals,
        zero,
        eta=1.3,
        variance=np.broadcast_to(sigma**2, f.shape),
        valid=p.valid,
    )
    only = brdf_tables.tabulate({"it": lambda to, at: basis.evaluate(to, at, [0, 0, 1.0])[..., 20]})
    found = brdf_basis.fit_weights(s, only, compress="none")
    z = (found.weights[:, 0] - 1.0) / found.stderr
    # 150 normal values: their spread lies in 0.8 ... 1.2 but for one case in 2000
    assert 0.8 < z.std() < 1.2


def test_extremes_give_masks_and_no_nan(face, basis):
    few = dataclasses.replace(
        samples_of(face),
        value=samples_of(face).value.copy(),
        valid=samples_of(face).valid.copy(),
        light_dir=samples_of(face).light_dir.copy(),
        view_dir=samples_of(face).view_dir.copy(),
    )
    few.valid[0] = False  # all saturated
    few.valid[1, 1:] = False  # at most one sample
    few.value[2] = 0.0
    few.value[3] = -np.abs(few.value[3]) - 0.01
    few.value[4] *= 1e6
    few.value[5] *= 1e-12
    few.light_dir[6] = few.light_dir[6, :1]  # one light and view, many times
    few.view_dir[6] = few.view_dir[6, :1]
    for compress in ("none", "cbrt"):
        found = brdf_basis.fit_weights(few, basis, compress=compress)
        np.testing.assert_array_equal(found.valid, few.valid.any(axis=1))
        assert np.all(np.isfinite(found.weights))
        assert np.all(np.isfinite(found.residual[found.valid]))
        assert np.all(found.weights[[0, 2, 3]] == 0.0)
        assert np.all(found.weights[4].sum() > 0.0)


def test_unlit_points_get_no_weights_every_time(face, basis):
    dark = samples_of(face, variance=None)
    dark = dataclasses.replace(dark, value=np.zeros_like(dark.value))
    for _ in range(3):  # what a call leaves in memory must not matter to the next
        assert not brdf_basis.fit_weights(dark, basis).weights.any()


def test_grazing_saturated_and_unknown_samples_are_omitted(face):
    light = face.light.copy()
    flat = np.cross(face.normals, [0.0, 1.0, 0.0])
    light[:, 0] = flat / np.linalg.norm(flat, axis=1, keepdims=True)
    f = face.f.copy()
    f[:, 1] = np.nan
    r_d = face.r_d.copy()
    r_d[3] = np.nan
    s = brdf_basis.surface_samples(
        f, light, face.view, face.normals, r_d, eta=1.3, variance=face.variance
    )
    assert not s.valid[:, :2].any()
    assert not s.valid[3].any()
    assert np.all(np.isfinite(s.value))
    with pytest.raises(brdf_basis.SampleError, match="normals"):
        brdf_basis.surface_samples(f, light, face.view, face.normals[:2], r_d, eta=1.3)


def test_points_are_independent_of_chunking(face, basis):
    s = samples_of(face)
    whole = brdf_basis.fit_weights(s, basis)
    fields = [getattr(s, field.name)[10:] for field in dataclasses.fields(s)]
    part = brdf_basis.fit_weights(brdf_basis.SurfaceSamples(*fields), basis)
    # another neighbour's columns to start from: the same misfit, to the solver's tolerance
    np.testing.assert_allclose(part.residual, whole.residual[10:], rtol=0.01)


def test_rank_3_points_need_exactly_3_mixtures(basis):
    rng = np.random.default_rng(2)
    mix = np.zeros((3, 59))
    for row, columns in enumerate(([2, 20], [40], [50, 57])):
        mix[row, columns] = rng.uniform(0.3, 1.0, len(columns))
    shares = rng.exponential(size=(200, 3)) @ mix
    errors = [brdf_basis.reduce(shares, rank, basis=basis)[2] for rank in (1, 2, 3, 4, 5)]
    assert brdf_basis.find_plateau_rank(errors) == 3
    assert errors[2] < 0.02 < errors[1]
    found, rows, _ = brdf_basis.reduce(shares, 3)
    assert found.shape == (200, 3)
    assert np.all(found >= 0.0)
    np.testing.assert_allclose(rows.sum(axis=1), 1.0)
    np.testing.assert_allclose(found @ rows, shares, atol=0.05 * shares.max())


def test_four_face_mixtures_fit_nearly_like_all_materials(face, basis):
    s = samples_of(face)
    full = brdf_basis.fit_weights(s, basis)
    _, mix, _ = brdf_basis.reduce(full, 4, basis=basis)
    again = brdf_basis.fit_weights(s, basis.mix_materials(mix))
    assert again.weights.shape == (len(face.f), 4)
    assert np.median(again.residual / full.residual) < 1.1


def test_early_end_of_factorization_is_silent(caplog, rng):
    """It is valid, and the error that `reduce` returns includes it."""
    data = rng.exponential(size=(40, 59))
    found, mix = _factor(data, 4, 0, rounds=2)
    assert (found.shape, mix.shape) == ((40, 4), (4, 59))
    assert caplog.records == []
    assert np.abs(found @ mix - data).mean() > np.abs(np.matmul(*_factor(data, 4, 0)) - data).mean()


def test_excessive_ranks_and_empty_weights_have_clear_outcomes():
    with pytest.raises(ValueError, match="rank: got 5, expected a number in"):
        brdf_basis.reduce(np.ones((3, 59)), 5)
    found, mix, error = brdf_basis.reduce(np.zeros((10, 59)), 2)
    assert error == 0.0
    assert np.all(found == 0.0)
    np.testing.assert_allclose(mix.sum(axis=1), 1.0)


def test_a_sphere_shows_its_highlight_towards_the_light(basis):
    image = brdf_basis.render_lit_sphere(
        np.eye(59)[16], basis, light_dir=(0.6, 0.6, 0.5), size_px=65
    )
    row, column = np.unravel_index(np.argmax(image), image.shape)
    assert row < 32 < column
    assert image[0, 0] == 0.0
    assert np.all(np.isfinite(image))
