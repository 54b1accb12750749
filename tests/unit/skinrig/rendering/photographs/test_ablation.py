"""Models without one of their parts, bands of skin color, and photographs chosen evenly."""

import numpy as np
import pytest

from model.brdf import tables as brdf_tables
from model.skin_reflectance import SkinReflectance, lobe_brdf
from rigsim.geometry.mesh import build_mesh
from skinrig.evaluating import skin_bands
from skinrig.rendering.camera import RenderingError
from skinrig.rendering.photographs.evaluation import build_ablations, fit_one_lobe
from skinrig.rendering.photographs.held_out import HeldOutShot, _select_evenly

SIDE = 8


@pytest.fixture(scope="module")
def lobes():
    def lobe(power):
        return lambda light, view: np.maximum((light + view)[..., 2] / 2, 0.0) ** power / np.pi

    return brdf_tables.tabulate({"wide": lobe(2), "narrow": lobe(30)})


def model(lobes, weights, rng):
    normals = np.zeros((SIDE, SIDE, 3))
    normals[..., :] = (0.6, 0.0, 0.8)
    y, x = np.mgrid[:SIDE, :SIDE] * 1.0
    return SkinReflectance(
        r_d=rng.uniform(0.2, 0.6, (SIDE, SIDE, 3)),
        weights=weights,
        lobes=lobes,
        translucency_mm=np.ones((SIDE, SIDE, 3)),
        normals=normals,
        position_mm=np.stack([x, -y, 0 * x], -1),
        valid=np.ones((SIDE, SIDE), bool),
    )


def test_single_lobe_skin_is_unchanged_by_ablation(lobes, rng):
    strength = rng.uniform(0.5, 2.0, (SIDE, SIDE, 1))
    weights = strength * np.array([0.3, 0.7])
    np.testing.assert_allclose(fit_one_lobe(model(lobes, weights, rng)), weights, rtol=1e-5)


def test_single_lobe_keeps_amount_and_loses_sharpness(lobes, rng):
    weights = rng.uniform(0.0, 1.0, (SIDE, SIDE, 2))
    made = fit_one_lobe(model(lobes, weights, rng)).reshape(-1, 2)
    share = made / made.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(share, share[:1] + 0 * share, rtol=1e-4)
    up = np.array([0.0, 0.0, 1.0])
    true = lobe_brdf(lobes, weights.reshape(-1, 2), up, up, up)
    one = lobe_brdf(lobes, made, up, up, up)
    assert np.abs(one / true - 1).max() > 0.05
    assert abs(one.mean() / true.mean() - 1) < 0.1


def test_removed_parts_become_mesh_normal_and_mean_albedo(lobes, rng):
    whole = model(lobes, np.ones((SIDE, SIDE, 2)), rng)
    mesh = build_mesh(
        [[0, -8, 0], [8, -8, 0], [8, 0, 0], [0, 0, 0]],
        [[0, 1, 2], [0, 2, 3]],
        [[0, 0], [1, 0], [1, 1], [0, 1]],
    )
    less = build_ablations(whole, mesh)
    np.testing.assert_allclose(less["scanned normals"].normals[4, 4], (0, 0, 1), atol=1e-6)
    np.testing.assert_allclose(
        less["even albedo"].r_d[3, 3], whole.r_d.reshape(-1, 3).mean(axis=0), rtol=1e-5
    )
    assert set(less) == {"one lobe", "scanned normals", "even albedo"}
    for other in ("one lobe", "even albedo"):
        np.testing.assert_array_equal(less[other].normals, whole.normals)


def test_lighter_skin_has_greater_angle_and_gray_neutral():
    gray = skin_bands.typology_angle_deg([0.5, 0.5, 0.5])
    assert gray == pytest.approx(90.0, abs=0.1)
    skins = skin_bands.typology_angle_deg(
        [[0.7, 0.55, 0.45], [0.3, 0.2, 0.14], [0.06, 0.035, 0.02]]
    )
    assert (np.diff(skins) < 0).all()
    assert skin_bands.classify_typology(skins[[0, 2]]).tolist() == ["very light", "dark"]


def test_photographs_are_chosen_evenly_or_all():
    shots = tuple(HeldOutShot("C00", f"L{k:03}", "light") for k in range(40))
    assert _select_evenly(shots, None) == shots
    chosen = [int(shot.light[1:]) for shot in _select_evenly(shots, 8)]
    assert set(np.diff(chosen)) == {5}
    with pytest.raises(RenderingError, match="1 or more"):
        _select_evenly(shots, 0)
