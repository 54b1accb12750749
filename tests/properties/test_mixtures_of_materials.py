"""Mixtures of tabulated BRDFs, meshes and tables of colors over their declared domains."""

import functools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model import color_table, skin_reflectance, traits
from model.brdf import tables as brdf_tables
from model.facial_color import basis as facial_color_basis
from model.texture_statistics import space as texture_space
from model.traits import lobe_edits
from model.traits import vectors as trait_vectors
from reconstruction import brdf_basis
from reconstruction.brdf_basis import space as brdf_space
from reconstruction.chromophores import dark_spots, face_distribution
from reconstruction.chromophores import posterior as chromophore_posterior
from reconstruction.chromophores import start as chromophore_start
from reconstruction.scan import repair as mesh_repair

CHEAP = settings(derandomize=True, deadline=None, max_examples=20, database=None)
FEW = settings(CHEAP, max_examples=8)
SEED = st.integers(0, 9999)
SIDES = st.tuples(st.integers(1, 12), st.integers(1, 12))
NO_NUMBER = st.sampled_from([np.nan, np.inf, -np.inf])


def blinn(power):
    """A lobe about the half vector, of no physical material but cheap."""

    def brdf(light, view):
        half = light + view
        half = half / np.maximum(np.linalg.norm(half, axis=-1, keepdims=True), 1e-12)
        return 0.1 + np.clip(half[..., 2], 0.0, 1.0) ** power

    return brdf


@functools.cache
def three():
    return brdf_tables.tabulate({f"n{p}": blinn(p) for p in (1, 20, 200)})


def directions(rng, count):
    ways = rng.standard_normal((count, 3))
    return ways / np.linalg.norm(ways, axis=-1, keepdims=True)


@CHEAP
@given(seed=SEED, factor=st.sampled_from([1e-30, 0.5, 1e30]))
def test_mixture_is_linear_reciprocal_and_dark_below_horizon(seed, factor):
    rng = np.random.default_rng(seed)
    basis, up = three(), np.array([0.0, 0.0, 1.0])
    light, view, share = directions(rng, 20), directions(rng, 20), rng.random((20, 3))
    found = brdf_basis.evaluate(share, basis, light, view, up)
    assert (found >= 0.0).all()
    assert (found[(light[:, 2] < 0.0) | (view[:, 2] < 0.0)] == 0.0).all()
    np.testing.assert_allclose(
        brdf_basis.evaluate(factor * share, basis, light, view, up), factor * found, rtol=1e-9
    )
    np.testing.assert_allclose(
        brdf_basis.evaluate(share, basis, view, light, up), found, rtol=1e-5, atol=1e-7
    )
    same = skin_reflectance.lobe_brdf(basis, share, light, view, up)
    np.testing.assert_allclose(same, found, rtol=1e-12)
    ball = brdf_basis.render_lit_sphere(share[0], basis, size_px=16)
    assert (ball >= 0.0).all() or np.isnan(ball).any()


@FEW
@given(seed=SEED, bad=st.sampled_from([np.nan, np.inf]))
def test_tables_keep_columns_and_refuse_nonfinite_ones(seed, bad):
    basis = three()
    columns = basis.table[..., : basis.size].copy()
    again = brdf_tables.basis_from_columns(columns, basis.names, light_radius_rad=0.0)
    np.testing.assert_array_equal(again.table, basis.table)
    place = seed % columns.size
    columns.flat[place] = -1.0
    clipped = brdf_tables.basis_from_columns(columns, basis.names, light_radius_rad=0.0)
    assert clipped.table[..., : basis.size].flat[place] == 0.0
    columns.flat[place] = bad
    with pytest.raises(brdf_tables.BasisError):
        brdf_tables.basis_from_columns(columns, basis.names, light_radius_rad=0.0)


@FEW
@given(seed=SEED, compress=st.sampled_from(["cbrt", "none"]), bad=NO_NUMBER)
def test_nonfinite_point_is_masked_without_affecting_others(seed, compress, bad):
    rng = np.random.default_rng(seed)
    basis, up = three(), np.broadcast_to([0.0, 0.0, 1.0], (3, 3))
    light, view = (np.abs(directions(rng, 3 * 40)).reshape(3, 40, 3) for _ in range(2))
    true = rng.random((3, 3))
    f = brdf_basis.evaluate(true[:, None], basis, light, view, np.array([0.0, 0.0, 1.0]))

    def fit(values):
        samples = brdf_basis.surface_samples(
            values[..., None], light, view, up, np.zeros((3, 1)), eta=1.4
        )
        return brdf_basis.fit_weights(samples, basis, compress=compress)

    first = fit(f)
    assert first.valid.all()
    assert (first.weights >= 0.0).all()
    spoilt = f.copy()
    spoilt[1] = bad
    again = fit(spoilt)
    assert again.valid.tolist() == [True, False, True]
    assert (again.weights[1] == 0.0).all()
    # the misfit of the whole set is shared, so others move by what the fit leaves open
    seen = [
        brdf_basis.evaluate(w[:, None], basis, light, view, np.array([0.0, 0.0, 1.0]))
        for w in (first.weights, again.weights)
    ]
    np.testing.assert_allclose(seen[1][[0, 2]], seen[0][[0, 2]], rtol=0.05, atol=0.02)


@FEW
@given(seed=SEED, rank=st.integers(1, 3), bad=st.sampled_from([np.nan, np.inf, -1e-9]))
def test_common_mixtures_sum_to_unity_refining_never_worsens(seed, rank, bad):
    rng = np.random.default_rng(seed)
    basis, shares = three(), rng.random((12, 3)) ** 3
    found, mix, error = brdf_basis.reduce(shares, rank, basis=basis)
    np.testing.assert_allclose(mix.sum(axis=1), 1.0)
    assert (found >= 0.0).all()
    assert 0.0 <= error < 1.0
    for unit in (1e-320, 1e300):  # shares of some units have squares that no number holds
        _, _, same = brdf_basis.reduce(unit * shares, rank, basis=basis)
        assert same == pytest.approx(error, rel=0.1, abs=0.01)
    gram = brdf_space.brdf_inner_products(basis)
    assert np.linalg.eigvalsh(gram).min() >= -1e-9 * np.abs(gram).max()
    finer = brdf_space.refine_mixtures(shares, mix, basis, sweeps=5)
    np.testing.assert_allclose(finer.sum(axis=1), 1.0)
    assert (finer >= 0.0).all()
    assert _left(shares, finer, gram) <= _left(shares, mix, gram) * (1 + 1e-9) + 1e-18
    assert not brdf_space.is_constrained(np.vstack([shares, 0.0 * shares[:1]]), basis)[-1]
    assert brdf_space.repeat_distance(shares, shares, basis) == 0.0
    twice = brdf_space.repeat_distance(shares, 1.1 * shares, basis)
    assert twice == pytest.approx(0.1 / np.sqrt(1.0 + 1.1**2), rel=1e-9)
    wrong = shares.copy()
    wrong[0, 0] = bad
    for call in (brdf_space.is_constrained, lambda w, b: brdf_basis.reduce(w, rank, basis=b)):
        with pytest.raises(ValueError, match="weights"):
            call(wrong, basis)


def _left(shares, mix, gram):
    """Squared error of the shares' BRDFs from their best mixtures, by many plain projections."""
    products, cross = mix @ gram @ mix.T, shares @ gram @ mix.T
    coordinates = np.zeros((len(shares), len(mix)))
    step = 1.0 / np.linalg.eigvalsh(products)[-1]
    for _ in range(4000):
        coordinates = np.maximum(coordinates - step * (coordinates @ products - cross), 0.0)
    gap = shares - coordinates @ mix
    return float(np.einsum("pk,kl,pl->", gap, gram, gap))


@CHEAP
@given(seed=SEED, amount=st.floats(-3.0, 3.0), bad=NO_NUMBER)
def test_edited_lobes_are_nonnegative_null_edit_is_identity(seed, amount, bad):
    rng = np.random.default_rng(seed)
    people, weights, mix = rng.random((8, 4)), rng.random((5, 2)), rng.random((2, 4))
    space = traits.TraitSpace.fit(people, {"oil": [False, True] * 4})
    kept = lobe_edits.edit_weights(weights, mix, space, {"oil": 0.0})
    np.testing.assert_array_equal(kept.weights, weights)
    found = lobe_edits.edit_weights(weights, mix, space, {"oil": amount})
    assert (found.weights >= 0.0).all()
    assert np.isfinite(found.weights).all()
    assert (found.clipped >= 0.0).all()
    with pytest.raises(trait_vectors.TraitError):
        lobe_edits.edit_weights(weights, mix, space, {"oil": bad})


@CHEAP
@given(seed=SEED, rows=st.integers(2, 5), far=st.floats(10.0, 1e3))
def test_largest_surface_stays_and_points_outside_bounds_go(seed, rows, far):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: rows + 1, : rows + 1].astype(float)
    large = np.stack([x.ravel(), y.ravel(), 0.01 * rng.random(x.size)], -1)
    cell = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (
        part.ravel() for part in (cell[:-1, :-1], cell[:-1, 1:], cell[1:, 1:], cell[1:, :-1])
    )
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    small = np.array([[0.0, 0, far], [1, 0, far], [0, 1, far]])
    mesh = mesh_repair.TriangleMesh(
        np.concatenate([large, small]), np.concatenate([faces, [[x.size, x.size + 1, x.size + 2]]])
    )
    found = mesh_repair.largest_surface(mesh)
    assert len(found.faces) == len(faces)
    assert found.vertices_mm[:, 2].max() < 1.0
    box = ((-1.0, -1.0, -1.0), (rows + 1.0, rows + 1.0, 1.0))
    assert len(mesh_repair.crop(mesh, box_mm=box).faces) == len(faces)
    with pytest.raises(ValueError, match="crop"):
        mesh_repair.crop(mesh, box_mm=((-9.0, -9.0, -9.0), (-8.0, -8.0, -8.0)))


@CHEAP
@given(seed=SEED, sides=SIDES, unit=st.sampled_from([1e-100, 1e-3, 1e3, 1e100]), bad=NO_NUMBER)
def test_texture_area_is_unit_invariant_at_least_pixel(seed, sides, unit, bad):
    rng = np.random.default_rng(seed)
    base, valid = rng.standard_normal(sides), rng.random(sides) < 0.8
    found = facial_color_basis.texture_area_px(base, valid)
    assert found >= 1.0
    assert facial_color_basis.texture_area_px(unit * base, valid) == pytest.approx(found)
    spoilt = np.where(valid, base, bad)
    assert facial_color_basis.texture_area_px(spoilt, valid) == found


@CHEAP
@given(
    seed=SEED,
    sides=SIDES,
    channels=st.integers(0, 4),
    bad=NO_NUMBER,
    kind=st.sampled_from(["<f2", "<f4", "<f8", ">f8", "i8"]),
)
def test_texture_images_are_finite_where_valid(seed, sides, channels, bad, kind):
    rng = np.random.default_rng(seed)
    shape = (*sides, channels) if channels else sides
    image = (100 * rng.random(shape)).astype(kind)
    valid = rng.random(sides) < 0.7
    valid[0, 0] = True
    values, mask = texture_space.check_image(image, valid)
    assert values.shape == (*sides, channels or 1)
    assert values.dtype == (np.float64 if np.dtype(kind) == np.float64 else np.float32)
    np.testing.assert_array_equal(mask, valid)
    if image.dtype.kind == "f":
        image[0, 0] = bad
        with pytest.raises(texture_space.TextureError, match=r": got (nan|-?inf)"):
            texture_space.check_image(image, valid)


@functools.cache
def colors():
    return color_table.build("Nikon 5100 (NPL)", "D55", size=8, exact_optics=True)


@CHEAP
@given(seed=SEED, step=st.floats(1e-7, 1e-6))
def test_interpolated_colors_are_finite_and_match_derivatives(seed, step):
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(0.05, 0.95, (2, 9))
    color, by_a, by_b = chromophore_start.evaluate_table(colors(), a, b)
    assert np.isfinite(color).all()
    for slope, da, db in ((by_a, step, 0.0), (by_b, 0.0, step)):
        up, down = (
            chromophore_start.evaluate_table(colors(), a + s * da, b + s * db)[0] for s in (1, -1)
        )
        np.testing.assert_allclose((up - down) / (2 * step), slope, rtol=1e-3, atol=1e-5)


@CHEAP
@given(steps=st.lists(st.tuples(*[st.floats(-2.0, 2.0)] * 2), max_size=5))
def test_common_pixel_errors_add_in_squares_either_sign(steps):
    def face(melanin, blood):
        return face_distribution.FaceDistribution(
            face_distribution.ContaminatedNormal(melanin, 0.3, 0.01, -9.0, 0.0),
            face_distribution.ContaminatedNormal(blood, 0.1, 0.01, 0.0, 1.0),
        )

    usual = face(-3.0, 0.4)
    moved = [(face(-3.0 - a, 0.4 - 0.1 * b), face(-3.0 + a, 0.4 + 0.1 * b)) for a, b in steps]
    found = face_distribution.add_systematic_errors(usual, moved)
    assert found.melanin.mean == usual.melanin.mean
    assert found.melanin.stderr == pytest.approx(np.hypot.reduce([0.0, *(a for a, _ in steps)]))
    assert found.blood.stderr == pytest.approx(
        np.hypot.reduce([0.0, *(0.1 * b for _, b in steps)]), abs=1e-12
    )
    turned = face_distribution.add_systematic_errors(usual, [pair[::-1] for pair in moved])
    assert turned.melanin.stderr == pytest.approx(found.melanin.stderr)


@CHEAP
@given(
    seed=SEED,
    size=st.tuples(*[st.integers(0, 40)] * 2),
    unit=st.floats(-300, 300),
    bad=st.sampled_from([np.nan, np.inf, -np.inf, -1.0, 0.0, 5e-324]),
)
def test_spots_are_unit_invariant_and_only_on_skin(seed, size, unit, bad):
    rng = np.random.default_rng(seed)
    light = 10.0**unit * np.exp(0.3 * rng.standard_normal((*size, 3)))
    dropped = rng.random(size) < 0.1
    light[dropped] = bad
    kept = light.copy()
    valid = rng.random(size) < 0.9
    found = dark_spots.is_locally_dark(light, valid=valid)
    np.testing.assert_array_equal(light, kept)
    assert found.shape == size
    assert not found[~valid].any()
    if bad != 5e-324:
        assert not found[dropped].any()
        again = dark_spots.is_locally_dark(light / 10.0**unit, valid=valid)
        assert np.sum(again != found) <= 2  # ties that rounding decides
    assert not dark_spots.is_locally_dark(light, variance=np.inf, valid=valid).any()


@CHEAP
@given(
    pair=st.tuples(*[st.floats(0.0, 0.5, width=32)] * 2),
    errors=st.tuples(*[st.floats(0.0, 1e3, width=32)] * 2),
    where=st.booleans(),
)
def test_mixture_is_midway_and_contains_both(pair, errors, where):
    def weighed(value, error):
        each = np.full(1, value, np.float32), np.full(1, error, np.float32)
        one, yes = np.ones(1, np.float32), np.ones(1, bool)
        return chromophore_posterior.ChromophorePosterior(
            each[0], each[0], one, one, each[1], each[1], 0 * one, 0 * one, one, one, ~yes, yes
        )

    face, alone = (weighed(*each) for each in zip(pair, errors, strict=True))
    lighter = dark_spots.is_lighter_than_face_prior(face, alone)
    assert not (lighter & dark_spots.is_lighter_than_face_prior(alone, face)).any()
    assert not lighter.any() or pair[1] < pair[0]
    unknown = weighed(np.nan, np.nan)
    assert not dark_spots.is_lighter_than_face_prior(face, unknown).any()
    assert not dark_spots.is_lighter_than_face_prior(unknown, alone).any()
    found = dark_spots.average_hypotheses(face, alone, [where])
    if not where:
        assert (found.melanin[0], found.stderr_hemoglobin[0]) == (pair[0], errors[0])
        return
    assert min(pair) <= found.melanin[0] <= max(pair)
    least = max(abs(pair[0] - pair[1]) / 2, max(errors) / np.sqrt(2))
    assert found.stderr_melanin[0] >= least * (1 - 1e-5)
    assert found.stderr_melanin[0] <= sum(errors) + abs(pair[0] - pair[1]) + 1e-30
