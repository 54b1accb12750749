"""Normals by the whole fitted model: on dark and glossy skin the highlight says where it looks."""

import dataclasses
from unittest import mock

import numpy as np
import pytest

from model import fresnel
from model.brdf import tables as brdf_tables
from model.metrics import angular_error_rad
from reconstruction.lumitexels.samples import Lumitexels
from reconstruction.surface import model_normals

NOISE = 0.01


@pytest.fixture(scope="module")
def lobe():
    basis = brdf_tables.default_basis()
    return basis.mix_materials(np.eye(basis.size)[[basis.names.index("beckmann 0.3")]])


def scene(lobe, r_d, *, points=30, lights=24, seed=1, noise=NOISE):
    """Points with their true normals, a scan's normals 3 degrees off, samples at the scan's."""
    rng = np.random.default_rng(seed)

    def ways(count):
        way = rng.normal(size=(count, 3))
        way[:, 2] = np.abs(way[:, 2]) + 0.5
        return way / np.linalg.norm(way, axis=-1, keepdims=True)

    truth = ways(points) * [0.3, 0.3, 1.0]
    truth /= np.linalg.norm(truth, axis=-1, keepdims=True)
    scan = truth + np.radians(3.0) / np.sqrt(2) * rng.normal(size=truth.shape)
    scan /= np.linalg.norm(scan, axis=-1, keepdims=True)
    light, view = np.repeat(ways(lights), 2, axis=0), np.tile(ways(2), (lights, 1))
    light, view = (np.broadcast_to(a, (points, 2 * lights, 3)).copy() for a in (light, view))
    cos_l, cos_v = (np.einsum("pmk,pk->pm", a, truth) for a in (light, view))
    scanned = np.einsum("pmk,pk->pm", light, scan)
    through = np.prod(
        [1 - fresnel.reflectance(np.clip(c, 0, 1), fresnel.ETA_SKIN) for c in (cos_l, cos_v)],
        axis=0,
    )
    brdf = r_d * through / np.pi + 0.8 * lobe.evaluate(light, view, truth[:, None])[..., 0]
    valid = (cos_l > 0.1) & (cos_v > 0.1) & (scanned > 0.1)
    f = np.where(valid, brdf * cos_l / np.where(valid, scanned, 1.0), 0.0)
    sigma = noise * f.max()
    f = np.where(valid, f + sigma * rng.standard_normal(f.shape), 0.0)
    samples = Lumitexels(
        f=np.repeat(f[..., None], 3, -1).astype(np.float32),
        # the three channels share one noise here: their mean has its variance
        variance=np.where(valid[..., None], 3 * sigma**2, np.inf).repeat(3, -1).astype(np.float32),
        light_dir=light.astype(np.float32),
        view_dir=view.astype(np.float32),
        cos_light=np.where(valid, scanned, 1.0).astype(np.float32),
        cos_view=cos_v.astype(np.float32),
        light=np.repeat(np.arange(lights), 2).astype(np.int32),
        view=np.tile(np.arange(2), lights).astype(np.int32),
        valid=valid,
    )
    return samples, truth, scan


def estimated(lobe, r_d, *, weight=0.8, steps=6, **more):
    samples, truth, scan = scene(lobe, r_d, **more)
    lobes = model_normals.PointLobes(np.full((len(truth), 1), weight), lobe)
    with mock.patch.multiple(model_normals, N_GAUSS_NEWTON_STEPS=steps, LOBE_RELATIVE_ERROR=0.04):
        found = model_normals.estimate(samples, scan, np.full(len(truth), r_d), lobes)
    return found, truth, scan


@pytest.mark.parametrize("r_d", [0.5, 0.1, 0.02])
def test_model_normals_match_truth_within_stated_errors(lobe, r_d):
    found, truth, scan = estimated(lobe, r_d)
    error = angular_error_rad(found.normals, truth)
    assert found.valid.all()
    assert np.median(error) < 0.25 * np.median(angular_error_rad(scan, truth))
    # a Rayleigh variable's square is 2 on average; 30 points leave 4 sigma of it
    assert np.mean(np.square(error / found.stderr_rad)) < 2.0 * (1.0 + 4.0 / np.sqrt(30))


def test_without_the_lobe_the_highlight_bends_normals(lobe):
    found, truth, _ = estimated(lobe, 0.02)
    bare, _, _ = estimated(lobe, 0.02, weight=0.0)
    with_lobe = np.median(angular_error_rad(found.normals, truth))
    assert np.median(angular_error_rad(bare.normals, truth)) > 3.0 * with_lobe


def test_model_normals_improve_with_more_lights(lobe):
    few, truth, _ = estimated(lobe, 0.1, lights=8)
    many, same, _ = estimated(lobe, 0.1, lights=64)
    assert np.median(many.stderr_rad) < 0.6 * np.median(few.stderr_rad)
    assert np.median(angular_error_rad(many.normals, same)) < np.median(
        angular_error_rad(few.normals, truth)
    )


def test_uninformative_points_keep_start_normal_and_are_invalid(lobe):
    samples, truth, scan = scene(lobe, 0.3)
    nothing = samples.valid.copy()
    nothing[:3] = False
    nothing[3, 4:] = False
    samples = dataclasses.replace(samples, valid=nothing)
    lobes = model_normals.PointLobes(np.full((len(truth), 1), 0.8), lobe)
    found = model_normals.estimate(samples, scan, np.full(len(truth), 0.3), lobes)
    assert not found.valid[:3].any()
    np.testing.assert_array_equal(found.normals[:3], scan[:3])
    assert np.isfinite(found.normals).all()
    assert (found.stderr_rad[~found.valid] == np.pi).all()
    assert (found.moved_rad[~found.valid] == 0).all()


def test_a_start_at_the_truth_is_not_left(lobe):
    samples, truth, _ = scene(lobe, 0.3, noise=1e-6)
    lobes = model_normals.PointLobes(np.full((len(truth), 1), 0.8), lobe)
    found = model_normals.estimate(samples, truth, np.full(len(truth), 0.3), lobes)
    assert np.degrees(found.moved_rad).max() < 0.2  # tables are interpolated otherwise in places
