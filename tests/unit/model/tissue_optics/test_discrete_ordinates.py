"""Directions and phase functions of adding-doubling: limits, other methods, photons."""

from math import inf

import numpy as np
import pytest

from model.tissue_optics import discrete_ordinates
from model.tissue_optics.layers import TissueError, layer_stack_reflectance
from rigsim.tissue.tissue_mc import Layer, LayerStack, trace_photons

LIMIT = 1e-4
"""Stated relative error of the default directions."""
SIGMA_A, THICKNESS = (
    axis.reshape(-1, 1)
    for axis in np.meshgrid([1e-6, 0.1, 3.0, 40.0], [2e-3, 0.02, 0.3, 1.0, np.inf])
)


def reflectance(eta, g, directions=None):
    """Of weakly to strongly absorbing layers from 0.002 mean free paths to infinite thickness."""
    return layer_stack_reflectance(
        SIGMA_A, 1.0, THICKNESS, eta=eta, anisotropy=g, directions=directions
    )


@pytest.fixture
def sampled_phase(monkeypatch):
    """Sample every phase function at the directions instead of projecting it."""

    def clear():
        discrete_ordinates.phase_matrices.cache_clear()

    clear()
    monkeypatch.setattr(discrete_ordinates, "MAX_SAMPLED_ANISOTROPY", 1.0)
    yield
    clear()


@pytest.mark.parametrize(
    ("eta", "g"),
    [(1.0, 0.0), (1.4, 0.5), (1.4, 0.8), (1.4, 0.9), (1.33, 0.95), (1.5, 0.99), (1.1, 0.97)],
)
def test_default_directions_are_within_stated_limit(eta, g):
    found = reflectance(eta, g)
    np.testing.assert_allclose(found, reflectance(eta, g, 84), rtol=LIMIT)


@pytest.mark.parametrize(("g", "low"), [(0.9, 1e-3), (0.95, 5e-3), (0.99, 0.02)])
def test_twenty_sampled_directions_miss_the_limit(g, low, sampled_phase):
    few = reflectance(1.4, g, 20)
    assert np.max(1.0 - few / reflectance(1.4, g, 64)) > low / 2.0


def test_projected_and_sampled_phase_functions_agree(monkeypatch):
    projected = reflectance(1.4, 0.87)
    monkeypatch.setattr(discrete_ordinates, "MAX_SAMPLED_ANISOTROPY", 1.0)
    discrete_ordinates.phase_matrices.cache_clear()
    np.testing.assert_allclose(projected, reflectance(1.4, 0.87, 72), rtol=LIMIT)
    discrete_ordinates.phase_matrices.cache_clear()


@pytest.mark.long
@pytest.mark.parametrize("eta", [1.0, 1.02, 1.4])
def test_default_directions_serve_mixed_layers(eta, rng):
    for _ in range(2):
        g = tuple(rng.choice([0.0, 0.6, 0.85, 0.95, 0.99], 3))
        sigma_a = 10.0 ** rng.uniform(-3.0, 1.5, (8, 3))
        sigma_s = 10.0 ** rng.uniform(-1.0, 1.0, (8, 3))
        thickness = 10.0 ** rng.uniform(-2.0, 0.5, (8, 3))
        thickness[::2, 2] = np.inf

        def of(directions, stack=(sigma_a, sigma_s, thickness), g=g):
            return layer_stack_reflectance(*stack, eta=eta, anisotropy=g, directions=directions)

        np.testing.assert_allclose(of(None), of(76), rtol=LIMIT)


@pytest.mark.parametrize("eta", [1.0, 1.01, 1.4])
@pytest.mark.parametrize("g", [0.81, 0.9, 0.99])
def test_fewest_allowed_directions_keep_reflectance_positive(eta, g):
    default = discrete_ordinates.default_directions(eta, g)
    least = 2 * int(np.ceil(default / 3.0))
    found = reflectance(eta, g, least)
    assert np.all((found > 0.0) & (found < 1.0))
    with pytest.raises(TissueError, match=f"directions: got {least - 2}, expected at least"):
        reflectance(eta, g, least - 2)


@pytest.mark.parametrize("eta", [1.0, 1.4])
def test_projected_phase_function_conserves_energy_and_mean_cosine(eta):
    rule = discrete_ordinates.quadrature(eta, 40)
    even, odd = discrete_ordinates.phase_matrices(eta, 40, 0.97)
    np.testing.assert_allclose(even @ rule.weight, 1.0, rtol=1e-12)
    # odd orders act on the difference of downward and upward radiance, and l = 1 keeps g
    np.testing.assert_allclose(odd @ (rule.weight * rule.mu), 0.97 * rule.mu, rtol=1e-5)


def test_anisotropy_above_range_is_refused():
    with pytest.raises(TissueError, match=r"anisotropy: got 0\.993.* at most 0\.99"):
        reflectance(1.4, 0.993)
    with pytest.raises(TissueError, match=r"anisotropy.*0\.999"):
        reflectance(1.4, 0.9995)


def test_cost_of_skin_is_unchanged():
    # isotropic scattering and g = 0.8 at the index of skin, as color tables use them
    assert discrete_ordinates.default_directions(1.4, 0.0) == 12
    assert discrete_ordinates.default_directions(1.4, 0.8) == 20
    np.testing.assert_allclose(
        layer_stack_reflectance(
            np.array([0.05, 0.3, 3.0, 60.0])[:, None], [6.0, 3.0], [0.25, np.inf], anisotropy=0.8
        ),
        [0.568229306, 0.323424903, 0.071507263, 0.002364824],
        atol=1e-6,
    )


@pytest.mark.parametrize("thickness", [0.4, 3.0])
def test_clear_slab_back_reflection_is_specular_for_photons(thickness):
    # All photons are specular or not, so the standard error is that of a fraction.
    sigma_a, eta, photons = 0.3, 1.4, 200_000
    stack = LayerStack((Layer(thickness, sigma_a, 0.0, 0.0, eta),))
    run = trace_photons(stack, photons=photons, rng=np.random.default_rng(4))
    ours = float(layer_stack_reflectance([sigma_a], [0.0], [thickness], eta=eta))
    assert run.reflectance == 0.0
    error = 4.0 * np.sqrt(ours / photons)
    assert ours > 2.0 * error
    assert run.specular == pytest.approx(ours + stack.specular_reflectance, abs=error)


@pytest.mark.long
@pytest.mark.parametrize(("thickness", "sigma_a"), [(inf, 0.05), (0.5, 0.3)])
def test_photons_confirm_nearly_forward_scattering(thickness, sigma_a):
    # 20 sampled directions are 2 to 3 % low, which is 5 or more standard errors.
    run = trace_photons(
        LayerStack((Layer(thickness, sigma_a, 100.0, 0.99, 1.4),)),
        photons=300_000,
        rng=np.random.default_rng(2),
        engine="auto",
    )
    ours = layer_stack_reflectance([sigma_a], [1.0], [thickness], anisotropy=0.99)
    back = 0.0 if thickness == inf else run.specular - (0.4 / 2.4) ** 2
    assert run.reflectance_stderr < 0.005 * run.reflectance
    assert abs(run.reflectance + back - float(ours)) < 4.0 * run.reflectance_stderr
