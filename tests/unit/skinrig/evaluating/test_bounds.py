import numpy as np
import pytest

from model import color_table
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction.chromophores import model_error, shading_prior
from reconstruction.chromophores.inversion import compute_identifiability
from reconstruction.chromophores.table_fit.fitting import POPULATION_LOG_SD
from skinrig.evaluating.bounds import chromophore_bounds, relative_bounds

CAMERA, LIGHT = "Nikon 5100 (NPL)", "D55"


@pytest.fixture(scope="module")
def table():
    return color_table.build(CAMERA, LIGHT, anisotropy=ANISOTROPY_SKIN, exact_optics=True)


def test_nearly_unknown_shading_has_bound_of_free_shading(table):
    noise = 0.005
    free = compute_identifiability(
        table,
        variance=lambda rgb: (noise * rgb) ** 2,
        model_error=model_error.load_covariance(),
        size=24,
    )
    c_m, c_hd = np.meshgrid(free.c_m[6:16], free.c_hd[6:16], indexing="ij")
    melanin, blood = relative_bounds(
        table, c_m.ravel(), c_hd.ravel(), np.full((100, 3), noise**2), log_shading_std=200.0
    )
    np.testing.assert_allclose(melanin.reshape(10, 10), free.stderr_melanin[6:16, 6:16], rtol=0.02)
    np.testing.assert_allclose(blood.reshape(10, 10), free.stderr_hemoglobin[6:16, 6:16], rtol=0.02)


def test_bound_scales_with_noise_and_shrinks_with_knowledge(table):
    c_m, c_hd = np.array([0.02]), np.array([0.05])
    few, many = np.full((1, 3), 1e-2), np.full((1, 3), 4e-2)
    loud = relative_bounds(table, c_m, c_hd, few, log_shading_std=0.6)
    louder = relative_bounds(table, c_m, c_hd, many, log_shading_std=1.2)
    np.testing.assert_allclose(np.array(louder), 2.0 * np.array(loud), rtol=1e-3)
    known = relative_bounds(table, c_m, c_hd, few, log_shading_std=0.01)
    assert np.all(np.array(known) < np.array(loud))


def scene(table, melanin, stderr):
    """Return maps whose estimate states `stderr`, and their truth."""
    shape = (4, 5)
    color = np.broadcast_to(0.7 * table.lookup(melanin, 0.05), (*shape, 3))
    diffuse = SkinMap(color, "1", 0.005 * color)
    estimate = SkinMap(np.full(shape, melanin), MAP_UNITS["melanin"], np.full(shape, stderr))
    truths = {
        "melanin": melanin,
        "melanin_blurred": melanin,
        "hemoglobin": 0.05,
        "hemoglobin_blurred": 0.05,
    }
    truth = SkinAppearance(
        {k: SkinMap(np.full(shape, v), MAP_UNITS[k.split("_")[0]]) for k, v in truths.items()},
        "simulated",
    )
    found = SkinAppearance(
        {"diffuse": diffuse, "melanin": estimate},
        "simulated",
        parameters={"color_table": {"camera": CAMERA, "illuminant": LIGHT}},
    )
    return found, truth


def test_map_bound_is_evaluated_at_truth(table, rng):
    found, truth = scene(table, 0.02, 0.01)
    bounds = chromophore_bounds(found, truth)
    place = np.array([0.02]), np.array([0.05])
    pixel, _ = relative_bounds(
        table, *place, np.full((1, 3), 0.005**2), log_shading_std=shading_prior.face_prior().sd
    )
    common, _ = relative_bounds(
        color_table.build(CAMERA, LIGHT, anisotropy=ANISOTROPY_SKIN),
        *place,
        np.zeros((1, 3)),
        log_shading_std=shading_prior.LOG_SHADING_SOFTNESS,
        prior_log_std=POPULATION_LOG_SD,
    )
    assert common[0] > pixel[0]
    np.testing.assert_allclose(bounds["melanin"], np.hypot(pixel, common)[0], rtol=1e-3)
    assert chromophore_bounds(SkinAppearance({}, "simulated"), truth) == {}


def test_inflated_standard_error_keeps_its_limit(table, rng):
    from skinrig.evaluating.flash import compare, limit

    honest, inflated = (
        next(
            row
            for row in compare(*scene(table, 0.02, stderr), rng=rng)
            if row.against == "blurred" and row.band is None
        )
        for stderr in (0.001, 0.02)
    )
    assert inflated.median_stderr == pytest.approx(1.0)
    assert limit(inflated) == pytest.approx(limit(honest))
    assert limit(inflated) < 0.6
