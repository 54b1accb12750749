"""The published half-vector estimate on lobes whose normal is known."""

import numpy as np
import pytest

from model.metrics import angular_error_rad
from reconstruction.photometric_stereo.half_vectors import HalfVectorError, estimate


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def shell(count):
    """Return directions spread evenly over the sphere, (count, 3)."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    phi = np.pi * (1.0 + np.sqrt(5.0)) * k
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)


def lobes(rng, count=80, lights=150, views=8, exponent=12.0):
    """Return values (P, M), light_dir, view_dir, view, normals, of glossy points."""
    light = np.tile(shell(lights), (views, 1))
    camera = unit(rng.standard_normal((views, 3)) * 0.4 + [0, 0, 1])
    view = np.repeat(np.arange(views), lights)
    n = unit(rng.standard_normal((count, 3)) * 0.3 + [0, 0, 1])
    half = unit(light + camera[view])
    value = 0.1 + np.maximum(n @ half.T, 0.0) ** exponent
    valid = (n @ light.T > 0.1) & (n @ camera[view].T > 0.1)
    shape = (count, *light.shape)
    return (
        value,
        np.broadcast_to(light, shape),
        np.broadcast_to(camera[view], shape),
        view,
        n,
        valid,
    )


def test_half_vector_finds_normals_within_light_spacing(rng):
    value, light, view_dir, view, n, valid = lobes(rng)
    found = estimate(value, light, view_dir, view, valid=valid)
    error = np.degrees(angular_error_rad(found.normals, n))[found.valid]
    assert found.valid.mean() > 0.9
    # 150 lights are 17 degrees apart; half of that turns the half vector by half, a few views mean
    assert np.median(error) < 4.0


def test_denser_lights_give_better_normals(rng):
    errors = []
    for lights in (150, 1500):
        value, light, view_dir, view, n, valid = lobes(np.random.default_rng(1), lights=lights)
        found = estimate(value, light, view_dir, view, valid=valid)
        errors.append(np.median(angular_error_rad(found.normals, n)[found.valid]))
    assert errors[1] < 0.5 * errors[0]


def test_disagreeing_view_is_omitted(rng):
    value, light, view_dir, view, _, valid = lobes(rng, lights=600)
    clean = estimate(value, light, view_dir, view, valid=valid)
    bad = value.copy()
    wrong = np.flatnonzero(view == 3)
    bad[:, wrong[:5]] = 50.0  # a lamp in the picture
    usable = valid.copy()
    usable[:, wrong[:5]] = True
    found = estimate(bad, light, view_dir, view, valid=usable)
    both = found.valid & clean.valid
    moved = angular_error_rad(found.normals, clean.normals)[both]
    assert np.median(moved) < np.radians(1.0)
    assert (found.views[both] < clean.views[both]).mean() > 0.8


def test_extreme_points_are_masked_and_never_nan(rng):
    value, light, view_dir, view, _, valid = lobes(rng, count=6)
    value[0] = 0.0
    value[1] = np.nan
    valid[2] = False
    valid[3] &= view == 0
    light, view_dir = light.copy(), view_dir.copy()
    view_dir[4] = -light[4]
    light[5] = np.nan
    found = estimate(value, light, view_dir, view, valid=valid)
    assert np.isfinite(found.normals).all()
    assert np.isfinite(found.stderr_rad).all()
    assert not found.valid[[0, 1, 2, 3, 5]].any()
    assert (found.stderr_rad[~found.valid] == np.pi).all()


def test_shapes_that_do_not_fit_are_named(rng):
    value, light, view_dir, view, _, _ = lobes(rng, count=3)
    with pytest.raises(HalfVectorError, match="view: got"):
        estimate(value, light, view_dir, view[:5])
    with pytest.raises(HalfVectorError, match="values"):
        estimate(value[0], light, view_dir, view)
    with pytest.raises(HalfVectorError, match="whole numbers"):
        estimate(value, light, view_dir, view.astype(float))
