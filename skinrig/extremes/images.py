"""Extremes of images: exposures, polarizers, chromophores."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from capture import hdr
from model import color_table
from reconstruction import chromophores, polarization
from skinrig.extremes.expectations import (
    ExpectationError,
    expect_error,
    expect_finite,
    expect_near,
    expect_valid_fraction,
    expect_within,
)
from skinrig.extremes.inputs import InputPrecision

if TYPE_CHECKING:
    from model.color_table import ColorTable

_SENSOR_SETTINGS = {"gain": 0.5, "read_noise": 3.0, "black": 512.0, "white": 16383.0}
EXPOSURES_S = (1.0, 0.25, 0.0625)


def _merged(dn: NDArray[np.integer]) -> tuple[NDArray[Any], ...]:
    radiance, variance, valid = hdr.merge(dn, EXPOSURES_S, **_SENSOR_SETTINGS)
    expect_finite(radiance, valid, label="radiance")
    expect_finite(variance, valid, label="variance")
    return radiance, variance, valid


def _all_saturated(_: InputPrecision) -> str:
    return expect_valid_fraction(_merged(np.full((3, 4, 4), 16383, np.uint16))[2])


def _all_black(_: InputPrecision) -> str:
    radiance, _variance, valid = _merged(np.full((3, 4, 4), 512, np.uint16))
    expect_valid_fraction(valid, fraction_range=(1.0, 1.0))
    return expect_within(radiance, -1e-9, 1e-9, label="radiance")


def _below_black(_: InputPrecision) -> str:
    # noise minus the black level is negative in half of the pixels; a clamp would bias the mean
    rng = np.random.default_rng(3)
    dn = np.clip(np.round(512 + rng.normal(0, 6, (3, 128, 128))), 0, None).astype(np.uint16)
    radiance, variance, _valid = _merged(dn)
    z = float(radiance.mean() / np.sqrt(variance.mean() / radiance.size))
    if not np.any(radiance < 0):
        raise ExpectationError("got no negative radiance, expected noise around 0: it was clamped")
    return f"mean {z:.2g} standard errors from 0: " + expect_within(z, -4.0, 4.0, label="z")


def _full_scale(_: InputPrecision) -> str:
    dn = np.full((1, 2, 2), 65534, np.uint16)
    radiance, _variance, valid = hdr.merge(
        dn, [2.0], gain=0.5, read_noise=3.0, black=0.0, white=65535.0
    )
    expect_valid_fraction(valid, fraction_range=(1.0, 1.0))
    return expect_near(radiance, np.full((2, 2), 0.5 * 65534.0), relative=1e-6)


def _one_by_one(_: InputPrecision) -> str:
    radiance, _variance, valid = _merged(np.array([[[9000]], [[2634]], [[1042]]], np.uint16))
    expect_valid_fraction(valid, fraction_range=(1.0, 1.0))
    return expect_within(radiance, 8000.0, 9000.0, label="radiance")


def _one_electron(_: InputPrecision) -> str:
    rng = np.random.default_rng(5)
    frames = [
        np.round(512 + (rng.poisson(1.0 * t, (256, 256)) + rng.normal(0, 3, (256, 256))) / 0.5)
        for t in EXPOSURES_S
    ]
    radiance, variance, valid = _merged(np.clip(np.array(frames), 0, None).astype(np.uint16))
    expect_valid_fraction(valid, fraction_range=(1.0, 1.0))
    # one electron per second at a gain of 0.5 e-/DN is two DN per second
    z = float((radiance.mean() - 2.0) / np.sqrt(variance.mean() / radiance.size))
    return f"mean {z:.2g} standard errors from one electron: " + expect_within(
        z, -4.0, 4.0, label="z"
    )


def _not_polarized(real: InputPrecision) -> str:
    same = real(np.full((2, 2, 3), 0.3))
    found = polarization.separate(same, same)
    return expect_near(found.specular, np.zeros((2, 2, 3)), absolute=1e-6)


def _useless_polarizer(real: InputPrecision) -> str:
    same = real(np.full((2, 2, 3), 0.3))
    return expect_error(lambda: polarization.separate(same, same, extinction=1.0), ValueError, "1")


def _not_a_number(real: InputPrecision) -> str:
    one, other = (real(np.full((2, 2, 3), v)) for v in (0.5, 0.2))
    one[0, 0] = np.nan
    other[1, 1] = np.inf
    found = polarization.separate(one, other)
    expect_finite(found.diffuse, found.valid, label="diffuse")
    return expect_valid_fraction(found.valid, fraction_range=(0.5, 0.5))


def _table() -> ColorTable:
    return color_table.build("Nikon 5100 (NPL)", "D55", size=32, exact_optics=True)


def _black_pixels(real: InputPrecision) -> str:
    found = chromophores.invert(real(np.zeros((4, 3))), _table())
    expect_finite(found.melanin, found.valid, label="melanin")
    return expect_valid_fraction(found.valid)


def _odd_colors(real: InputPrecision) -> str:
    not_skin = [[0, 0, 1], [0, 1, 0], [-0.2, 0.1, 0.1], [np.nan, 0.3, 0.2], [np.inf, 1, 1]]
    rgb = real(np.array(not_skin))
    variance = real(np.full((5, 3), 1e-6))
    found = chromophores.invert(rgb, _table(), shading="known", variance=variance)
    expect_finite(found.melanin, found.valid, label="melanin")
    expect_finite(found.hemoglobin, found.valid, label="hemoglobin")
    return expect_valid_fraction(found.valid)


def _pigment_corners(real: InputPrecision) -> str:
    table = _table()
    c_m, c_hd = np.array([0.0, 0.0, 0.5, 0.5]), np.array([0.0, 0.32, 0.0, 0.32])
    found = chromophores.invert(real(table.lookup(c_m, c_hd)), table, shading="known")
    expect_near(found.melanin, c_m, absolute=2e-3)
    expect_near(found.hemoglobin[:2], c_hd[:2], absolute=2e-3)
    # that much melanin hides the blood: the stated error of hemoglobin must be large
    off = np.abs(found.hemoglobin[2:] - c_hd[2:]) / found.stderr_hemoglobin[2:]
    expect_within(
        found.stderr_hemoglobin[2:], 0.003, 1.0, label="standard error of hidden hemoglobin"
    )
    return "melanin and visible hemoglobin exact; error of the hidden " + expect_within(
        off, 0.0, 3.0, label="standard errors"
    )


def _tiny_light(real: InputPrecision) -> str:
    table = _table()
    rgb = table.lookup(np.array([0.03]), np.array([0.05]))
    found = chromophores.invert(real(1e-5 * rgb), table)
    plain = chromophores.invert(real(rgb), table)
    return expect_near(found.melanin, plain.melanin, relative=0.02)


def _no_pixel(real: InputPrecision) -> str:
    found = chromophores.invert(real(np.zeros((0, 3))), _table())
    if found.melanin.shape != (0,):
        raise ExpectationError(f"got shape {found.melanin.shape}, expected (0,)")
    return "an empty map"
