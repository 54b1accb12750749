"""A perfect probe's reading of a phantom, and the uncertainty that its certificate leaves."""

import dataclasses

import numpy as np
import pytest

from capture.calibration.fiber.phantom import (
    CertificateError,
    CertificateUncertainty,
    PhantomCertificate,
)
from capture.rig import load_rig
from model import photon_table
from skinrig.calibrating.phantom_reflectance import expected_reflectance

GRAY = PhantomCertificate(
    eta=1.4,
    g=0.8,
    wavelength_nm=(550.0,),
    sigma_a_per_mm=(0.01,),
    sigma_s_prime_per_mm=(1.0,),
    uncertainty=CertificateUncertainty(0.03, 0.02),
)


@pytest.fixture(scope="module")
def rig():
    return load_rig("probe")


def test_gray_phantom_gives_table_reflectance_in_every_band(rig):
    expected = expected_reflectance(GRAY, rig)
    single = photon_table.reflectance(
        rig.probe.radius_mm, 0.01, 1.0, g=0.8, collection="fiber", core_mm=0.2, source_core_mm=0.2
    )
    np.testing.assert_allclose(expected.per_mm2, np.repeat(single[:, None], 3, axis=1), rtol=1e-9)
    flat = dataclasses.replace(
        GRAY,
        wavelength_nm=(400.0, 700.0),
        sigma_a_per_mm=(0.01, 0.01),
        sigma_s_prime_per_mm=(1.0, 1.0),
    )
    np.testing.assert_allclose(expected_reflectance(flat, rig).per_mm2, expected.per_mm2, rtol=1e-9)


def test_blue_absorbing_phantom_gives_less_blue(rig):
    paper = dataclasses.replace(
        GRAY,
        wavelength_nm=(400.0, 700.0),
        sigma_a_per_mm=(0.1, 0.002),
        sigma_s_prime_per_mm=(1.0, 1.0),
    )
    far = expected_reflectance(paper, rig).per_mm2[-1]
    assert far[0] > far[1] > far[2]


def test_uncertainty_moves_fibers_like_other_coefficients(rig):
    expected = expected_reflectance(GRAY, rig)
    for number, name in enumerate(("sigma_a_per_mm", "sigma_s_prime_per_mm")):
        step = 1e-3
        more = dataclasses.replace(GRAY, **{name: ((1 + step) * getattr(GRAY, name)[0],)})
        change = (expected_reflectance(more, rig).per_mm2 / expected.per_mm2 - 1) / step
        unsure = (0.03, 0.02)[number]
        np.testing.assert_allclose(expected.common[number], unsure * change, rtol=0.02, atol=2e-4)


def test_a_phantom_outside_of_the_table_is_refused(rig):
    with pytest.raises(CertificateError, match="outside the photon table"):
        expected_reflectance(dataclasses.replace(GRAY, sigma_a_per_mm=(500.0,)), rig)
    with pytest.raises(CertificateError, match="eta"):
        expected_reflectance(dataclasses.replace(GRAY, eta=1.9), rig)
    short = dataclasses.replace(
        GRAY,
        wavelength_nm=(500.0, 600.0),
        sigma_a_per_mm=(0.01, 0.01),
        sigma_s_prime_per_mm=(1.0, 1.0),
    )
    with pytest.raises(CertificateError, match="400"):
        expected_reflectance(short, rig)
