"""Reflectance of plane layers against published anchors, exact theory and a peer code."""

import iadpython
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model import fresnel
from model.tissue_optics.layers import TissueError, layer_stack_reflectance

TIERS = ["adding_doubling", "diffusion"]


def h_function_at_1(albedo):
    """Solve Chandrasekhar's equation for isotropic scattering and return H(1)."""
    node, weight = np.polynomial.legendre.leggauss(120)
    mu = (0.5 * (node + 1.0)) ** 2  # finer near 0, where H is steep
    weight = weight * np.sqrt(mu)
    h = np.ones_like(mu)
    for _ in range(4000):
        inverse = np.sqrt(1 - albedo) + albedo / 2 * (weight * mu * h / (mu + mu[:, None])).sum(1)
        h, change = 1.0 / inverse, np.max(np.abs(1.0 / inverse - h))
        if change < 1e-14:
            break
    return 1.0 / (np.sqrt(1 - albedo) + albedo / 2 * np.sum(weight * mu * h / (mu + 1.0)))


@pytest.mark.parametrize("albedo", [0.3, 0.7, 0.9, 0.98, 0.999])
def test_matched_half_space_reflectance_matches_h_function(albedo):
    # Exact: R = 1 - sqrt(1 - a) H(1) for a beam at normal incidence.
    ours = layer_stack_reflectance([1 - albedo], [albedo], [np.inf], eta=1.0)
    assert ours == pytest.approx(1 - np.sqrt(1 - albedo) * h_function_at_1(albedo), abs=1e-7)


def test_giovanelli_half_space_with_a_glass_like_surface():
    ours = layer_stack_reflectance([1.0], [9.0], [np.inf], eta=1.5)
    assert ours + fresnel.normal_reflectance(1.5) == pytest.approx(0.2600, abs=2e-4)


def test_van_de_hulst_slab_with_forward_scattering():
    ours = layer_stack_reflectance(
        [10.0], [90.0 * 0.25], [0.02], eta=1.0, anisotropy=0.75, directions=16
    )
    assert ours == pytest.approx(0.09739, abs=1e-5)


@pytest.mark.parametrize("directions", [None, 32])
def test_the_three_layer_sample_of_mcml(directions):
    # One million photons: the published value has a standard error of 0.0004.
    ours = layer_stack_reflectance(
        [1.0, 1.0, 2.0],
        [10.0, 10.0, 3.0],
        [0.1, 0.1, 0.2],
        eta=1.37,
        anisotropy=(0.9, 0.0, 0.7),
        directions=directions,
    )
    assert ours == pytest.approx(0.237544, abs=3 * 0.00043)


@pytest.mark.parametrize(
    ("sigma_a", "sigma_s_prime", "transport"),
    [(0.032, 0.74, 0.4316), (0.17, 0.88, 0.2098), (0.48, 1.01, 0.1138)],
)
def test_jensen_skin1_reflectance_matches_transport(sigma_a, sigma_s_prime, transport):
    ours = layer_stack_reflectance([sigma_a], [sigma_s_prime], [np.inf], eta=1.3)
    assert ours == pytest.approx(transport, rel=4e-3)


def test_random_stacks_agree_with_the_peer_code(rng):
    # The peer works with 16 directions that ignore the square root at the critical angle: its own
    # error is a few 1e-4, measured by doubling its directions.
    for _ in range(6):
        layers = int(rng.integers(1, 4))
        sigma_a = rng.uniform(0.02, 3.0, layers)
        sigma_s = rng.uniform(0.5, 12.0, layers)
        thickness = rng.uniform(0.05, 1.0, layers)
        total = sigma_a + sigma_s
        peer = iadpython.Sample(
            a=(sigma_s / total)[::-1],
            b=(total * thickness)[::-1],
            g=np.zeros(layers),
            d=1.0,
            n=1.4,
            quad_pts=16,
        )
        matrices = peer.rt_matrices()
        ur1 = float(peer.UX1_and_UXU(matrices[0], matrices[2])[0])
        ours = layer_stack_reflectance(sigma_a, sigma_s, thickness, eta=1.4)
        assert ours == pytest.approx(ur1 - fresnel.normal_reflectance(1.4), abs=6e-4)


def test_twelve_directions_are_within_three_millionths_of_limit():
    sigma_a = np.array([[0.05, 0.3], [5.0, 0.1], [60.0, 1.0]])
    few = layer_stack_reflectance(sigma_a, [6.0, 3.0], [0.25, np.inf])
    many = layer_stack_reflectance(sigma_a, [6.0, 3.0], [0.25, np.inf], directions=40)
    np.testing.assert_allclose(few, many, rtol=5e-6)


@pytest.mark.parametrize("tier", TIERS)
@pytest.mark.parametrize("eta", [1.0, 1.4])
def test_nonabsorbing_half_space_returns_all_entering_light(tier, eta):
    ours = layer_stack_reflectance([0.0], [4.0], [np.inf], eta=eta, tier=tier)
    assert ours == pytest.approx(1.0 - fresnel.normal_reflectance(eta), abs=2e-6)


def test_forward_scattering_converges_as_stated():
    # Skin at 400, 550 and 700 nm and C_m = 0.5, where light scatters once or twice before it ends.
    sigma_a = np.array([[70.0, 5.0], [25.0, 0.8], [8.5, 0.1]])
    stack = sigma_a, [9.0, 4.5], [0.25, np.inf]
    limit = layer_stack_reflectance(*stack, anisotropy=0.8, directions=48)
    for directions, error in ((12, 1.6e-3), (16, 3e-4), (20, 7e-5), (24, 1.5e-5)):
        ours = layer_stack_reflectance(*stack, anisotropy=0.8, directions=directions)
        np.testing.assert_allclose(ours, limit, rtol=error)


@pytest.mark.parametrize("anisotropy", [0.5, 0.8, 0.95])
def test_forward_scattering_loses_no_energy(anisotropy):
    ours = layer_stack_reflectance([0.0], [4.0], [np.inf], anisotropy=anisotropy)
    assert ours == pytest.approx(1.0 - fresnel.normal_reflectance(1.4), abs=2e-6)


@pytest.mark.parametrize("tier", TIERS)
@pytest.mark.parametrize(
    ("sigma_a", "thickness"), [(0.0, np.inf), (0.0, 1.0), (2.0, np.inf), (2.0, 0.5)]
)
def test_nonscattering_layers_with_matched_surface_return_nothing(tier, sigma_a, thickness):
    ours = layer_stack_reflectance([sigma_a], [0.0], [thickness], eta=1.0, tier=tier)
    assert ours == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("tier", TIERS)
def test_a_layer_of_no_thickness_changes_nothing(tier):
    with_film = layer_stack_reflectance([50.0, 0.2], [9.0, 3.0], [0.0, np.inf], tier=tier)
    alone = layer_stack_reflectance([0.2], [3.0], [np.inf], tier=tier)
    assert with_film == pytest.approx(float(alone), rel=1e-5)


@pytest.mark.parametrize("tier", TIERS)
def test_clear_layer_on_matched_half_space_changes_nothing(tier):
    covered = layer_stack_reflectance([0.0, 0.2], [0.0, 3.0], [0.7, np.inf], tier=tier, eta=1.0)
    alone = layer_stack_reflectance([0.2], [3.0], [np.inf], tier=tier, eta=1.0)
    # Diffuse light is attenuated nowhere in a clear layer; diffusion has no such thing as a
    # clear layer's geometry and must agree too.
    assert covered == pytest.approx(float(alone), rel=1e-6)


@pytest.mark.parametrize("tier", TIERS)
def test_layer_split_in_pieces_reflects_as_whole(tier):
    whole = layer_stack_reflectance([0.4, 0.1], [6.0, 2.0], [0.3, np.inf], tier=tier)
    cut = layer_stack_reflectance(
        [0.4, 0.4, 0.1, 0.1], [6.0, 6.0, 2.0, 2.0], [0.1, 0.2, 1.7, np.inf], tier=tier
    )
    assert cut == pytest.approx(float(whole), rel=1e-9)


@pytest.mark.parametrize("tier", TIERS)
def test_a_deep_layer_is_a_half_space(tier):
    deep = layer_stack_reflectance([0.05], [2.0], [1e4], tier=tier)
    half_space = layer_stack_reflectance([0.05], [2.0], [np.inf], tier=tier)
    assert deep == pytest.approx(float(half_space), rel=1e-9)


@pytest.mark.parametrize("tier", TIERS)
def test_stiff_and_resonant_layers_stay_finite(tier):
    # 140/mm of melanin at 400 nm; sigma_a = sigma_t / 3 makes kappa equal to the extinction.
    sigma_a = np.array([[70.0, 40.0], [500.0, 0.0], [1.0, 1.0], [0.0, 1e-12]])
    ours = layer_stack_reflectance(sigma_a, [12.0, 2.0], [0.25, np.inf], tier=tier)
    assert np.isfinite(ours).all()
    resonant = layer_stack_reflectance(
        np.array([[1.0 - 1e-7], [1.0], [1.0 + 1e-7]]), [2.0], [3.0], tier=tier
    )
    assert np.ptp(resonant) < 1e-6


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.floats(0.0, 100.0), st.floats(0.0, 50.0), st.one_of(st.just(0.0), st.floats(0, 5))
        ),
        min_size=1,
        max_size=3,
    ),
    st.floats(1.0, 1.6),
    st.sampled_from(TIERS),
)
def test_reflectance_is_fraction_decreasing_with_any_absorption(layers, eta, tier):
    sigma_a, sigma_s, thickness = (np.array(column) for column in zip(*layers, strict=True))
    before = layer_stack_reflectance(sigma_a, sigma_s, thickness, eta=eta, tier=tier)
    assert -1e-9 <= before <= 1.0 + 1e-9
    for layer in range(sigma_a.size):
        darker = sigma_a.copy()
        darker[layer] = darker[layer] * 1.05 + 0.01
        after = layer_stack_reflectance(darker, sigma_s, thickness, eta=eta, tier=tier)
        if tier == "adding_doubling":
            assert after <= before + 1e-9


def test_leading_axes_broadcast_like_loop_inputs_unmodified():
    sigma_a = np.array([[[0.1, 0.2]], [[1.0, 2.0]]])
    sigma_s = np.array([[[6.0, 3.0], [8.0, 4.0], [2.0, 1.0]]])
    kept = sigma_a.copy()
    thickness = np.array([0.25, np.inf])
    ours = layer_stack_reflectance(sigma_a, sigma_s, thickness)
    assert ours.shape == (2, 3)
    loop = [[layer_stack_reflectance(a, s, thickness) for s in sigma_s[0]] for a in sigma_a[:, 0]]
    np.testing.assert_allclose(ours, loop, rtol=1e-12)
    np.testing.assert_array_equal(sigma_a, kept)


def test_diffusion_is_close_to_transport_where_scattering_dominates():
    stack = [0.005, 0.01], [8.0, 4.0], [0.25, np.inf]
    fast = layer_stack_reflectance(*stack, tier="diffusion")
    assert fast == pytest.approx(float(layer_stack_reflectance(*stack)), rel=0.02)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([-0.1], [1.0], [1.0]), "sigma_a_per_mm.*-0.1"),
        (([0.1], [np.nan], [1.0]), "sigma_s_prime_per_mm.*nan"),
        (([0.1, 0.1], [1.0, 1.0], [np.inf, 1.0]), "only the last"),
        (([0.1], [np.inf], [1.0]), "sigma_s_prime_per_mm"),
    ],
)
def test_impossible_layers_are_refused_by_name(arguments, message):
    with pytest.raises(TissueError, match=message):
        layer_stack_reflectance(*arguments)


def test_an_unknown_tier_is_refused():
    with pytest.raises(TissueError, match="adding_doubling, diffusion"):
        layer_stack_reflectance([0.1], [1.0], [1.0], tier="exact")
