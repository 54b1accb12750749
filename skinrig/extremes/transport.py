"""Extremes of subsurface scattering: dipole, diffusion, layers, Monte Carlo, profiles."""

import math

import numpy as np

from model import dipole, photon_table, tissue_optics
from model.dipole import kienle_patterson as diffusion
from reconstruction import subsurface
from rigsim.tissue.tissue_mc import Layer, LayerStack, trace_photons
from skinrig.arrays import Float64Array
from skinrig.extremes.expectations import (
    ExpectationError,
    expect_error,
    expect_finite,
    expect_near,
    expect_rising,
    expect_valid_fraction,
    expect_within,
)
from skinrig.extremes.inputs import InputPrecision


def _layers(
    real: InputPrecision,
    *layers: tuple[float, float, float],
    eta: float = 1.4,
    anisotropy: float = 0.0,
    directions: int | None = None,
) -> Float64Array:
    """Return the reflectance of layers of (sigma_a, sigma_s', thickness), in 1/mm and mm."""
    return tissue_optics.layer_stack_reflectance(
        *(real(part) for part in zip(*layers, strict=True)),
        eta=eta,
        anisotropy=anisotropy,
        directions=directions,
    )


def _albedo_near_one(real: InputPrecision) -> str:
    deficit = np.logspace(-15, -1, 57)
    lost = dipole.absorbed_fraction(real(deficit), 1.4)
    rise = expect_rising(lost, label="1 - R_d")
    back = dipole.invert_to_deficit(1.0 - np.asarray(lost[deficit > 1e-12]), 1.4)
    # 1 - R_d has the absolute rounding eps of R_d, hence the relative error eps / (1 - R_d). The
    # deficit 1 - alpha' is proportional to the square of 1 - R_d near 1.
    rounding = np.finfo(np.float64).eps / np.asarray(lost[deficit > 1e-12])
    single = float(np.finfo(real.dtype).eps) * 4
    away = np.abs(back / np.asarray(real(deficit), np.float64)[deficit > 1e-12] - 1)
    if np.any(away > single + 8 * rounding):
        raise ExpectationError(
            f"inverse: got a relative error of {float(np.max(away)):.2g}, expected rounding"
        )
    return f"{rise}; inverse within {float(np.max(away)):.1g}"


def _least_step(real: InputPrecision) -> float:
    """Return the decimal exponent of the least 1 - R_d that a precision resolves."""
    return -6.5 if real.single else -9.0


def _reflectance_ends(real: InputPrecision) -> str:
    r_d = np.concatenate([np.logspace(-6, -1, 21), 1.0 - np.logspace(-1.2, _least_step(real), 21)])
    return expect_rising(-dipole.invert_to_deficit(real(r_d), 1.4), label="alpha' - 1")


def _all_light_back(real: InputPrecision) -> str:
    return expect_near(
        [dipole.total_reflectance(real(1.0), eta) for eta in (1.0, 1.3, 1.4, 1.6)],
        [1.0] * 4,
        absolute=0.0,
    )


def _more_than_all(real: InputPrecision) -> str:
    return expect_error(
        lambda: dipole.invert_total_reflectance(real(1.02), 1.4),
        dipole.ReflectanceOutlierError,
        "1.02",
    )


def _no_absorption(real: InputPrecision) -> str:
    r = real([0.1, 1.0, 10.0])
    clear = dipole.reflectance(r, real(0.0), real(1.0), 1.4)
    faint = dipole.reflectance(r, real(1e-12), real(1.0), 1.4)
    return expect_near(faint, clear, relative=1e-4)


def _black_medium(real: InputPrecision) -> str:
    inside = _layers(real, (1e3, 1.0, math.inf))
    layered = expect_within(inside, 0.0, 2e-3, label="R_d of layers")
    value = dipole.reflectance(real([0.0, 0.01, 0.1, 1.0, 10.0]), real(1e3), real(1.0), 1.4)
    expect_rising(-np.asarray(value, np.float64), strictly=False, label="-R(r)")
    # an albedo of 1/1001 per event leaves almost no reflected light
    total = dipole.total_reflectance(1.0 / 1001.0, 1.4)
    expect_within(total, 0.0, 2e-3, label="dipole's R_d")
    return layered + "; " + expect_within(value, 0.0, 1e3, label="R(r)")


def _radius_ends(real: InputPrecision) -> str:
    r = real([0.0, 1e-9, 1e-3, 1e2, 1e4])
    one = dipole.reflectance(r, real(0.02), real(1.0), 1.4)
    two = diffusion.reflectance(r, real(0.02), real(1.0), 1.4)
    expect_near(one[0], one[1], relative=1e-5)
    far = real([1e30])
    expect_within(dipole.reflectance(far, real(0.02), real(1.0), 1.4), 0.0, 0.0, label="at 1e30 mm")
    expect_error(
        lambda: dipole.reflectance(real(np.inf), real(0.02), real(1.0), 1.4),
        ValueError,
        "radius_mm",
    )
    expect_rising(-np.asarray(one, np.float64)[1:], strictly=False, label="-R(r)")
    return f"dipole {expect_within(one, 0.0, 10.0)}; diffusion {expect_within(two, -1e-9, 10.0)}"


def _index_ends(real: InputPrecision) -> str:
    found = [float(_layers(real, (0.01, 1.0, math.inf), eta=eta)) for eta in (1.0, 1.6)]
    if not found[0] > found[1]:
        raise ExpectationError(f"got {found}, expected less light to leave a denser medium")
    return expect_within(found, 0.3, 0.9, label="R_d at eta 1 and 1.6")


def _index_not_physical(real: InputPrecision) -> str:
    eta = float(real(0.9))
    return expect_error(
        lambda: tissue_optics.layer_stack_reflectance([0.01], [1.0], [math.inf], eta=eta),
        ValueError,
        "eta",
    )


def _thin_layer(real: InputPrecision) -> str:
    bare = _layers(real, (0.02, 1.5, math.inf))
    covered = _layers(real, (5.0, 1.5, 1e-9), (0.02, 1.5, math.inf))
    return expect_near(covered, bare, relative=1e-6)


def _no_layer_at_all(real: InputPrecision) -> str:
    clear = _layers(real, (0.0, 0.0, 1.0))
    surface = ((1.4 - 1.0) / (1.4 + 1.0)) ** 2
    # a clear pane: front transmittance squared times the back's reflectance, summed over all
    # internal reflections, F (1 - F)^2 / (1 - F^2)
    return expect_near(clear, surface * (1.0 - surface) ** 2 / (1.0 - surface**2), relative=1e-6)


def _stiff_layers(real: InputPrecision) -> str:
    fine, finer = (
        _layers(real, (60.0, 7.0, 0.25), (0.05, 3.5, math.inf), directions=n) for n in (16, 32)
    )
    return expect_near(fine, finer, relative=0.01)


def _conserving_layers(real: InputPrecision) -> str:
    white = _layers(real, (0.0, 5.0, 0.25), (0.0, 1.0, math.inf))
    entered = 1.0 - ((1.4 - 1.0) / (1.4 + 1.0)) ** 2  # all light but the specular reflection
    return expect_near(white, entered, absolute=2e-3)


def _forward_peak(real: InputPrecision) -> str:
    expect_error(lambda: _layers(real, (0.1, 1.0, 1.0), anisotropy=0.995), ValueError, "anisotropy")
    found = [
        [
            _layers(real, (sigma_a, 1.0, thickness), anisotropy=0.99, directions=directions)
            for sigma_a in (1e-3, 1.0, 50.0)
            for thickness in (0.01, 1.0, math.inf)
        ]
        for directions in (None, 64)
    ]
    expect_within(found[0], 1e-6, 1.0, label="R_d")
    return "g above 0.99 rejected; " + expect_near(found[0], found[1], relative=1e-4)


def _pigment_ends(real: InputPrecision) -> str:
    wavelength = real([400.0, 500.0, 600.0, 700.0])
    c_m, c_hd = real([0.0, 0.5])[:, None, None], real([0.0, 0.32])[:, None]
    value = tissue_optics.two_layer_reflectance(wavelength, c_m, c_hd)
    if not (np.all(value[0] > value[1]) and np.all(value[:, 0] >= value[:, 1])):
        raise ExpectationError("got a reflectance that rises with pigment, expected a fall")
    return expect_within(value, 1e-5, 0.95, label="R")


def _pigment_beyond(real: InputPrecision) -> str:
    return expect_error(
        lambda: tissue_optics.two_layer_reflectance(real(500.0), real(-0.01), real(0.05)),
        ValueError,
        "c_m",
    )


def _table_far(real: InputPrecision) -> str:
    expect_error(lambda: photon_table.reflectance(real(0.0), 0.05, 1.0), ValueError, "radius_mm")
    r = real([1e-4, 0.5, 20.0, 1e3])
    value = photon_table.reflectance(r, real(0.05), real(1.0))
    expect_rising(-value[:-1], label="-R(r)")
    return "r = 0 rejected; " + expect_within(value, 0.0, 1e6, label="R(r)")


def _profile_flat(real: InputPrecision) -> str:
    r = np.linspace(1.0, 15.0, 28)
    fit = subsurface.invert(r, real(np.full((1, 28), 1e-3)))
    expect_finite(fit.sigma_tr_per_mm, fit.valid, label="sigma_tr")
    return expect_valid_fraction(fit.valid)


def _profile_dark(real: InputPrecision) -> str:
    r = np.linspace(1.0, 15.0, 28)
    fit = subsurface.invert(r, real(np.zeros((1, 28))), variance=real(np.full((1, 28), 1e-12)))
    expect_finite(fit.sigma_tr_per_mm, fit.valid, label="sigma_tr")
    return expect_valid_fraction(fit.valid)


def _profile_broken(real: InputPrecision) -> str:
    r = np.linspace(1.0, 15.0, 28)
    truth = photon_table.reflectance(r, 0.08, 1.2)
    profile = real(np.stack([truth, truth]))
    profile[1, 5] = np.nan
    fit = subsurface.invert(r, profile, valid=np.isfinite(profile))
    both = np.asarray(fit.sigma_tr_per_mm)
    expect_valid_fraction(fit.valid, fraction_range=(1.0, 1.0))
    return expect_near(both[1], both[0], relative=5e-3)


def _profile_isotropic(real: InputPrecision) -> str:
    r = np.linspace(0.3, 7.05, 28)
    sigma_a, sigma_s = 0.1, np.array([[0.7], [1.5], [3.0]])
    profile = photon_table.reflectance(r, sigma_a, sigma_s, g=0.0)
    fit = subsurface.invert(r, real(profile), variance=real((0.01 * profile) ** 2))
    expect_finite(fit.sigma_tr_per_mm, fit.valid, label="sigma_tr")
    expect_valid_fraction(fit.valid, fraction_range=(0.0, 0.0))
    skin = photon_table.reflectance(r, sigma_a, sigma_s, g=0.8)
    usual = subsurface.invert(r, real(skin), variance=real((0.01 * skin) ** 2))
    return "isotropic: not valid; g = 0.8: " + expect_valid_fraction(
        usual.valid, fraction_range=(1.0, 1.0)
    )


def _one_photon(real: InputPrecision) -> str:
    stack = LayerStack((Layer(math.inf, 0.1, 10.0, 0.9, float(real(1.4))),))
    found = trace_photons(stack, photons=1, rng=np.random.default_rng(0))
    return expect_within(found.reflectance, 0.0, 1.0, label="fraction reflected")
