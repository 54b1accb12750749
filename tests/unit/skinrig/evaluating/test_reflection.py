"""Reflection predicted in new directions and drawn on spheres, against a truth of closed form."""

import numpy as np
import pytest

from model import fresnel
from model.brdf import tables as brdf_tables
from model.skin import SkinAppearance, SkinMap
from model.skin_reflectance import BASIS_FILE
from reconstruction.pipeline.dome.lobes import BASIS_RANK, _basis_bytes
from reconstruction.pipeline.dome.stages import WEIGHT_NAMES
from skinrig.evaluating import reflection as evaluation
from skinrig.evaluating import reflection_truth

SIDE = 40
R_D = np.array([0.5, 0.35, 0.25])


class Matt:
    """A face that reflects what comes from inside only."""

    def brdf(self, uv, to_light, to_camera):
        normal = np.array([0.0, 0.0, 1.0])
        passed = 1.0
        for way in (to_light, to_camera):
            passed = passed * (1 - fresnel.reflectance(np.clip(way @ normal, 0, 1), 1.4))
        total = passed[:, None] * R_D / np.pi
        return total.astype(np.float32), np.zeros(len(total), np.float32)


def maps():
    x, y = np.meshgrid(np.linspace(0, 40, SIDE), np.linspace(0, 40, SIDE))
    normals = np.zeros((SIDE, SIDE, 3))
    normals[..., 2] = 1.0
    return {
        "position": SkinMap(np.stack([x, y, np.zeros_like(x)], -1), "mm"),
        "normals": SkinMap(normals, "1"),
        "r_d": SkinMap(np.broadcast_to(R_D, (SIDE, SIDE, 3)), "1"),
    }


@pytest.fixture
def truth(rng):
    bare = SkinAppearance(maps(), "simulated")
    test = reflection_truth.make_test(Matt(), bare, rng=rng, sites={"middle": (20.0, 20.0, 0.0)})
    return SkinAppearance(maps(), "simulated", files={reflection_truth.TEST_FILE: test})


def estimate(scale=1.0, **changes):
    materials = brdf_tables.default_basis()
    mix = np.full((BASIS_RANK, materials.size), 1 / materials.size)
    weights = {name: SkinMap(np.zeros((SIDE, SIDE)), "1") for name in WEIGHT_NAMES}
    found = maps() | weights | changes
    found["r_d"] = SkinMap(scale * found["r_d"].values, "1", valid=found["r_d"].valid)
    return SkinAppearance(
        found,
        "simulated",
        files={BASIS_FILE: _basis_bytes(materials, BASIS_RANK, {BASIS_RANK: (mix, 0.0)})},
    )


def test_the_right_albedo_predicts_the_reflection_to_rounding(truth, rng):
    held_out = evaluation.compare(estimate(), truth, rng=rng)
    assert held_out.points == 600
    assert held_out.median < 1e-5
    assert np.isnan(held_out.highlights)


def test_an_albedo_that_is_off_shows_as_much(truth, rng):
    assert evaluation.compare(estimate(1.1), truth, rng=rng).median == pytest.approx(0.1, abs=1e-4)


def test_points_without_an_albedo_are_not_compared(truth, rng):
    valid = np.zeros((SIDE, SIDE), bool)
    valid[:, :20] = True
    some = estimate(r_d=SkinMap(maps()["r_d"].values, "1", valid=valid))
    assert evaluation.compare(some, truth, rng=rng).points < 400
    none = estimate(r_d=SkinMap(maps()["r_d"].values, "1", valid=np.zeros_like(valid)))
    assert evaluation.compare(none, truth, rng=rng) is None


def test_spheres_show_truth_and_estimate_alike(truth):
    ((name, image, drawn),) = evaluation.render_spheres(estimate(), truth)
    assert name == "middle"
    np.testing.assert_allclose(drawn, image, atol=1e-6)
    # the light comes from the upper right
    half = reflection_truth.SPHERE_PX // 2
    assert image[:half, half:].sum() > 3 * image[half:, :half].sum()


def test_sphere_is_same_for_spot_facing_aside():
    def facing(normal):
        def reflect(light, camera):
            return np.repeat((np.maximum(light @ normal, 0) ** 3)[:, None], 3, axis=1)

        return reflection_truth.render_sphere(reflect, normal)[0]

    aside = np.array([0.6, 0.0, 0.8])
    np.testing.assert_allclose(facing(aside), facing(np.array([0.0, 0.0, 1.0])), atol=1e-12)


def test_without_test_or_lobes_nothing_is_claimed(truth, rng):
    bare = SkinAppearance(maps(), "simulated")
    assert evaluation.compare(bare, truth, rng=rng) is None
    assert evaluation.compare(estimate(), bare, rng=rng) is None
    assert evaluation.render_spheres(bare, truth) == []
