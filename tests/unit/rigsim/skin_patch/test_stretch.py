import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from rigsim.skin_patch import equilibrium
from rigsim.skin_patch.equilibrium import (
    EquilibriumError,
    LayerProblem,
    find_equilibrium,
    surface_rise_factor,
)
from rigsim.skin_patch.microrelief import SITE_NAMES, MicroSkin, make_micro_skin
from rigsim.skin_patch.stretch import (
    Compensation,
    StretchedSkin,
    StretchError,
    layer_problem,
    mean_gradient,
    principal_stretches,
    required_size_mm,
    stretch_skin,
)
from rigsim.skin_patch.stretch_kernels import (
    LEAST_LOG_AREA,
    add_bending_forces,
    add_membrane_forces,
    find_least_area,
)
from rigsim.subject.person_skin import SiteSkin
from rigsim.tissue.skin_layers import TYPICAL_SKIN

Floats = NDArray[np.float64]

SERIES = (0.73, 0.8, 0.9, 1.0, 1.12, 1.28)


ONE_NOW = ["cheek", *(pytest.param(s, marks=pytest.mark.long) for s in SITE_NAMES if s != "cheek")]
"""Every site, all but one in the long tests."""


def patch(height: Floats, *, layer_um: float = 8.0, texel_um: float = 10.0) -> MicroSkin:
    """Return a bare patch of uniform layer."""
    even = np.full(height.shape, 1.0, np.float32)
    return MicroSkin(
        site="cheek",
        seed=0,
        skin=SiteSkin(0.03, 0.01, TYPICAL_SKIN),
        texel_um=texel_um,
        height_um=height.astype(np.float32),
        albedo=0.3 * even,
        alpha=0.2 * even,
        layer_um=layer_um * even,
        stiffness_ratio=2.0,
        poisson=0.2,
    )


def slopes_along(state: StretchedSkin, half_mm: float = 0.35) -> Floats:
    """Return slopes along the jaws over the same piece of skin in every state."""
    grid = np.arange(-half_mm, half_mm, 0.007)
    x, y = np.meshgrid(grid, -grid)
    place = np.stack([x, y], -1) @ state.gradient.T
    found = state.sample(place[..., 0], place[..., 1])
    assert found.inside.all()
    angle = np.radians(state.angle_deg)
    return np.asarray(np.cos(angle) * found.slope_x + np.sin(angle) * found.slope_y, np.float64)


def problem_of(rng: np.random.Generator, *, gradient: Floats | None = None) -> LayerProblem:
    shape = (12, 16)
    return LayerProblem(
        neutral_um=3.0 * rng.standard_normal(shape),
        membrane_um=5.0 + rng.random(shape),
        bending_um3=200.0 + 50.0 * rng.random(shape),
        texel_um=10.0,
        gradient=np.array([[0.8, 0.04], [0.02, 1.1]]) if gradient is None else gradient,
        poisson=0.3,
    )


@pytest.mark.parametrize(("deviation_um", "inverted"), [(0.8, False), (6.0, True)])
def test_the_membranes_energy_is_that_of_its_metric(
    rng: np.random.Generator, deviation_um: float, inverted: bool
) -> None:
    # Plain NumPy, by metric tensors, of the same flat elements.
    p = problem_of(rng)
    v = p.affine() + deviation_um * rng.standard_normal((3, 12, 16))
    force = np.zeros_like(v)
    bulk = 3.0
    got = add_membrane_forces(v, p.neutral_um, p.membrane_um, p.gradient, bulk, p.texel_um, force)
    expected, least = 0.0, np.inf
    whole = np.linalg.det(p.gradient)

    def edge(a: Floats, axis: int, side: int) -> Floats:
        # Over a square's side: its edge along `axis` at the near (0) or far (1) other index.
        shifted = np.roll(a, -side, 1 - axis)
        return np.asarray((np.roll(shifted, -1, axis) - shifted) / p.texel_um)

    m = p.membrane_um
    square = 0.25 * (m + np.roll(m, -1, 0) + np.roll(m, -1, 1) + np.roll(m, (-1, -1), (0, 1)))
    for below in (0, 1):
        for left in (0, 1):
            a = np.stack([edge(c, 1, below) for c in v], -1)
            b = np.stack([edge(c, 0, left) for c in v], -1)
            a[..., :2] += p.gradient[:, 0]
            b[..., :2] += p.gradient[:, 1]
            first = np.stack([a, b], -1)
            slope = np.stack([edge(p.neutral_um, 1, below), edge(p.neutral_um, 0, left)], -1)
            g0 = np.eye(2) + slope[..., :, None] * slope[..., None, :]
            c = np.linalg.solve(g0, np.swapaxes(first, -1, -2) @ first)
            trace, det = np.trace(c, axis1=-2, axis2=-1), np.linalg.det(c)
            w = 0.5 * np.sqrt(np.linalg.det(g0)) * (trace + 1.0 / det - 3.0)
            j = np.linalg.det(first[..., :2, :]) / whole
            # Taylor's parabola of -log J below 0.05
            low, off = np.maximum(j, LEAST_LOG_AREA), np.minimum(j / LEAST_LOG_AREA - 1.0, 0.0)
            minus_log = -np.log(low) - off + 0.5 * off**2
            expected += 0.25 * float(np.sum(square * w + bulk * (j - 1.0 + minus_log)))
            least = min(least, float(j.min()))
    assert (least < -0.1) == inverted
    assert find_least_area(v, p.gradient, p.texel_um) == pytest.approx(least, rel=1e-10)
    assert got == pytest.approx(expected, rel=1e-10)


def test_inverted_elements_are_pushed_back_smoothly(rng: np.random.Generator) -> None:
    p = problem_of(rng)
    start = p.affine()

    def energy(push_um: float) -> tuple[float, float]:
        v, force = start.copy(), np.zeros_like(start)
        v[0, 3, 3] += push_um
        given = p.neutral_um, p.membrane_um, p.gradient, 1e3, p.texel_um
        return add_membrane_forces(v, *given, force), float(force[0, 3, 3])

    for push_um in np.linspace(0.0, 30.0, 61):  # elements are inverted beyond 8 um
        (after, _), (before, _) = energy(push_um + 1e-4), energy(push_um - 1e-4)
        assert energy(push_um)[1] == pytest.approx((after - before) / 2e-4, rel=1e-3, abs=0.02)
    energies = [energy(push_um)[0] for push_um in (0.0, 8.0, 16.0, 30.0)]
    assert np.isfinite(energies).all()
    assert (np.diff(energies) > 0).all()


def test_inverted_result_is_refused(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(equilibrium, "find_least_area", lambda *_: -0.1)
    with pytest.raises(EquilibriumError, match="folds over"):
        find_equilibrium(problem_of(rng), tolerance=5e-3)


def test_bending_costs_nothing_at_the_neutral_curvature(rng: np.random.Generator) -> None:
    p = problem_of(rng)
    work, force = np.empty((12, 16)), np.zeros((12, 16))
    assert add_bending_forces(p.neutral_um, p.neutral_um, p.bending_um3, 10.0, work, force) == 0.0
    w = p.neutral_um + rng.standard_normal((12, 16))
    d = w - p.neutral_um
    laplacian = sum(np.roll(d, s, a) for s in (1, -1) for a in (0, 1)) - 4.0 * d
    expected = 0.5 * np.sum(p.bending_um3 * (laplacian / 100.0) ** 2)
    assert add_bending_forces(w, p.neutral_um, p.bending_um3, 10.0, work, force) == pytest.approx(
        expected
    )


def test_forces_are_the_energys_derivative_by_finite_differences(rng: np.random.Generator) -> None:
    p = problem_of(rng)
    v = p.affine() + 0.5 * rng.standard_normal((3, 12, 16))
    _, force = p.energy(v)
    for _ in range(5):
        d = rng.standard_normal(v.shape)
        step = 1e-4
        slope = (p.energy(v + step * d)[0] - p.energy(v - step * d)[0]) / (2.0 * step)
        assert slope == pytest.approx(float(np.vdot(force, d)) / p.neutral_um.size, rel=1e-6)


def test_fourier_coefficients_have_the_nodes_energy_and_derivative(
    rng: np.random.Generator,
) -> None:
    p = problem_of(rng)
    q = 0.002 * np.fft.rfft2(rng.standard_normal((3, 12, 16)))
    d = 0.002 * np.fft.rfft2(rng.standard_normal((3, 12, 16)))
    energy, slope = p.value(q)
    assert energy == pytest.approx(p.energy(p.state(q))[0], rel=1e-9)
    assert energy < 1e100
    step = 1e-3
    numeric = (p.value(q + step * d)[0] - p.value(q - step * d)[0]) / (2.0 * step)
    assert numeric == pytest.approx(float(np.vdot(slope, d).real), rel=1e-5)


def test_tissue_under_pressure_wave_moves_as_half_space(rng: np.random.Generator) -> None:
    # Johnson 1985: under p cos kx upwards, u_z = (1 - nu) p cos kx / (mu k) and
    # u_x = (1 - 2 nu) p sin kx / (2 mu k): points move away from where the surface is lifted.
    p = problem_of(rng, gradient=np.eye(2))
    none = dataclasses.replace(
        p,
        neutral_um=0.0 * p.neutral_um,
        membrane_um=1e-12 * p.membrane_um,
        bending_um3=1e-12 * p.bending_um3,
    )
    none._bulk = 0.0
    k, mu, nu = 2.0 * np.pi / 160.0, 0.5 / 1.3, 0.3
    x = 10.0 * np.arange(16)
    state = np.zeros((3, 12, 16))
    state[0] = (1.0 - 2.0 * nu) / (2.0 * mu * k) * np.sin(k * x)
    state[2] = (1.0 - nu) / (mu * k) * np.cos(k * x)
    _, force = none.energy(1e-3 * state)
    np.testing.assert_allclose(force[2], 1e-3 * np.cos(k * x)[None, :].repeat(12, 0), atol=1e-9)
    np.testing.assert_allclose(force[:2], 0.0, atol=1e-9)


def test_free_surface_rises_until_stress_free() -> None:
    assert surface_rise_factor(1.3, 1.0, 0.5) == pytest.approx(1.0 / 1.3)
    for nu in (0.1, 0.2, 0.45):
        z = surface_rise_factor(0.7, 1.1, nu)
        lame = 2.0 * nu / (1.0 - 2.0 * nu)
        assert z - 1.0 / z + lame * np.log(0.7 * 1.1 * z) / z == pytest.approx(0.0, abs=1e-10)
        assert 1.0 < z < 1.0 / 0.77


@pytest.mark.parametrize("stretch", [0.9, 1.2])
@pytest.mark.parametrize("waves", [2, 4])
def test_shallow_relief_matches_membrane_on_foundation_closed_form(
    stretch: float, waves: int
) -> None:
    # Small slopes under constant tension N: (k_f + B K^4 + N K^2) w = (k_f z + B K^4) h.
    count, texel, ratio, layer = 64, 10.0, 5.0, 12.0
    K = 2.0 * np.pi * waves / (count * texel)
    h = 0.02 * np.cos(K * texel * np.arange(count))[None, :].repeat(8, 0)
    even = np.ones_like(h)
    p = LayerProblem(
        neutral_um=h,
        membrane_um=ratio / 3.0 * layer * even,
        bending_um3=ratio / 9.0 * layer**3 * even,
        texel_um=texel,
        gradient=np.diag([stretch, 1.0]),
        poisson=0.5,
    )
    state, _ = find_equilibrium(p, tolerance=1e-5)
    # Incompressible: E = 1, mu = 1/3, z = 1/r; nominal N = mu t (1 - r^-4) per material slope.
    k_f = stretch * 2.0 / 3.0 * K / stretch
    tension = ratio / 3.0 * layer * (1.0 - stretch**-4)
    k2 = (2.0 - 2.0 * np.cos(K * texel)) / texel**2
    B = ratio / 9.0 * layer**3
    expected = (k_f / stretch + B * k2**2) / (k_f + B * k2**2 + tension * k2)
    np.testing.assert_allclose(state[2], expected * h, atol=2e-3 * 0.02)
    assert abs(expected - 1.0 / stretch) > 0.03


@pytest.mark.parametrize("stretch", [0.8, 1.25])
def test_found_state_is_equilibrium_of_less_energy(stretch: float) -> None:
    rng = np.random.default_rng(3)
    skin = make_micro_skin("forehead", seed=1, size_mm=0.8)
    p = layer_problem(skin, mean_gradient(stretch, 30.0))
    state, went = find_equilibrium(p, tolerance=1e-6)
    assert went.residual <= 1e-6
    assert 1.0 < went.condition < 1e6
    energies = np.array(went.energies)
    assert (np.diff(energies) <= 1e-12 * abs(energies[0])).all()
    assert energies[-1] < energies[0]
    # By finite differences of the energy alone, in smooth directions.
    nodes = p.neutral_um.shape
    for _ in range(4):
        hat = np.fft.rfft2(rng.standard_normal((3, *nodes)))
        hat[:, :, nodes[1] // 6 :] = 0.0
        hat[:, nodes[0] // 6 : -nodes[0] // 6] = 0.0
        d = np.fft.irfft2(hat, s=nodes)
        d /= np.abs(d).max()

        def slope(at: Floats, d: Floats = d) -> float:
            return (p.energy(at + 1e-3 * d)[0] - p.energy(at - 1e-3 * d)[0]) / 2e-3

        assert abs(slope(state)) < 1e-4 * abs(slope(p.affine()))
        assert p.energy(state + 0.1 * d)[0] > p.energy(state)[0]


def test_interrupted_search_reports_its_progress() -> None:
    p = layer_problem(make_micro_skin("cheek", size_mm=0.4), mean_gradient(0.8, 0.0))
    with pytest.raises(EquilibriumError, match=r"after 2 steps.*condition .*too few"):
        find_equilibrium(p, tolerance=1e-6, steps=2)


def test_stretch_one_is_the_neutral_relief_exactly() -> None:
    skin = make_micro_skin("chin", seed=2, size_mm=0.5)
    state = stretch_skin(skin, stretch=1.0, angle_deg=45.0)
    np.testing.assert_array_equal(state.height_um, skin.height_um)
    assert state.membrane_strain == 0.0
    place = 1e-3 * skin.texel_um * (np.arange(50) - 24.5)
    found = state.sample(place[None, :], place[::-1, None])
    np.testing.assert_allclose(found.height_um, skin.height_um, atol=1e-4)
    np.testing.assert_allclose(found.albedo, skin.albedo, atol=1e-6)
    # Also as a mechanical problem, neutral relief is at rest.
    p = layer_problem(skin, np.eye(2))
    _, force = p.energy(p.affine())
    assert np.abs(force).max() < 1e-10


@pytest.mark.parametrize("site", ONE_NOW)
def test_stretching_smooths_and_compressing_roughens_along_the_jaws(site: str) -> None:
    skin = make_micro_skin(site, seed=1, size_mm=0.8)
    states = [stretch_skin(skin, stretch=r, angle_deg=0.0) for r in SERIES]
    variance = np.array([slopes_along(state).var() for state in states])
    variance /= variance[SERIES.index(1.0)]
    assert (np.diff(variance) < 0.0).all()
    assert 1.5 < variance[SERIES.index(0.8)] < 3.0
    assert 0.3 < variance[-1] < 0.6
    # The relief's excess length gives what it has; the rest is strain of the membrane.
    for r, state in zip(SERIES, states, strict=True):
        assert abs(state.membrane_strain) <= abs(r - 1.0)
        assert abs(state.membrane_strain) >= 0.6 * abs(r - 1.0)
        assert state.excess_length > 0.0


@pytest.mark.long
@pytest.mark.parametrize("site", SITE_NAMES)
@pytest.mark.parametrize("angle_deg", [0.0, 45.0, 90.0])
@pytest.mark.parametrize("compensation", ["volume", "none"])
def test_slope_variances_are_monotone_for_all_sites_angles(
    site: str, angle_deg: float, compensation: Compensation
) -> None:
    # each site has another skin at each angle
    seed = 2 + (SITE_NAMES.index(site) + round(angle_deg / 45.0)) % 3
    skin = make_micro_skin(site, seed=seed, size_mm=1.2)
    variance = [
        slopes_along(
            stretch_skin(skin, stretch=r, angle_deg=angle_deg, compensation=compensation)
        ).var()
        for r in SERIES
    ]
    assert (np.diff(variance) < 0.0).all()


def test_rotating_skin_and_jaws_together_rotates_result() -> None:
    skin = make_micro_skin("chin", seed=4, size_mm=0.64)
    turned = dataclasses.replace(
        skin,
        **{
            name: np.ascontiguousarray(np.rot90(getattr(skin, name)))
            for name in ("height_um", "albedo", "alpha", "layer_um")
        },
    )
    one = stretch_skin(skin, stretch=0.85, angle_deg=20.0, tolerance=1e-5)
    other = stretch_skin(turned, stretch=0.85, angle_deg=110.0, tolerance=1e-5)
    # The mirrored surroundings are blended along x and y in turn: equal up to the border.
    np.testing.assert_allclose(
        other.height_um[4:-4, 4:-4], np.rot90(one.height_um)[4:-4, 4:-4], atol=0.1
    )
    assert np.abs(other.height_um - one.height_um).max() > 10.0


def test_slopes_are_those_of_the_interpolated_height() -> None:
    skin = make_micro_skin("forehead", seed=1, size_mm=1.0)
    state = stretch_skin(skin, stretch=1.15, angle_deg=45.0)
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.3, 0.3, (2, 200))
    step = 1e-3
    found = state.sample(x, y)
    ahead, behind = state.sample(x + step, y), state.sample(x - step, y)
    above, below = state.sample(x, y + step), state.sample(x, y - step)
    by_x = (ahead.height_um - behind.height_um) / (2e3 * step)
    by_y = (above.height_um - below.height_um) / (2e3 * step)
    np.testing.assert_allclose(found.slope_x, by_x, atol=0.01)
    np.testing.assert_allclose(found.slope_y, by_y, atol=0.01)


def test_pigment_speck_moves_with_its_skin_position() -> None:
    skin = make_micro_skin("cheek", seed=6, size_mm=1.0)
    state = stretch_skin(skin, stretch=0.85, angle_deg=0.0)
    assert np.abs(state.displacement_um).max() > 2.0
    j, i = np.meshgrid(np.arange(20, 80), np.arange(20, 80))
    place = 1e-3 * skin.texel_um * np.stack([j - 49.5, 49.5 - i], -1)
    now = place @ state.gradient.T + 1e-3 * state.displacement_um[i, j]
    found = state.sample(now[..., 0], now[..., 1])
    affine = state.sample(*np.moveaxis(place @ state.gradient.T, -1, 0))
    miss = np.abs(found.albedo - skin.albedo[i, j]).mean()
    assert miss < 0.25 * np.abs(affine.albedo - skin.albedo[i, j]).mean()
    assert np.corrcoef(found.albedo.ravel(), skin.albedo[i, j].ravel())[0, 1] > 0.99


def test_a_flat_patch_stays_flat_whatever_the_stretch() -> None:
    flat = patch(np.zeros((32, 32)))
    for stretch in (0.5, 0.8, 2.0):
        state = stretch_skin(flat, stretch=stretch, angle_deg=10.0)
        assert np.abs(state.height_um).max() < 1e-9
        assert state.membrane_strain == pytest.approx(stretch - 1.0)


def test_groove_across_jaws_opens_and_along_them_stays() -> None:
    x = 10.0 * (np.arange(80) - 39.5)
    furrow = -40.0 * np.exp(-((x / 50.0) ** 2))
    across = patch(np.broadcast_to(furrow[None, :], (80, 80)))
    wide = stretch_skin(across, stretch=1.25, angle_deg=0.0, compensation="none")
    narrow = stretch_skin(across, stretch=0.8, angle_deg=0.0, compensation="none")
    depth = [
        float(np.ptp(s.height_um[40]))
        for s in (narrow, stretch_skin(across, stretch=1.0, angle_deg=0.0), wide)
    ]
    assert depth[0] > 1.05 * depth[1] > 1.05**2 * depth[2]
    # A furrow takes more of the stretch than its shoulders: points move away from its middle.
    moved = wide.displacement_um[40, :, 0]
    assert moved[45] > 0.5
    assert moved[34] < -0.5
    along = stretch_skin(across, stretch=1.25, angle_deg=90.0, compensation="none")
    narrowed = np.ptp(along.height_um[40]) / depth[1]
    assert narrowed > depth[2] / depth[1]


@pytest.mark.parametrize("stretch", [0.5, 2.0])
@pytest.mark.parametrize("site", ONE_NOW)
def test_half_and_twice_the_length_have_an_equilibrium(site: str, stretch: float) -> None:
    skin = make_micro_skin(site, seed=1, size_mm=0.5)
    state = stretch_skin(skin, stretch=stretch, angle_deg=90.0, tolerance=0.02)
    assert np.isfinite(state.height_um).all()
    assert state.convergence.residual <= 0.02
    assert (state.excess_length > state.neutral_excess_length) == (stretch < 1.0)


@pytest.mark.parametrize("texel_um", [5.0, 20.0])
def test_finer_and_coarser_texels_give_same_change(texel_um: float) -> None:
    got = []
    for texel in (10.0, texel_um):
        skin = make_micro_skin("chin", seed=3, size_mm=0.8, texel_um=texel)
        one, other = (stretch_skin(skin, stretch=r, angle_deg=0.0) for r in (1.0, 1.2))
        got.append(slopes_along(other).var() / slopes_along(one).var())
    assert got[1] == pytest.approx(got[0], rel=0.08)


@pytest.mark.long
def test_a_stiffer_layer_keeps_its_length_better() -> None:
    skin = make_micro_skin("forehead", seed=2, size_mm=0.5)
    strain = []
    for ratio in (0.01, 1.0, 10.0, 100.0):
        state = stretch_skin(
            dataclasses.replace(skin, stiffness_ratio=ratio), stretch=1.03, angle_deg=90.0
        )
        strain.append(state.membrane_strain)
    assert strain == sorted(strain, reverse=True)
    assert strain[-1] < 0.8 * strain[0]


def test_field_is_filled_only_by_requested_size() -> None:
    field, stretch = 0.6, 0.75
    size = required_size_mm(field, stretch, angle_deg=45.0)
    corner = 0.5 * field * np.array([-1.0, 1.0])
    enough = stretch_skin(make_micro_skin("cheek", size_mm=size), stretch=stretch, angle_deg=45.0)
    assert enough.sample(corner[None, :], corner[:, None]).inside.all()
    less = stretch_skin(
        make_micro_skin("cheek", size_mm=0.85 * size), stretch=stretch, angle_deg=45.0
    )
    found = less.sample(corner[None, :], corner[:, None])
    assert not found.inside.all()
    assert (found.height_um[~found.inside] == 0.0).all()
    assert required_size_mm(field, (0.75, 1.0, 1.2)) >= size


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stretch": 0.4}, "stretch"),
        ({"stretch": float("nan")}, "stretch"),
        ({"compensation": "area"}, "compensation"),
        ({"compensation": -0.5}, "compensation"),
        ({"angle_deg": float("inf")}, "angle_deg"),
        ({"tolerance": 0.0}, "tolerance"),
    ],
)
def test_a_stretch_outside_the_domain_is_refused(change: dict[str, object], message: str) -> None:
    skin = make_micro_skin("cheek", size_mm=0.2)
    with pytest.raises(StretchError, match=message):
        stretch_skin(skin, **({"stretch": 1.1, "angle_deg": 0.0} | change))  # type: ignore[arg-type]


def test_compensation_sets_the_stretch_across() -> None:
    assert principal_stretches(0.81) == pytest.approx((0.81, 1.0 / 0.9))
    assert principal_stretches(0.81, "none") == (0.81, 1.0)
    assert principal_stretches(0.8, 1.0) == pytest.approx((0.8, 1.25))
    F = mean_gradient(0.8, 45.0)
    np.testing.assert_allclose(np.linalg.eigvalsh(F), [0.8, 0.8**-0.5])
    np.testing.assert_array_equal(F, F.T)
