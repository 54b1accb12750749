"""Diagnosis of light stacks over their domain: few or many lights, any unit, missing samples."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from model.vectors import unit_vectors
from reconstruction import stack_diagnosis
from reconstruction.normal_maps import PhotometricStereoError
from reconstruction.stack_diagnosis import (
    axis_faults,
    frame_faults,
    light_faults,
    light_labels,
    moved_images,
    reduced_stack,
    shading_space,
    special_images,
    unlisted_lights,
)

FEW = settings(derandomize=True, deadline=None, max_examples=8, database=None)
SEED = st.integers(0, 9999)


def matte_ball(rng, lights, side=24):
    """Return images (N, side, side) of a matte ball, its mask, normals and directions."""
    directions = unit_vectors(rng.normal(size=(lights, 3)) + np.array([0.0, 0.0, 2.5]))
    y, x = np.mgrid[0:side, 0:side]
    x, y = (2 * x + 1 - side) / side, (side - 1 - 2 * y) / side
    inside = x * x + y * y < 0.7
    z = np.sqrt(np.maximum(1.0 - x * x - y * y, 0.0))
    normals = np.stack([x, y, z], axis=-1)
    images = 0.8 * np.maximum(np.einsum("hwi,ni->nhw", normals, directions), 0.0)
    return images * inside, inside, normals, directions


@FEW
@given(
    seed=SEED,
    lights=st.integers(8, 20),
    gain=st.sampled_from([1e-30, 1e-3, 1.0, 1e30]),
    bad=st.sampled_from([np.nan, np.inf, -np.inf]),
)
def test_sound_stack_keeps_its_order_in_any_unit(seed, lights, gain, bad):
    rng = np.random.default_rng(seed)
    images, inside, _, directions = matte_ball(rng, lights)
    images = gain * (images + 0.002 * rng.normal(size=images.shape))
    images[0, 12, 12] = bad
    found = stack_diagnosis.diagnose_stack(images, directions, inside=inside, rng=rng)
    assert found.order.tolist() == list(range(lights))
    assert not found.left_out.any()
    angle = np.degrees(np.arccos(np.clip((found.directions * directions).sum(1), -1, 1)))
    assert angle.max() < 3.0
    np.testing.assert_allclose(found.strength, 1.0, atol=0.1)


@FEW
@given(seed=SEED, lights=st.integers(8, 20))
def test_shading_space_gives_directions_up_to_linear_map(seed, lights):
    rng = np.random.default_rng(seed)
    images, inside, _, directions = matte_ball(rng, lights)
    usable = np.ones(images.shape, bool)
    samples, clear = shading_space.choose_points(images, usable, inside, rng)
    space = shading_space.fit_shading_space(samples, clear)
    assert space.misfit < 0.01
    agreement = shading_space.compare_directions(space.lights, directions, rng)
    assert agreement.agrees.all()
    order, _, findings = light_labels.find_order(space, samples, clear, directions, rng)
    assert (order.tolist(), findings) == (list(range(lights)), [])
    ratio = shading_space.compare_residuals(space, samples, clear, directions, agreement)
    assert ratio.max() < 3.0
    for one in light_labels.list_orders(lights).values():
        assert sorted(one.tolist()) == list(range(lights))


@FEW
@given(seed=SEED, lights=st.integers(8, 20))
def test_checks_of_sound_images_find_nothing(seed, lights):
    rng = np.random.default_rng(seed)
    images, inside, normals, directions = matte_ball(rng, lights)
    usable = np.ones(images.shape, bool)
    shading = images / 0.8
    samples = images[:, inside]
    strength = np.exp(0.01 * rng.normal(size=lights))
    assert not list(frame_faults.find_unlit(images, inside))
    assert not list(frame_faults.find_clipped(np.zeros(lights)))
    assert not list(frame_faults.find_full_bright(samples))
    assert not list(frame_faults.find_repeated(samples, directions))
    albedo = np.full(inside.shape, 0.8)
    assert not list(light_faults.find_ambient(images, inside, normals, albedo, directions))
    assert not list(light_faults.find_strengths(strength, np.ones(lights, bool)))
    lit = np.asarray(shading[:, inside] > 0.25, float)
    half = unit_vectors(directions + np.array([0.0, 0.0, 1.0])) @ normals[inside].T
    places = normals[inside][:, :2]
    assert not list(light_faults.find_near(samples, lit, half, directions, places))
    assert not list(light_faults.find_curve(samples, usable[:, inside], directions, rng))
    assert not list(axis_faults.find_axes(normals, inside))
    slope, error, rest = light_faults.fit_trend(strength, np.ones(lights, bool))
    assert abs(slope) < 0.1
    assert error > 0.0
    assert abs(np.median(rest)) < 1e-9


@FEW
@given(seed=SEED, lights=st.integers(8, 12))
def test_only_shifted_image_of_textured_ball_has_moved(seed, lights):
    """Noise and texture reach the misfit from which images are compared."""
    rng = np.random.default_rng(seed)
    images, inside, normals, _ = matte_ball(rng, lights, side=64)
    albedo = 0.8 * np.exp(0.3 * gaussian_filter(rng.normal(size=inside.shape), 1.5) * 5.0)
    images = images / 0.8 * albedo
    images += 0.03 * images.max() * rng.normal(size=images.shape) * inside
    usable = np.ones(images.shape, bool)
    scaled = albedo[..., None] * normals * inside[..., None]
    for image in images:
        misfit = moved_images._compare(image, inside, scaled).misfit
        assert misfit > moved_images.MIN_MISFIT
    assert not list(
        moved_images.find_moved(images, usable, inside, scaled, fit_without=lambda _: scaled)
    )
    images[3] = np.roll(images[3], (2, -3), (0, 1))
    (one,) = moved_images.find_moved(
        images, usable, inside, scaled, fit_without=lambda _: scaled, step=4
    )
    assert (one.fault, one.frames) == ("moved image", (3,))
    # half a pixel: shifts between pixels blur the noise, so that the estimate is a little small
    assert abs(one.measured - 4.0 * np.hypot(2, 3)) < 4.0 * 0.5


@FEW
@given(seed=SEED, lights=st.integers(10, 20), gain=st.sampled_from([1e-12, 1.0, 1e12]))
def test_unlisted_lights_follow_their_images(seed, lights, gain):
    rng = np.random.default_rng(seed)
    images, inside, _, directions = matte_ball(rng, lights, side=32)
    order = rng.permutation(lights)
    try:
        found, again = (
            unlisted_lights.estimate_lights(one, inside=inside, rng=np.random.default_rng(0))
            for one in (images, gain * images[order])
        )
    except PhotometricStereoError:
        # lights near the axis leave the directions open, others do not
        assert np.median(directions[:, 2]) > 0.8
        return
    np.testing.assert_allclose(again.directions, found.directions[order], atol=0.02)
    np.testing.assert_allclose(again.stderr_deg, found.stderr_deg[order], atol=1.0)
    angle = np.degrees(np.arccos(np.clip((found.directions * directions).sum(1), -1, 1)))
    assert angle.mean() < 3.0 + 3.0 * np.median(found.stderr_deg)


@FEW
@given(seed=SEED, lights=st.integers(8, 20), level=st.floats(0.2, 0.9))
def test_special_images_are_found_in_any_unit(seed, lights, level):
    rng = np.random.default_rng(seed)
    images, inside, _, _ = matte_ball(rng, lights)
    full = level * images.sum(axis=0) / images.sum(axis=0).max()
    stack = 1e6 * np.concatenate([images, [full, 0.0 * full]])
    reduced, unusable = reduced_stack.reduce_stack(stack, None, inside)
    assert not unusable.any()
    named = special_images.find_special_images(reduced.gray, reduced.inside)
    assert {lights: "full-bright", lights + 1: "dark"}.items() <= named.items()
