"""Extremes of surface reflectance: lobes, factorizations, tables."""

import numpy as np

from model import dipole, merl
from model.brdf import tables as brdf_tables
from reconstruction import brdf_basis
from skinrig.extremes.expectations import (
    expect_error,
    expect_near,
    expect_rising,
    expect_valid_fraction,
    expect_within,
)
from skinrig.extremes.inputs import InputPrecision


def _samples(value, real: InputPrecision, *, points: int = 3, count: int = 40):  # type: ignore[no-untyped-def]
    """Return surface samples at random directions of `value`, a function of light and view."""
    rng = np.random.default_rng(9)
    directions = rng.normal(size=(2, points, count, 3))
    directions[..., 2] = np.abs(directions[..., 2]) + 0.4
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    light, view = directions
    up = np.broadcast_to([0.0, 0.0, 1.0], (points, 3))
    brdf = np.broadcast_to(np.asarray(value(light, view))[..., None], (points, count, 3))
    return brdf_basis.surface_samples(
        real(brdf), light, view, up, real(np.zeros((points, 3))), eta=1.4
    )


def _fitted_to(value: float, real: InputPrecision) -> brdf_basis.BasisWeights:
    """Return the weights fitted to surface samples of one constant value."""
    samples = _samples(lambda light, view: np.full(light.shape[:-1], value), real)
    return brdf_basis.fit_weights(samples, brdf_tables.default_basis())


def _dark_surface(real: InputPrecision) -> str:
    return expect_within(_fitted_to(0.0, real).weights, 0.0, 0.0, label="weights")


def _negative_surface(real: InputPrecision) -> str:
    return expect_within(_fitted_to(-0.01, real).weights, 0.0, 1e-6, label="weights")


def _twins(real: InputPrecision) -> str:
    basis = brdf_tables.default_basis()
    one = basis.mix_materials(np.eye(basis.size)[[20]])
    two = basis.mix_materials(np.eye(basis.size)[[20, 20]])

    def glossy(light, view):  # type: ignore[no-untyped-def]
        return 0.7 * one.evaluate(light, view, [0.0, 0.0, 1.0])[..., 0]

    single = brdf_basis.fit_weights(_samples(glossy, real), one)
    double = brdf_basis.fit_weights(_samples(glossy, real), two)
    expect_near(np.sum(double.weights, axis=-1), single.weights[:, 0], relative=1e-3)
    return expect_near(single.weights, np.full((3, 1), 0.7), relative=0.02)


def _ill_conditioned(real: InputPrecision) -> str:
    basis = brdf_tables.default_basis()

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
    return "relative misfit of the samples " + expect_within(off, 0.0, 0.02, label="fraction")


def _no_samples(real: InputPrecision) -> str:
    found = _fitted_to(np.nan, real)
    expect_within(found.weights, 0.0, 0.0, label="weights")
    return expect_valid_fraction(found.valid)


def _rank_above_data(real: InputPrecision) -> str:
    weights = real(np.random.default_rng(1).random((3, 59)))
    return expect_error(lambda: brdf_basis.reduce(weights, 10), ValueError, "rank")


def _zero_rows(real: InputPrecision) -> str:
    weights = np.random.default_rng(1).random((40, 12))
    weights[:20] = 0.0
    fractions, mix, error = brdf_basis.reduce(real(weights), 4)
    expect_within(fractions[:20] @ mix, 0.0, 1e-2, label="rows of zeros")
    return expect_within(error, 0.0, 0.5, label="error")


def _duplicated_rows(real: InputPrecision) -> str:
    one = np.random.default_rng(1).random(12)
    _, _, error = brdf_basis.reduce(real(np.tile(one, (30, 1))), 3)
    return expect_within(error, 0.0, 1e-3, label="error")


def _units_of_rows(real: InputPrecision) -> str:
    weights = np.random.default_rng(1).random((30, 12))
    errors = [brdf_basis.reduce(real(scale * weights), 3)[2] for scale in (1e-6, 1.0, 1e6)]
    return "errors " + expect_near(errors, np.full(3, errors[1]), relative=0.02)


def _merl_bins(real: InputPrecision) -> str:
    half = real(0.5) * real(np.pi)
    first, last = (
        merl.bin_indices(real(0.0), real(0.0), real(0.0)),
        merl.bin_indices(half, half, real(np.pi)),
    )
    expect_error(lambda: merl.bin_indices(real(1.7), real(0.0), real(0.0)), ValueError, "theta_h")
    expect_near([int(i) for i in first], [0, 0, 0])
    return expect_near([int(i) for i in last][:2], [89, 89])


def _conditions(real: InputPrecision) -> str:
    # sigma_tr = sqrt(3 sigma_a sigma_t') gives sigma_t' = sigma_tr / sqrt(3 (1 - alpha')), here for
    # sixteen decades of 1 - alpha'
    deficit = real(np.logspace(-15, 0, 16))
    sigma_a, sigma_s = dipole.coefficients(deficit, real(np.ones(16)))
    back = dipole.effective_transport(sigma_a, sigma_s)
    expect_near(back, np.ones(16), relative=1e-5)
    return expect_rising(sigma_a, label="sigma_a")


def _mirror_like(real: InputPrecision) -> str:
    basis = brdf_tables.default_basis(0.0)
    up = real([0.0, 0.0, 1.0])
    lobe = basis.names.index("ggx 0.05 eta 1.4")
    below = basis.evaluate(real([0.0, 0.6, -0.8]), up, up)
    expect_within(below, 0.0, 0.0, label="below the horizon")
    # D = 1 / (pi a^2), G = 1 at the peak: F0 / (4 pi a^2)
    peak = (0.4 / 2.4) ** 2 / (4 * np.pi * 0.05**2)
    return expect_near(basis.evaluate(up, up, up)[lobe], peak, relative=0.01)
