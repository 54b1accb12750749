"""Error against the number of common mixtures: recovery, monotone curves, and extremes."""

import numpy as np
import pytest
from scipy.optimize import nnls

from model.brdf import tables as brdf_tables
from reconstruction import brdf_basis
from reconstruction.brdf_basis import space as brdf_space
from reconstruction.brdf_basis.space import SpaceError


@pytest.fixture(scope="module")
def basis():
    return brdf_tables.default_basis()


@pytest.fixture(scope="module")
def three(basis):
    """200 points that are mixtures of three mixtures."""
    rng = np.random.default_rng(2)
    mix = np.zeros((3, 59))
    for row, columns in enumerate(([2, 20], [40], [50, 57])):
        mix[row, columns] = rng.uniform(0.3, 1.0, len(columns))
    return rng.exponential(size=(200, 3)) @ mix


@pytest.fixture(scope="module")
def many(basis):
    """Points that no few mixtures hold: sparse draws of all materials."""
    rng = np.random.default_rng(3)
    drawn = rng.exponential(size=(150, 59)) * (rng.random((150, 59)) < 0.1)
    return drawn / basis.strength()


@pytest.mark.parametrize("method", ["shares", "brdf"])
def test_points_of_three_mixtures_need_three(three, basis, method):
    found = brdf_space.compute_error_curve(
        three[:140], basis, ranks=(1, 2, 3, 4, 5), held_out=three[140:], method=method
    )
    assert found.plateau_rank() == 3
    assert found.error[1] > 0.05 > 5.0 * found.error[2]
    assert found.held_out[2] < 0.05
    # the same points cut off at two: the rule tells two, and the error says that it is not enough
    assert found.plateau_rank(max_rank=2) == 2


def test_brdf_fit_improves_with_mixtures_and_beats_weights(many, basis):
    ranks = (1, 2, 4, 7, 12)
    shares = brdf_space.compute_error_curve(many, basis, ranks=ranks, method="shares").error
    brdf = brdf_space.compute_error_curve(many, basis, ranks=ranks, method="brdf").error
    assert np.all(np.diff(brdf) <= 0.0)
    assert np.all(brdf <= shares * (1.0 + 1e-9))
    assert brdf[1] < 0.98 * shares[1]


def test_error_matches_scipy_non_negative_least_squares(many, basis):
    found = brdf_space.compute_error_curve(many[:60], basis, ranks=(4,), held_out=many[60:])
    values, vectors = np.linalg.eigh(brdf_space.brdf_inner_products(basis))
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    (mix,) = found.mixes
    for part, error in ((many[:60], found.error[0]), (many[60:], found.held_out[0])):
        gaps = [nnls(root @ mix.T, root @ x)[1] for x in part]
        sizes = [np.linalg.norm(root @ x) for x in part]
        assert error == pytest.approx(np.linalg.norm(gaps) / np.linalg.norm(sizes), rel=1e-5)


def test_a_refinement_only_lowers_the_error(many, basis, rng):
    gram = brdf_space.brdf_inner_products(basis)
    start = rng.random((5, 59))
    errors = [brdf_space._error(many, start, gram)]
    for sweeps in (1, 3, 10, 30):
        errors.append(
            brdf_space._error(
                many, brdf_space.refine_mixtures(many, start, basis, sweeps=sweeps), gram
            )
        )
    assert np.all(np.diff(errors) <= 1e-9)
    assert errors[-1] < 0.8 * errors[0]


@pytest.mark.parametrize(("sweeps", "warnings"), [(1, 1), (60, 0)])
def test_refinement_warns_at_its_limit(three, basis, caplog, sweeps, warnings):
    start = np.zeros((2, 59))
    brdf_space.refine_mixtures(three[:1], start, basis, sweeps=sweeps)
    assert ["common mixtures" in r.getMessage() for r in caplog.records] == [True] * warnings


def test_normalized_curves_begin_at_unity(three, basis):
    found = brdf_space.compute_error_curve(three, basis, ranks=(1, 2, 3))
    np.testing.assert_allclose(found.normalized(), found.error / found.error[0])
    assert np.isnan(found.held_out).all()


def test_ranks_unsupported_by_points_are_reported_and_omitted(three, basis):
    found = brdf_space.compute_error_curve(three[:4], basis, ranks=(1, 3, 5, 9))
    assert found.ranks == (1, 3)
    assert [rank for rank, _ in found.omitted] == [5, 9]
    assert "4 points" in found.omitted[0][1]
    with pytest.raises(SpaceError, match="up to 1 for"):
        brdf_space.compute_error_curve(three[:1], basis, ranks=(2,))


def test_all_dark_points_are_refused_but_some_accepted(three, basis):
    with pytest.raises(SpaceError, match="got 10 points of 0"):
        brdf_space.compute_error_curve(np.zeros((10, 59)), basis)
    some = np.concatenate([three[:50], np.zeros((20, 59))])
    found = brdf_space.compute_error_curve(some, basis, ranks=(1, 3), held_out=np.zeros((5, 59)))
    assert np.isfinite(found.error).all()
    assert np.isnan(found.held_out).all()
    assert np.array_equal(brdf_space.is_constrained(some, basis), np.arange(70) < 50)


def test_materials_that_are_there_twice_change_nothing(three, basis):
    """Shares are split between two equal materials; the BRDFs and so the curve stay."""
    twice = basis.mix_materials(np.concatenate([np.eye(59), np.eye(59)]))
    split = np.concatenate([0.3 * three, 0.7 * three], axis=1)
    one = brdf_space.compute_error_curve(three[:60], basis, ranks=(1, 3), method="brdf")
    two = brdf_space.compute_error_curve(split[:60], twice, ranks=(1, 3), method="brdf")
    np.testing.assert_allclose(two.error, one.error, atol=0.01)


def test_repeated_point_needs_single_mixture(three, basis):
    found = brdf_space.compute_error_curve(
        np.tile(three[0], (30, 1)), basis, ranks=(1, 2, 4), method="brdf"
    )
    assert found.error[0] < 1e-3
    assert np.isfinite(found.normalized()).all()


def test_unheld_narrow_lobes_are_not_used(three, basis):
    wild = three.copy()
    wild[7] *= 1e4
    assert not brdf_space.is_constrained(wild, basis)[7]
    assert brdf_space.is_constrained(wild, basis).sum() == len(wild) - 1
    assert not brdf_space.is_constrained(np.zeros((3, 59)), basis).any()


def test_noise_is_estimated_from_two_fits(three, basis, rng):
    """Independent relative noise s of both fits: they lie s apart, by root 2 over root 2."""
    assert brdf_space.repeat_distance(three, three, basis) == 0.0
    a, b = (three * (1.0 + 0.1 * rng.standard_normal((len(three), 1))) for _ in range(2))
    assert brdf_space.repeat_distance(a, b, basis) == pytest.approx(0.1, rel=0.3)
    assert np.isnan(brdf_space.repeat_distance(np.zeros((2, 59)), np.zeros((2, 59)), basis))
    with pytest.raises(SpaceError, match="second"):
        brdf_space.repeat_distance(three, three[:3], basis)


def test_people_count_once_each_in_standard_error(three, many, basis):
    """Copies of a person's points tell nothing new: the standard error of groups does not fall."""
    others = np.concatenate([many[:12], three[:12]])
    copies, whose = np.tile(others, (6, 1)), np.tile(np.arange(24), 6)
    one = brdf_space.compute_error_curve(three, basis, ranks=(3,), held_out=others)
    grouped = brdf_space.compute_error_curve(
        three, basis, ranks=(3,), held_out=copies, groups=whose
    )
    single = brdf_space.compute_error_curve(three, basis, ranks=(3,), held_out=copies)
    assert grouped.held_out_stderr[0] == pytest.approx(one.held_out_stderr[0], rel=1e-6)
    assert single.held_out_stderr[0] < 0.5 * grouped.held_out_stderr[0]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"ranks": (3, 1)}, "ranks"),
        ({"ranks": (0, 1)}, "ranks"),
        ({"method": "pca"}, "method"),
        ({"groups": [1, 2]}, "groups"),
        ({"held_out": np.ones((2, 5))}, "expected"),
        ({"weights": -np.ones((5, 59))}, "weights: got"),
    ],
)
def test_invalid_brdf_space_input_is_refused(change, match, three, basis):
    given = {"weights": three, "ranks": (1, 2), **change}
    with pytest.raises(ValueError, match=match):
        brdf_space.compute_error_curve(given.pop("weights"), basis, **given)


def test_a_plateau_below_the_first_rank_is_refused(three, basis):
    found = brdf_space.compute_error_curve(three, basis, ranks=(2, 3))
    with pytest.raises(SpaceError, match="max_rank"):
        found.plateau_rank(max_rank=1)
    assert brdf_basis.find_plateau_rank(found.error) in (1, 2)
