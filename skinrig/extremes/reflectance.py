"""Extremes of the skin's reflectance: lobes, factorizations, tables."""

import numpy as np

from model import dipole, merl
from model.brdf import tables as brdf_tables
from reconstruction import brdf_basis
from skinrig.extremes.expectations import masked, near, refused, rising, within
from skinrig.extremes.inputs import Real


def _samples(value, real: Real, *, points: int = 3, count: int = 40):  # type: ignore[no-untyped-def]
    """Return surface samples of `value`, called with light and view, at random directions."""
    rng = np.random.default_rng(9)
    ways = rng.normal(size=(2, points, count, 3))
    ways[..., 2] = np.abs(ways[..., 2]) + 0.4
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    light, view = ways
    up = np.broadcast_to([0.0, 0.0, 1.0], (points, 3))
    brdf = np.broadcast_to(np.asarray(value(light, view))[..., None], (points, count, 3))
    return brdf_basis.surface_samples(
        real(brdf), light, view, up, real(np.zeros((points, 3))), eta=1.4
    )


def _fitted_to(value: float, real: Real) -> brdf_basis.BasisWeights:
    """Return the weights of surface samples that are all of a value."""
    samples = _samples(lambda light, view: np.full(light.shape[:-1], value), real)
    return brdf_basis.fit_weights(samples, brdf_tables.default())


def _dark_surface(real: Real) -> str:
    return within(_fitted_to(0.0, real).weights, 0.0, 0.0, what="weights")


def _negative_surface(real: Real) -> str:
    return within(_fitted_to(-0.01, real).weights, 0.0, 1e-6, what="weights")


def _twins(real: Real) -> str:
    basis = brdf_tables.default()
    one = basis.mixed(np.eye(basis.size)[[20]])
    two = basis.mixed(np.eye(basis.size)[[20, 20]])

    def glossy(light, view):  # type: ignore[no-untyped-def]
        return 0.7 * one.evaluate(light, view, [0.0, 0.0, 1.0])[..., 0]

    single = brdf_basis.fit_weights(_samples(glossy, real), one)
    double = brdf_basis.fit_weights(_samples(glossy, real), two)
    near(np.sum(double.weights, axis=-1), single.weights[:, 0], relative=1e-3)
    return near(single.weights, np.full((3, 1), 0.7), relative=0.02)


def _ill_conditioned(real: Real) -> str:
    basis = brdf_tables.default()

    def glossy(light, view):  # type: ignore[no-untyped-def]
        return 0.7 * basis.evaluate(light, view, [0.0, 0.0, 1.0])[..., 20]

    samples = _samples(glossy, real, count=200)
    found = brdf_basis.fit_weights(samples, basis)
    lobes = basis.evaluate(samples.light_dir, samples.view_dir, samples.normals[:, None])
    cosine = np.sum(samples.light_dir * samples.normals[:, None], -1)
    again = cosine * np.einsum("pmk,pk->pm", lobes, found.weights)
    off = np.sum(np.abs(again - samples.value)[samples.valid]) / np.sum(
        np.abs(samples.value)[samples.valid]
    )
    return "samples again within " + within(off, 0.0, 0.02, what="share")


def _no_samples(real: Real) -> str:
    found = _fitted_to(np.nan, real)
    within(found.weights, 0.0, 0.0, what="weights")
    return masked(found.valid)


def _rank_above_data(real: Real) -> str:
    weights = real(np.random.default_rng(1).random((3, 59)))
    return refused(lambda: brdf_basis.reduce(weights, 10), ValueError, "rank")


def _zero_rows(real: Real) -> str:
    weights = np.random.default_rng(1).random((40, 12))
    weights[:20] = 0.0
    shares, mix, error = brdf_basis.reduce(real(weights), 4)
    within(shares[:20] @ mix, 0.0, 1e-2, what="rows of zeros")
    return within(error, 0.0, 0.5, what="error")


def _duplicated_rows(real: Real) -> str:
    one = np.random.default_rng(1).random(12)
    _, _, error = brdf_basis.reduce(real(np.tile(one, (30, 1))), 3)
    return within(error, 0.0, 1e-3, what="error")


def _merl_bins(real: Real) -> str:
    half = real(0.5) * real(np.pi)
    first, last = merl.bins(real(0.0), real(0.0), real(0.0)), merl.bins(half, half, real(np.pi))
    refused(lambda: merl.bins(real(1.7), real(0.0), real(0.0)), ValueError, "theta_h")
    near([int(i) for i in first], [0, 0, 0])
    return near([int(i) for i in last][:2], [89, 89])


def _conditions(real: Real) -> str:
    # sigma_t' = sigma_tr / sqrt(3 (1 - alpha')): sixteen decades of 1 - alpha'
    deficit = real(np.logspace(-15, 0, 16))
    sigma_a, sigma_s = dipole.coefficients(deficit, real(np.ones(16)))
    back = dipole.effective_transport(sigma_a, sigma_s)
    near(back, np.ones(16), relative=1e-5)
    return rising(sigma_a, what="sigma_a")


def _mirror_like(real: Real) -> str:
    basis = brdf_tables.default(0.0)
    up = real([0.0, 0.0, 1.0])
    lobe = basis.names.index("ggx 0.05 eta 1.4")
    below = basis.evaluate(real([0.0, 0.6, -0.8]), up, up)
    within(below, 0.0, 0.0, what="below the horizon")
    # D = 1 / (pi a^2), G = 1 at the peak: F0 / (4 pi a^2)
    peak = (0.4 / 2.4) ** 2 / (4 * np.pi * 0.05**2)
    return near(basis.evaluate(up, up, up)[lobe], peak, relative=0.01)
