"""A patch's high frequencies on the low ones of a face, and normals that were turned."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from model.vectors import unit_vectors
from reconstruction.fusion.patch_normals import PatchNormals, SurfaceFrame, check_patch, fuse_patch
from reconstruction.fusion.signals import FusionError

SIDE, PIXEL_UM = 96, 6.0
RAYLEIGH_68 = 1.5096
"""Length below which 68.27 % of the vectors with two standard normal components are."""


def relief(seed, *, oblique=0.0):
    """Slopes of a drawn relief with an rms of about 0.2; ``oblique`` adds furrows at 45 degrees."""
    rng = np.random.default_rng(seed)
    height = ndimage.gaussian_filter(rng.standard_normal((SIDE, SIDE)), 4.0, mode="wrap")
    y, x = np.mgrid[0:SIDE, 0:SIDE]
    height = height / height.std() + oblique * np.sin(2 * np.pi * (x + y) / 24.0)
    slopes = np.stack([np.gradient(height, axis=1), -np.gradient(height, axis=0)], axis=-1)
    return 0.2 * slopes / slopes.std()


def turn(normals, degrees, axis):
    angle = np.radians(degrees)
    cos, sin = np.cos(angle), np.sin(angle)
    turns = {
        "z": [[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]],
        "y": [[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]],
    }
    return normals @ np.array(turns[axis]).T


def patch_of(slopes, *, noise=0.0, seed=0):
    rng = np.random.default_rng(seed)
    off = slopes + noise * rng.standard_normal(slopes.shape)
    normals = unit_vectors(np.concatenate([-off, np.ones((SIDE, SIDE, 1))], axis=-1))
    error = np.full((SIDE, SIDE), max(noise, 1e-3))
    return PatchNormals(normals, error, np.ones((SIDE, SIDE), bool), PIXEL_UM)


def frame_of(tilt_deg=30.0, sd=0.0):
    angle = np.radians(tilt_deg)
    axes = np.array(
        [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
    )
    return SurfaceFrame(np.array([1.0, 2.0, 3.0]), axes, np.zeros((2, 2)), sd**2 * np.eye(2))


def test_fuse_patch_turns_detail_to_surface():
    slopes = relief(0)
    slopes -= slopes.mean(axis=(0, 1))
    found = fuse_patch(patch_of(slopes), frame_of(), cutoff_um=1e5)
    wanted = unit_vectors(np.concatenate([-slopes, np.ones((SIDE, SIDE, 1))], -1)) @ frame_of().axes
    assert np.abs(found.normals - wanted).max() < 2e-3
    middle = found.position_mm.reshape(-1, 3).mean(axis=0)
    assert np.allclose(middle, [1.0, 2.0, 3.0])


def test_fuse_patch_ignores_tilt_of_camera():
    slopes = relief(1)
    straight = fuse_patch(patch_of(slopes), frame_of(), cutoff_um=4e3)
    tilted = replace(patch_of(slopes), normals=patch_of(slopes + np.array([0.3, -0.2])).normals)
    found = fuse_patch(tilted, frame_of(), cutoff_um=4e3)
    assert np.abs(found.normals - straight.normals).max() < 1e-6


def test_fuse_patch_coverage_is_of_all_errors():
    rng = np.random.default_rng(5)
    held = []
    for seed in range(40):
        slopes = relief(seed)
        slopes -= slopes.mean(axis=(0, 1))
        true = unit_vectors(np.concatenate([-slopes, np.ones((SIDE, SIDE, 1))], axis=-1))
        # the face's normal errs by 2 degrees, the patch's rotation by 3
        off = np.radians(2.0) * rng.standard_normal(2)
        axis = np.cross([0, 0, 1], [*off, 0])
        noisy = patch_of(slopes, noise=0.03, seed=seed)
        noisy = replace(noisy, normals=turn(noisy.normals, 3.0 * rng.standard_normal(), "z"))
        frame = replace(frame_of(0.0), covariance=np.radians(2.0) ** 2 * np.eye(2))
        found = fuse_patch(noisy, frame, cutoff_um=1e5)
        shown = unit_vectors(found.normals + np.cross(axis, found.normals))
        error = (shown - true)[..., :2]
        inverse = np.linalg.inv(found.covariance)
        distance = np.sqrt(np.einsum("hwa,hwab,hwb->hw", error, inverse, error))
        held.append([(distance < f * RAYLEIGH_68).mean() for f in (0.5, 1.0)])
    half, whole = np.mean(held, axis=0)
    assert 0.58 < whole < 0.78
    assert half < 0.5  # half the stated error is too little


@pytest.mark.parametrize("oblique", [0.0, 1.5])
def test_check_patch_upright_names_none(oblique):
    check = check_patch(patch_of(relief(3, oblique=oblique), noise=0.05))
    assert check.probability < 0.1
    assert abs(np.degrees(check.rotation_rad)) < 3.0


@pytest.mark.parametrize("degrees", [20.0, -45.0, 90.0])
def test_check_patch_turned_states_its_angle(degrees):
    patch = patch_of(relief(4), noise=0.05)
    check = check_patch(replace(patch, normals=turn(patch.normals, degrees, "z")))
    assert check.probability > 0.9
    off = np.degrees(check.rotation_rad) - degrees
    assert abs((off + 90.0) % 180.0 - 90.0) < 3.0


def test_check_patch_tilted_camera_is_named():
    patch = patch_of(relief(6))
    check = check_patch(replace(patch, normals=turn(patch.normals, 30.0, "y")))
    assert check.probability > 0.9
    assert 25.0 < np.degrees(check.tilt_rad) < 35.0


def test_surface_frame_of_few_texels_raises():
    few = np.zeros((3, 3))
    with pytest.raises(FusionError, match="texels around"):
        SurfaceFrame.fit(np.zeros(3), few, few + np.array([0, 0, 1]), np.zeros(3), place_sd_mm=1.0)


def test_surface_frame_covariance_grows_with_unknown_place():
    rng = np.random.default_rng(0)
    at = rng.uniform(-9.0, 9.0, (300, 3)) * [1, 1, 0]
    normals = unit_vectors(np.column_stack([at[:, 0] / 60.0, np.zeros(300), np.ones(300)]))
    known, guessed = (
        SurfaceFrame.fit(np.zeros(3), at, normals, np.full(300, 0.01), place_sd_mm=sd)
        for sd in (0.0, 6.0)
    )
    grown = np.sqrt(np.diag(guessed.covariance - known.covariance).clip(0))
    assert np.allclose(grown, [0.1, 0.0], atol=0.01)  # 6 mm of a bend of 1 / 60 mm
