"""The sum over a tree against the direct sum, closed forms, and stiff media and geometry."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad

from model import dipole
from model.dipole import direct_sum as dipole_sum
from model.dipole import gather as dipole_gather
from model.dipole import source_tree_kernels
from model.dipole.direct_sum import DipoleMedia, sum_exitance
from model.dipole.gather import GatherError, SourceTree, exitance, gather
from model.fresnel import ETA_SKIN

R_D = np.array([0.55, 0.35, 0.2])
LENGTH_MM = np.array([1.7, 0.95, 0.6])


def plane(side_mm, step_mm):
    at = np.arange(0.5 * step_mm - side_mm / 2, side_mm / 2, step_mm)
    x, y = np.meshgrid(at, at)
    points = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    return points, np.full(len(points), step_mm**2)


def bumpy_face(count=48):
    """Return points, areas and light of a curved, creased surface with a cast shadow."""
    at = np.linspace(-1.0, 1.0, count)
    u, v = np.meshgrid(at, at)
    x, y = 15.0 * u, 20.0 * v
    z = 14.0 * np.sqrt(1.3 - 0.8 * u**2 - 0.4 * v**2) + 2.0 * np.sin(x) * np.cos(0.7 * y)
    place = np.stack([x, y, z], axis=-1)
    across = np.cross(np.gradient(place, axis=1), np.gradient(place, axis=0))
    area = np.linalg.norm(across, axis=-1)
    lit = np.clip(across @ [0.8, 0.3, 0.52] / area, 0.0, None)
    lit[(x - y > 5) & (x - y < 9)] = 0.0
    return place.reshape(-1, 3), area.ravel(), lit.reshape(-1, 1) * [1.0, 0.7, 0.9]


def edge_profile(x_mm, media):
    """Return the share of even light at x < 0 that comes out at x, by a 1-D integral."""
    reach, z = abs(x_mm), float(media.depth_mm)
    beyond, _ = quad(
        lambda r: 2.0 * r * np.arccos(reach / r) * float(dipole_sum.profile(r, media)),
        reach,
        reach + 50.0 / float(media.sigma_tr_per_mm),
        limit=400,
        points=[reach + z, reach + 5.0 * z],
    )
    return beyond if x_mm >= 0 else 1.0 - beyond


@pytest.mark.parametrize("length_mm", [0.01, 0.3, 1.7, 100.0])
@pytest.mark.parametrize("r_d", [0.0, 1e-6, 0.5, 1.0 - 1e-9, 1.0])
def test_uniform_light_returns_r_d_of_entering_light(length_mm, r_d):
    points, area, _ = bumpy_face(24)
    out = exitance(points, area, np.full((len(points), 3), 2.5), points[::7], r_d, length_mm)
    np.testing.assert_allclose(out, 2.5 * r_d, rtol=2e-6)


def test_tree_sum_matches_direct_sum_within_bound():
    points, area, light = bumpy_face()
    at = points[::37] + np.array([0.02, -0.03, 0.01])
    expected = sum_exitance(points, area, light, at, R_D, LENGTH_MM, normalize=False)
    tree = SourceTree.of(points, area)
    worst, work = [], []
    for tolerance in (3.0, 0.3, 0.03):
        found = gather(tree, light, at, R_D, LENGTH_MM, normalize=False, tolerance=tolerance)
        error = np.abs(found.exitance - expected) / (R_D * light.max())
        assert (error <= found.bound[:, None] + 1e-5).all()
        worst.append(error.max())
        work.append(found.work.mean())
    assert worst[0] > 4.0 * worst[1] > 16.0 * worst[2]
    assert work[0] < work[1] < work[2] < len(points)
    # another medium is not within it
    other = gather(tree, light, at, R_D, 1.5 * LENGTH_MM, normalize=False, tolerance=0.03)
    assert np.abs(other.exitance - expected).max() > 100.0 * other.bound.max() * worst[2]


@pytest.mark.parametrize("known", [False, True])
def test_normalized_sums_and_own_light_match_direct_sum(known):
    points, area, light = bumpy_face(40)
    at, own = points[::29], light[::29] if known else None
    rng = np.random.default_rng(3)
    r_d = rng.uniform(0.01, 0.99, (len(at), 3))
    length = np.exp(rng.uniform(-4.0, 3.0, (len(at), 3)))
    expected = sum_exitance(points, area, light, at, r_d, length, entered_at=own)
    found = exitance(points, area, light, at, r_d, length, entered_at=own, tolerance=0.01)
    np.testing.assert_allclose(found, expected, atol=2e-4 * light.max())
    threaded = exitance(
        points, area, light, at, r_d, length, entered_at=own, tolerance=0.01, workers=2
    )
    assert np.array_equal(found, threaded)


@pytest.mark.parametrize("reach_mm", [1e-3, 0.1, 1.0, 30.0])
@pytest.mark.parametrize("r_d", [1e-4, 0.5, 0.99999])
def test_kernel_integrates_to_unity_at_any_reach(reach_mm, r_d):
    media = DipoleMedia.of(r_d, 1.3, eta=ETA_SKIN)
    ends = [1e-9, *np.geomspace(1e-4, 100.0, 13), reach_mm]
    ends.sort()
    total = sum(
        quad(lambda r: 2 * np.pi * r * float(dipole_sum.kernel(r, reach_mm, media)), a, b)[0]
        for a, b in pairwise(ends)
    )
    assert total == pytest.approx(1.0, abs=1e-6)
    carried, own = dipole_sum.kernel_parts(np.linspace(0, 2 * reach_mm, 50), reach_mm, media)
    assert (carried >= 0).all()
    assert (own >= 0).all()


def test_shadow_edge_converges_to_dipole_profile_with_sources():
    x = np.array([-2.0, -1.0, -0.3, 0.3, 1.0, 2.0])
    media = [
        DipoleMedia.of(r, length, eta=ETA_SKIN) for r, length in zip(R_D, LENGTH_MM, strict=True)
    ]
    truth = np.array([[edge_profile(place, medium) for medium in media] for place in x])
    worst = []
    for step in (0.8, 0.4, 0.2):
        points, area = plane(16.0, step)
        light = np.repeat(points[:, :1] < 0.0, 3, axis=1).astype(float)
        at = np.stack([x, np.full_like(x, 0.07), np.zeros_like(x)], axis=-1)
        out = exitance(points, area, light, at, R_D, LENGTH_MM, tolerance=0.01) / R_D
        worst.append(np.abs(out - truth).max())
    assert worst[1] < 0.02
    assert worst[2] < 0.3 * worst[0]


def test_source_depth_inverts_eq_5_near_both_ends():
    r_d = np.concatenate([np.geomspace(1e-6, 0.5, 200), 1.0 - np.geomspace(0.49, 1e-9, 300)])
    media = DipoleMedia.of(r_d, 2.0, eta=ETA_SKIN)
    expected = 2.0 * np.sqrt(3.0 * dipole.invert_to_deficit(r_d, ETA_SKIN))
    np.testing.assert_allclose(media.depth_mm, expected, rtol=1e-5)
    assert (np.diff(media.depth_mm) < 0.0).all()


def test_unresolvable_light_stays_local_and_is_conserved():
    points, area = plane(100.0, 5.0)
    light = np.random.default_rng(1).uniform(0.0, 1.0, (len(points), 3))
    inner = (np.abs(points[:, :2]) < 35.0).all(axis=1)
    out = exitance(points, area, light, points[inner], R_D, 0.01, entered_at=light[inner])
    np.testing.assert_allclose(out, R_D * light[inner], rtol=2e-3)
    # a spot spread over its neighbours holds all of its light, without normalization
    spot = np.zeros((len(points), 3))
    spot[len(points) // 2 + 10] = 1.0
    fine, area_fine = plane(80.0, 1.0)
    for length in (0.01, 1.0, 5.0):
        out = exitance(points, area, spot, fine, R_D, length, normalize=False, tolerance=0.01)
        back = (out * area_fine[:, None]).sum(axis=0) / (R_D * area[0])
        np.testing.assert_allclose(back, 1.0, atol=0.01)


def test_between_sparse_sources_the_nearest_gives_its_light():
    points = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 10.0, 0.0]])
    light = np.diag([1.0, 2.0, 3.0])
    at = [[7.0, 1.0, 0.0], [400.0, 0.0, 0.0]]
    out = exitance(points, np.full(3, 0.01), light, at, 0.5, 0.01)
    np.testing.assert_allclose(out, [[0.0, 1.0, 0.0]] * 2)
    lost = exitance(points, np.full(3, 0.01), light, at, 0.5, 0.01, normalize=False)
    np.testing.assert_allclose(lost, 0.0, atol=1e-12)


def test_a_single_source_and_none_at_all():
    one = exitance([[1.0, 2.0, 3.0]], [0.1], [[1.0, 2.0, 3.0]], [[1.0, 2.0, 3.0]], R_D, LENGTH_MM)
    np.testing.assert_allclose(one, [R_D * [1.0, 2.0, 3.0]], rtol=1e-6)
    none = np.zeros((0, 3))
    assert exitance(none, np.zeros(0), none, [[0.0, 0.0, 0.0]], R_D, LENGTH_MM).tolist() == [
        [0.0, 0.0, 0.0]
    ]
    without_area = exitance([[0.0, 0, 0]], [0.0], [[5.0, 5, 5]], [[0.0, 0, 0]], R_D, LENGTH_MM)
    assert without_area.tolist() == [[0.0, 0.0, 0.0]]
    assert exitance(*_sheet(), none, R_D, LENGTH_MM).shape == (0, 3)


def test_albedo_above_unity_scales_unscattered_light():
    points, area, light = _sheet()
    inner = np.flatnonzero((np.abs(points[:, :2]) < 3.0).all(axis=1))
    at, own = points[inner], light[inner]
    out = exitance(points, area, light, at, 1.2, LENGTH_MM, entered_at=own)
    limit = exitance(points, area, light, at, 1.0, LENGTH_MM, entered_at=own)
    np.testing.assert_allclose(out, 1.2 * limit, rtol=1e-12)
    assert not exitance(points, area, light, at, 0.0, LENGTH_MM).any()


def test_fold_stays_between_darkest_and_brightest_light():
    points, area = plane(12.0, 0.5)
    light = np.zeros((2 * len(points), 3))
    light[: len(points)] = 1.0
    both = np.concatenate([points, points + np.array([0.0, 0.0, 0.05])])
    out = exitance(both, np.tile(area, 2), light, both, R_D, LENGTH_MM) / R_D
    assert out.min() > -1e-3
    assert out.max() < 1.0 + 1e-3
    # in a fold the plane's dipole sees both sheets, which the sum without normalization shows
    even = np.ones_like(light)
    twice = exitance(
        both, np.tile(area, 2), even, [[0.0, 0.0, 0.02]], R_D, LENGTH_MM, normalize=False
    )
    np.testing.assert_allclose(twice[0] / R_D, 2.0, rtol=0.05)


def test_a_spot_gives_back_no_more_than_entered():
    points, area = plane(40.0, 0.5)
    spot = np.zeros((len(points), 3))
    spot[np.hypot(points[:, 0], points[:, 1]) < 1.0] = 1.0
    for normalize in (True, False):
        out = exitance(points, area, spot, points, R_D, LENGTH_MM, normalize=normalize)
        np.testing.assert_allclose(out.sum(axis=0) / spot.sum(axis=0), R_D, rtol=0.01)


def test_single_precision_and_far_origins_barely_change_result():
    points, area, light = bumpy_face(32)
    at = points[::11]
    expected = exitance(points, area, light, at, R_D, LENGTH_MM)
    given = [a.astype(np.float32) for a in (points, area, light, at, R_D, LENGTH_MM)]
    kept = [a.copy() for a in given]
    np.testing.assert_allclose(exitance(*given), expected, rtol=1e-3, atol=1e-5)
    assert all(np.array_equal(a, b) for a, b in zip(given, kept, strict=True))
    away = np.array([3e5, -2e5, 1e5])
    moved = exitance(points + away, area, light, at + away, R_D, LENGTH_MM)
    np.testing.assert_allclose(moved, expected, rtol=1e-4, atol=1e-6)


def test_source_tree_leaves_partition_and_nodes_bound_sources():
    rng = np.random.default_rng(5)
    # equal coordinates must not stop the halving
    place = np.concatenate([rng.normal(size=(300, 3)), np.zeros((50, 3))]).astype(np.float32)
    order, low, high, skip = source_tree_kernels.split_sources(place, 8)
    assert np.array_equal(np.sort(order), np.arange(350))
    leaves = skip == np.arange(len(skip)) + 1
    covered = np.concatenate(
        [np.arange(a, b) for a, b in zip(low[leaves], high[leaves], strict=True)]
    )
    assert np.array_equal(covered, np.arange(350))
    assert (high[leaves] - low[leaves] <= 8).all()
    tree = SourceTree.of(place, rng.uniform(0.1, 1.0, 350))
    for node in range(len(tree.skip)):
        inside = (
            tree.position[tree.low[node] : tree.high[node]].astype(float)
            - tree.node_summary[node, :3]
        )
        assert (
            np.linalg.norm(inside, axis=1).max() <= tree.node_summary[node, 3] * (1 + 1e-6) + 1e-7
        )


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"entered": np.ones((2, 3))}, "entered: got shape (2, 3)"),
        ({"source_area_mm2": np.full(576, -1.0)}, "source_area_mm2"),
        ({"translucency_mm": 0.0}, "translucency_mm"),
        ({"r_d": np.nan}, "r_d (leave points without it out): got"),
        ({"exit_mm": [[0.0, np.inf, 0.0]]}, "exit_mm (leave points without it out): got"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"workers": 0}, "workers"),
    ],
)
def test_faulty_inputs_are_named(change, says):
    points, area, light = _sheet()
    given = {
        "source_mm": points,
        "source_area_mm2": area,
        "entered": light,
        "exit_mm": points[:3],
        "r_d": R_D,
        "translucency_mm": LENGTH_MM,
        **change,
    }
    with pytest.raises(GatherError, match=says.replace("(", r"\(").replace(")", r"\)")):
        exitance(**given)


def test_a_tree_serves_several_lights():
    points, area, light = _sheet()
    tree = SourceTree.of(points, area)
    for factor in (1.0, 0.3):
        found = gather(tree, factor * light, points[:5], R_D, LENGTH_MM).exitance
        alone = exitance(points, area, factor * light, points[:5], R_D, LENGTH_MM)
        np.testing.assert_allclose(found, alone)
    assert dipole_gather.GATHER_TOL > 0


def _sheet():
    points, area = plane(12.0, 0.5)
    return points, area, 1.0 + np.sin(points)
