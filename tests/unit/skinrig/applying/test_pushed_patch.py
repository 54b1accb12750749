"""A block of skin pushed by a probe, against closed forms, a peer's elements, and finer meshes."""

import sys

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import brentq

from skinrig import errors
from skinrig.applying import pushed_patch
from skinrig.applying.pushed_patch import Push, PushDiverged, PushError, SkinBlock

pytest.importorskip("skfem")


def block(n=4, **changes):
    return SkinBlock(**{"divisions": (n, n, max(n // 2, 1)), **changes})


def nodes_of(one):
    return pushed_patch._mesh(one).p.T


@pytest.mark.parametrize(("stretch", "poisson"), [(1.3, 0.3), (0.8, 0.45), (1.2, 0.5)])
def test_pulled_block_stretch_matches_closed_form(stretch, poisson):
    """Rollers on three sides, the fourth pulled: the ratio across solves
    l^2 - 1 + (lambda / mu) ln(stretch l^2) = 0, or is 1 / sqrt(stretch) at a fixed volume."""
    one = block(3, poisson=poisson)
    nodes = nodes_of(one)
    given = np.full(nodes.shape, np.nan)
    low = nodes.min(axis=0)
    for axis in range(3):
        given[np.abs(nodes[:, axis] - low[axis]) < 1e-9, axis] = 0.0
    given[np.abs(nodes[:, 0] - 5.0) < 1e-9, 0] = 10.0 * (stretch - 1.0)
    patch = pushed_patch.solve_equilibrium(one, given)
    across = 1 / np.sqrt(stretch)
    if poisson < 0.5:
        ratio = 2 * poisson / (1 - 2 * poisson)
        across = brentq(lambda v: v * v - 1 + ratio * np.log(stretch * v * v), 0.1, 3.0)
    surface = np.unique(patch.surface)
    strain = patch.strain()
    pair = sorted((stretch, across))
    np.testing.assert_allclose(strain.r_s[surface], pair[1], rtol=1e-6)
    np.testing.assert_allclose(strain.r_t[surface], pair[0], rtol=1e-6)
    assert patch.volume_ratio == pytest.approx(stretch * across**2, rel=1e-6)
    assert patch.outcome.converged
    assert patch.outcome.condition > 1.0


def test_affine_border_motion_moves_interior_alike(rng):
    """The patch test."""
    one = block(4, poisson=0.4)
    nodes = nodes_of(one)
    matrix = 0.05 * rng.standard_normal((3, 3))
    border = (np.abs(nodes[:, :2]) > 4.999).any(axis=1)
    border |= (nodes[:, 2] > -1e-9) | (nodes[:, 2] < 1e-9 - one.depth_mm)
    given = np.where(border[:, None], nodes @ matrix.T, np.nan)
    assert (~border).any()
    patch = pushed_patch.solve_equilibrium(one, given, steps=1)
    np.testing.assert_allclose(patch.deformed_mm, nodes + nodes @ matrix.T, atol=1e-8)


def test_volume_conservation_improves_as_poisson_nears_half():
    lost = [
        abs(
            pushed_patch.push_block(block(6, poisson=p), Push(contact_mm=2.0), steps=1).volume_ratio
            - 1.0
        )
        for p in (0.3, 0.45, 0.49)
    ]
    assert (np.diff(lost) < 0).all()
    assert lost[2] < 0.3 * lost[0]


def shear(nodes, moved_mm, held):
    """A smooth sideways push of the surface, without the kink of a probe's rim."""
    given = np.full(nodes.shape, np.nan)
    top = nodes[:, 2] > -1e-9
    shape = (np.cos(np.pi * nodes[top, 0] / 10) * np.cos(np.pi * nodes[top, 1] / 10)) ** 2
    given[top, 0] = moved_mm * shape
    given[held] = 0.0
    return given


def held_of(nodes, depth_mm):
    return (np.abs(nodes[:, :2]) > 4.999).any(axis=1) | (nodes[:, 2] < 1e-9 - depth_mm)


def linear_peer(one, moved_mm, *, quadratic=True):
    """Elements of small strain, assembled by the library alone: movement of the nodes."""
    import skfem
    from skfem.models.elasticity import lame_parameters, linear_elasticity

    element = skfem.ElementTetP2() if quadratic else skfem.ElementTetP1()
    basis = skfem.Basis(pushed_patch._mesh(one), skfem.ElementVector(element))
    stiffness = skfem.asm(linear_elasticity(*lame_parameters(1.0, one.poisson)), basis)
    places = basis.doflocs.T
    given = shear(places, moved_mm, held_of(places, one.depth_mm))
    axis = np.zeros(basis.N, int)
    for part in (basis.nodal_dofs, basis.edge_dofs):
        for k in range(len(part)):
            axis[part[k]] = k
    values = given[np.arange(basis.N), axis]
    known = np.flatnonzero(np.isfinite(values))
    moved = skfem.solve(*skfem.condense(stiffness, x=np.nan_to_num(values), D=known))
    return moved[basis.nodal_dofs].T


def small_push(one):
    nodes = nodes_of(one)
    given = shear(nodes, 1e-3, held_of(nodes, one.depth_mm))
    patch = pushed_patch.solve_equilibrium(one, given, steps=1)
    return patch.deformed_mm - patch.rest_mm


def apart(moved, peer):
    return np.sqrt(((moved - peer) ** 2).mean() / (peer**2).mean())


def test_a_small_push_is_that_of_linear_elasticity():
    """Peer: scikit-fem's quadratic elements of linear elasticity, on the same mesh. The error of
    linear elements falls with refinement."""
    coarse, fine = (
        apart(small_push(one), linear_peer(one, 1e-3))
        for one in (block(4, poisson=0.4), block(8, poisson=0.4))
    )
    assert fine < 0.6 * coarse
    assert fine < 0.1


def test_nearly_incompressible_tissue_does_not_lock():
    """Rationale: plain linear tetrahedra grow stiffer without bound as Poisson's number nears a
    half. Expected: refinement helps ours, and does not help them at these sizes."""
    ours, plain = [], []
    for one in (block(4, poisson=0.4999), block(8, poisson=0.4999)):
        peer = linear_peer(one, 1e-3)
        ours.append(apart(small_push(one), peer))
        plain.append(apart(linear_peer(one, 1e-3, quadratic=False), peer))
    assert ours[1] < 0.6 * ours[0]
    assert plain[1] > 0.8 * plain[0]


@pytest.mark.long
def test_strain_converges_with_the_mesh():
    """Of a smooth large push: against a mesh of half the spacing, at the shared nodes."""

    def ratios(n):
        one = SkinBlock(divisions=(n, n, n // 2), poisson=0.45)
        nodes = nodes_of(one)
        given = np.full(nodes.shape, np.nan)
        held = held_of(nodes, one.depth_mm)
        given[held] = 0.0
        inside = ~held & (np.abs(nodes[:, 2] + 2.0) < 1e-9)
        given[inside, 0] = 0.5 * np.prod(np.cos(np.pi * nodes[inside, :2] / 10), axis=1)
        patch = pushed_patch.solve_equilibrium(one, given, steps=2)
        return {
            tuple(np.round(patch.rest_mm[v], 6)): (patch.strain().r_s[v], patch.strain().r_t[v])
            for v in np.unique(patch.surface)
            if (np.abs(patch.rest_mm[v, :2]) < 4.0).all()
        }

    finest = ratios(16)
    off = []
    for n in (4, 8):
        found = ratios(n)
        off.append(max(np.abs(np.subtract(found[k], finest[k])).max() for k in found))
    assert off[1] < 0.6 * off[0]


def test_the_surface_looks_out_and_covers_the_square():
    patch = pushed_patch.push_block(block(), Push(depth_mm=0.1), steps=1)
    a, b, c = (patch.rest_mm[patch.surface[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    assert (normal[:, 2] > 0).all()
    assert 0.5 * normal[:, 2].sum() == pytest.approx(100.0)
    uv = patch.uv[np.unique(patch.surface)]
    assert uv.min() == 0.0
    assert uv.max() == 1.0


def test_probe_drags_skin_in_contact():
    probe = Push(depth_mm=0.5, shift_mm=(0.3, -0.2), contact_mm=2.0, center_mm=(1.0, 0.5))
    patch = pushed_patch.push_block(block(6), probe, steps=2)
    away = np.hypot(*(patch.rest_mm[:, :2] - (1.0, 0.5)).T)
    touched = (patch.rest_mm[:, 2] > -1e-9) & (away <= 2.0)
    moved = (patch.deformed_mm - patch.rest_mm)[touched]
    np.testing.assert_allclose(moved[:, :2], np.tile((0.3, -0.2), (touched.sum(), 1)))
    tip = 4.0 - np.sqrt(16.0 - away[touched] ** 2) - 0.5
    np.testing.assert_allclose(moved[:, 2], tip)


@pytest.mark.long
def test_skin_is_rougher_before_moving_probe_smoother_behind(rng):
    """Where the push compresses along x, slopes along x grow; where it stretches, they shrink."""
    patch = pushed_patch.push_block(
        block(8), Push(depth_mm=0.0, shift_mm=(1.0, 0.0), contact_mm=1.3), steps=2
    )
    neutral = 20.0 * gaussian_filter(rng.standard_normal((1000, 1000)), 1.5)
    moved, field = patch.convolve(neutral.astype(np.float32))
    x = (np.arange(1000) + 0.5) / 100.0 - 5.0
    for place, sign in ((3.0, 1.0), (-3.0, -1.0)):
        part = (slice(450, 550), np.abs(x - place) < 0.5)
        change = np.gradient(moved, axis=1)[part].std() / np.gradient(neutral, axis=1)[part].std()
        assert sign * np.log(change) > 0.1
        stretch = field.stretch[500, np.abs(x - place).argmin()]
        assert stretch[0] > 1.1 if sign < 0 else stretch[1] < 0.9


def test_push_beyond_equilibrium_is_reported():
    """A node drawn through the opposite side of its block."""
    one = block(2, poisson=0.5)
    nodes = nodes_of(one)
    given = np.where(held_of(nodes, one.depth_mm)[:, None], 0.0, np.full(nodes.shape, np.nan))
    given[np.abs(nodes).sum(axis=1) < 1e-9] = (0.0, 0.0, -9.0)
    with pytest.raises(PushDiverged, match=r"no equilibrium beyond .* in \d+ iterations"):
        pushed_patch.solve_equilibrium(one, given)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SkinBlock(width_mm=0.0), "width_mm"),
        (lambda: SkinBlock(depth_mm=np.nan), "depth_mm"),
        (lambda: SkinBlock(poisson=0.6), "poisson: got 0.6"),
        (lambda: SkinBlock(divisions=(0, 2, 2)), "divisions"),
        (lambda: Push(contact_mm=5.0), "contact_mm, tip_mm"),
        (lambda: Push(depth_mm=np.inf), "depth_mm"),
        (
            lambda: pushed_patch.push_block(block(), Push(center_mm=(4.9, 0.0))),
            "within the block's edges",
        ),
        (lambda: pushed_patch.solve_equilibrium(block(), np.zeros((3, 3))), "given_mm: got shape"),
        (lambda: pushed_patch.solve_equilibrium(block(1), np.full((8, 3), np.nan)), "some nodes"),
        (
            lambda: pushed_patch.solve_equilibrium(block(1), np.zeros((8, 3)), steps=0),
            "steps: got 0",
        ),
    ],
)
def test_invalid_push_is_refused_by_name(make, message):
    with pytest.raises(PushError, match=message):
        make()


def test_missing_optional_part_is_named_in_message(monkeypatch):
    monkeypatch.setitem(sys.modules, "skfem", None)
    with pytest.raises(errors.MissingExtra, match=r"skinrig\[fem\]") as caught:
        pushed_patch.push_block(block(), Push())
    assert errors.exit_code(caught.value) == errors.EXIT_EXTRA_MISSING
