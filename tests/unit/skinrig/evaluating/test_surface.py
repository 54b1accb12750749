"""Errors on a mesh: matched by place, judged against a truth on another atlas."""

import math

import numpy as np
import pytest

from model.skin import SkinAppearance, SkinMap
from skinrig.evaluating import surface as evaluation


def plane(side, rng, *, shift_mm=0.0):
    """A flat square of 20 mm, seen on an atlas of `side` texels, with its normals and albedo."""
    x, y = np.meshgrid(np.linspace(0, 20, side), np.linspace(0, 20, side))
    position = np.stack([x, y, np.full_like(x, shift_mm)], axis=-1)
    normals = np.zeros((side, side, 3))
    normals[..., 2] = 1.0
    albedo = np.broadcast_to([0.5, 0.4, 0.3], (side, side, 3))
    return {"position": position, "normals": normals, "r_d": albedo}


def appearance(maps, **stderr):
    units = {"position": "mm"}
    return SkinAppearance(
        {
            name: SkinMap(values, units.get(name, "1"), stderr.get(name))
            for name, values in maps.items()
        },
        "simulated",
    )


def tilted(normals, sigma_rad, rng):
    out = normals + np.concatenate(
        [
            sigma_rad * rng.standard_normal((*normals.shape[:2], 2)),
            np.zeros((*normals.shape[:2], 1)),
        ],
        axis=-1,
    )
    return out / np.linalg.norm(out, axis=-1, keepdims=True)


def test_known_tilt_is_measured_with_stated_coverage(rng):
    truth, maps = plane(60, rng), plane(80, rng)
    sigma = math.radians(0.8)
    maps["normals"] = tilted(maps["normals"], sigma, rng)
    found = appearance(maps, normals=np.full((80, 80, 3), sigma))
    row = evaluation.compare(found, appearance(truth), rng=rng)[0]
    assert row.name == "normals"
    # mean of a Rayleigh distribution; 6400 draws know it to 0.7 %, 4 sigma are asked for
    assert row.mean == pytest.approx(0.8 * math.sqrt(math.pi / 2), rel=0.03)
    # a share of 0.6827 of 6400 has a deviation of 0.0058: 4 sigma
    assert row.coverage.fraction == pytest.approx(0.6827, abs=0.024)


def test_halved_standard_error_fails_coverage(rng):
    truth, maps = plane(60, rng), plane(80, rng)
    maps["normals"] = tilted(maps["normals"], 0.02, rng)
    found = appearance(maps, normals=np.full((80, 80, 3), 0.01))
    assert evaluation.compare(found, appearance(truth), rng=rng)[0].coverage.fraction < 0.4


def test_albedo_is_evaluated_per_channel_relative_to_truth(rng):
    truth, maps = plane(40, rng), plane(40, rng)
    maps["r_d"] = maps["r_d"] * [1.02, 1.0, 0.9]
    rows = evaluation.compare(appearance(maps), appearance(truth), rng=rng)
    red, green, blue = (row for row in rows if row.name.startswith("r_d"))
    assert red.bias == pytest.approx(2.0, abs=1e-4)
    assert green.median == pytest.approx(0.0, abs=1e-4)
    assert blue.median == pytest.approx(10.0, abs=1e-4)
    assert blue.limit_check[1] > blue.limit_check[2] > red.limit_check[1]


def test_texels_far_from_true_points_are_omitted(rng):
    truth, maps = plane(40, rng), plane(40, rng)
    maps["position"] = maps["position"] + [10.0, 0.0, 0.0]
    pairs = evaluation.match_texels(appearance(maps), appearance(truth))
    assert 0 < len(pairs.rows) < 40 * 40
    assert pairs.distance_mm.max() <= evaluation.MAX_MATCH_DISTANCE_MM


def test_a_scan_that_is_not_registered_is_named(rng):
    truth, maps = plane(10, rng), plane(10, rng, shift_mm=80.0)
    with pytest.raises(evaluation.SurfaceTruthError, match="register the scan"):
        evaluation.match_texels(appearance(maps), appearance(truth))


def ripples(maps):
    """Normals of waves of 6 mm, tilted by up to 3 degrees."""
    x, y = maps["position"][..., 0], maps["position"][..., 1]
    slopes = 0.05 * np.sin(x * 2 * np.pi / 6), 0.05 * np.cos(y * 2 * np.pi / 6)
    return np.stack([*slopes, np.ones_like(x)], axis=-1)


def test_truth_between_texels_is_interpolated(rng):
    truth, maps = plane(41, rng), plane(97, rng)
    truth["normals"], maps["normals"] = ripples(truth), ripples(maps)
    found, true = appearance(maps), appearance(truth)
    pairs = evaluation.match_texels(found, true)
    between = pairs.weights[:, 0] < 1.0  # not so at the border of the square
    own = maps["normals"][pairs.rows, pairs.columns]
    errors = np.abs(pairs.interpolate(true.maps["normals"]) - own)[between]
    # linear interpolation over h errs by at most h^2 / 8 of the second derivative
    assert errors.max() < 0.05 * (0.5 * math.tau / 6.0) ** 2 / 8.0 + 1e-6
    nearest = true.maps["normals"].values.reshape(-1, 3)[pairs.corners[:, 0]]
    assert np.abs(nearest - own)[between].max() > 5.0 * errors.max()
    assert between.mean() > 0.9


@pytest.mark.parametrize("broken", ["masked", "elsewhere"])
def test_nearest_texel_counts_alone_at_a_border(rng, broken):
    truth, maps = plane(41, rng), plane(97, rng)
    valid = np.ones((41, 41), bool)
    if broken == "masked":
        valid[:, 20:] = False
        truth["position"][:, 20:], truth["r_d"] = 0.0, np.array(truth["r_d"])
        truth["r_d"][:, 20:] = np.nan  # values that are not valid are undefined
    else:  # another chart begins here, 100 mm away
        truth["position"][:, 20:, 2] = 100.0
    units = {"position": "mm"}
    true = SkinAppearance(
        {name: SkinMap(each, units.get(name, "1"), valid=valid) for name, each in truth.items()},
        "simulated",
    )
    pairs = evaluation.match_texels(appearance(maps), true)
    used = np.where(pairs.weights > 0.0, pairs.corners % 41, 0)
    assert used.max() == 19
    np.testing.assert_allclose(pairs.weights.sum(axis=1), 1.0, rtol=1e-12)
    assert pairs.interpolate(true.maps["position"])[:, 2].max() == 0.0
    assert np.isfinite(pairs.interpolate(true.maps["r_d"])).all()
