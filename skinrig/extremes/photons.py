"""Extremes of photon random walks: no absorption, only absorption, thin and stiff layers."""

import math

import numpy as np

from model import tissue_optics
from rigsim.tissue.tissue_mc import Layer, LayerStack, trace_photons
from skinrig.extremes.expectations import ExpectationError, expect_near, expect_within
from skinrig.extremes.inputs import InputPrecision

Matter = tuple[float, float, float, float]
"""Thickness, sigma_a, sigma_s (mm, 1/mm) and g."""


def _walked(real: InputPrecision, *layers: Matter, eta: float = 1.4, photons: int = 40_000):  # type: ignore[no-untyped-def]
    """Trace photons through layers; check their energy balance and return the result."""
    made = []
    for one in layers:
        depth, absorption, scattering, g = (float(real(value)) for value in one)
        made.append(Layer(depth, absorption, scattering, g, float(real(eta))))
    stack = LayerStack(tuple(made))
    found = trace_photons(stack, photons=photons, rng=np.random.default_rng(7))
    expect_near(found.balance, 1.0, absolute=1e-9)
    return found


def _z_of_layers(real: InputPrecision, *layers: Matter, eta: float = 1.4) -> str:
    """Compare walks with the adding-doubling reflectance, in standard errors."""
    depth, absorption, scattering, g = np.array(layers, np.float64).T
    if np.any(g != 0.0):
        raise ValueError(
            f"g: got {g.tolist()}, expected 0, for which sigma_s' is sigma_s; use isotropic layers"
        )
    found = _walked(real, *layers, eta=eta)
    layered = float(
        tissue_optics.layer_stack_reflectance(
            real(absorption), real(scattering), real(depth), eta=float(real(eta)), directions=32
        )
    )
    # adding-doubling itself has an error of about 0.5 % of the reflectance
    error = math.hypot(found.reflectance_stderr, 0.005 * layered)
    z = (found.reflectance - layered) / error
    return f"R {found.reflectance:.4g}, layers {layered:.4g}: " + expect_within(
        z, -4.0, 4.0, label="z"
    )


def _nothing_absorbed(real: InputPrecision) -> str:
    returned = []
    for absorption in (0.0, 1e-30, 1e-12):
        found = _walked(real, (1.0, absorption, 10.0, 0.9), photons=4000)
        expect_within(found.absorbed, 0.0, 1e-9, label="absorbed")
        expect_near(found.specular + found.reflectance + found.transmittance, 1.0, absolute=1e-9)
        returned.append(found.reflectance + found.transmittance)
    return expect_within(returned, 0.9, 1.0, label="R + T")


def _all_absorbed(real: InputPrecision) -> str:
    found = _walked(real, (math.inf, 1e3, 1.0, 0.0))
    surface = (0.4 / 2.4) ** 2
    expect_near(found.specular, surface, relative=1e-6)
    expect_near(found.absorbed.sum(), 1.0 - surface, relative=1e-3)
    return expect_within(found.reflectance, 0.0, 5e-4, label="R")


def _albedo_to_one(real: InputPrecision) -> str:
    return _z_of_layers(real, (20.0, 1e-5, 1.0, 0.0))


def _thin(real: InputPrecision) -> str:
    bare = _walked(real, (math.inf, 0.2, 1.5, 0.0))
    covered = _walked(real, (1e-7, 50.0, 1.5, 0.0), (math.inf, 0.2, 1.5, 0.0))
    error = math.hypot(bare.reflectance_stderr, covered.reflectance_stderr)
    if error <= 0.0:
        raise ExpectationError(f"got a standard error of {error:g}, expected a positive one")
    expect_within(covered.absorbed[0], 0.0, 1e-4, label="absorbed by the film")
    z = (covered.reflectance - bare.reflectance) / error
    return expect_within(z, -4.0, 4.0, label="z")


def _stiff(real: InputPrecision) -> str:
    return _z_of_layers(real, (0.25, 60.0, 7.0, 0.0), (math.inf, 0.05, 3.5, 0.0))


def _stiff_below(real: InputPrecision) -> str:
    return _z_of_layers(real, (0.25, 0.001, 7.0, 0.0), (math.inf, 60.0, 3.5, 0.0))


def _no_boundary(real: InputPrecision) -> str:
    return _z_of_layers(real, (math.inf, 0.05, 1.5, 0.0), eta=1.0)


def _strong_boundary(real: InputPrecision) -> str:
    return _z_of_layers(real, (math.inf, 0.05, 1.5, 0.0), eta=1.6)
