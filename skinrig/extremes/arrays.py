"""Extremes of array inputs: NaN and infinity, single pixels, 8K images, singular systems."""

import math
from collections.abc import Callable

import numpy as np

from capture import hdr
from model import dipole, facial_color, tissue_optics
from model.dipole import kienle_patterson as diffusion
from model.traits import reduced_spaces
from reconstruction import normal_integration, polarization
from reconstruction import photometric_stereo as stereo
from reconstruction.surface import texture_fill
from rigsim.mitsuba import render_error, scene_radiance
from skinrig.extremes.expectations import (
    ExpectationError,
    expect_error,
    expect_finite,
    expect_near,
    expect_rising,
    expect_valid_fraction,
    expect_within,
)
from skinrig.extremes.inputs import InputPrecision, ring_directions

NON_FINITE_VALUES = (np.nan, np.inf, -np.inf)


def _no_numbers_in_light(real: InputPrecision) -> str:
    lights = ring_directions(8, 0.6)
    for bad in NON_FINITE_VALUES:
        samples = real(np.tile(lights[:, 2:, None], (1, 2, 2)))
        samples[3, 0, 1] = bad
        samples[:, 1, 0] = bad
        found = stereo.estimate_normals(samples, lights)
        if found.valid.tolist() != [[True, True], [False, True]]:
            raise ExpectationError(
                f"valid: got {found.valid.tolist()} with {bad} in one light and in all, "
                "expected all but the third pixel"
            )
        expect_near(found.normals[found.valid], np.tile([0.0, 0.0, 1.0], (3, 1)), absolute=1e-5)
        expect_finite(found.normals, np.ones((2, 2), bool), label="normals")
    return "one light omitted, the pixel without any masked"


def _no_numbers_in_normals(real: InputPrecision) -> str:
    y, x = np.mgrid[0:12, 0:12]
    normals = np.stack([-0.3 + 0.0 * x, 0.1 + 0.0 * y, np.ones((12, 12))], -1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    whole = normal_integration.integrate(real(normals))
    holed = real(normals)
    holed[5, 5], holed[7, 2] = np.nan, np.inf
    found = normal_integration.integrate(holed)
    kept = np.ones((12, 12), bool)
    kept[5, 5] = kept[7, 2] = False
    off = (found - whole)[kept]
    return "off by " + expect_within(off - off.mean(), -0.02, 0.02, label="pixels")


def _no_numbers_in_statistics(real: InputPrecision) -> str:
    plain = real(0.1 + 0.01 * np.random.default_rng(0).random((12, 12)))
    changes = []
    for bad in NON_FINITE_VALUES:
        broken = plain.copy()
        broken[6, 6] = bad
        mean, deviation = facial_color.local_statistics(broken, 3.0)
        expect_finite(mean, np.ones_like(mean, bool), label="mean")
        expect_finite(deviation, np.ones_like(mean, bool), label="deviation")
        changes.append(np.max(np.abs(mean - facial_color.local_statistics(plain, 3.0)[0])))
    return "means change by " + expect_within(changes, 0.0, 1e-3, label="at most")


def _expect_each_rejected(calls: list[tuple[str, Callable[[float], object]]]) -> str:
    for word, call in calls:
        for bad in NON_FINITE_VALUES:
            expect_error(lambda call=call, bad=bad: call(bad), ValueError, word)  # type: ignore[misc]
    return f"ValueError naming the argument, for {len(calls)} inputs and 3 values each"


def _no_numbers_in_media(real: InputPrecision) -> str:
    def stack(value: float) -> object:
        return tissue_optics.layer_stack_reflectance(real([value]), real([1.0]), real([math.inf]))

    return _expect_each_rejected(
        [
            ("radius_mm", lambda v: dipole.reflectance(real(v), real(0.1), real(1.0), 1.4)),
            ("sigma_a_per_mm", lambda v: dipole.reflectance(real(1.0), real(v), real(1.0), 1.4)),
            ("sigma_s_prime", lambda v: diffusion.reflectance(real(1.0), real(0.1), real(v), 1.4)),
            ("sigma_a_per_mm", stack),
            ("c_m", lambda v: tissue_optics.two_layer_reflectance(500.0, real(v), 0.05)),
            ("wavelength", lambda v: tissue_optics.two_layer_reflectance(real(v), 0.02, 0.05)),
        ]
    )


def _single_pixels(real: InputPrecision) -> str:
    expect_near(normal_integration.integrate(real([[[0.0, 0.6, 0.8]]])), [[0.0]])
    one = real(np.full((1, 1, 3), 0.5))
    expect_valid_fraction(polarization.separate(one, 0.4 * one).valid, fraction_range=(1.0, 1.0))
    mean, deviation = facial_color.local_statistics(one[..., 0], 2.0)
    expect_near(mean, [[0.5]], relative=1e-6)
    expect_near(deviation, [[0.0]], absolute=1e-9)
    expect_near(texture_fill.push_pull(one, np.ones((1, 1))).values, one, relative=1e-6)
    return "heights, polarizations, statistics and textures of 1 x 1"


def _eight_thousand(_: InputPrecision) -> str:
    shape = (4320, 7680)
    dn = np.empty((2, *shape), np.uint16)
    dn[0], dn[1] = 9000, 2634
    dn[:, -1, -1] = 16383, 16383
    dn[0, 0] = 16383
    settings = {"gain": 0.5, "read_noise": 3.0, "black": 512.0, "white": 16383.0}
    radiance, variance, valid = hdr.merge(dn, (1.0, 0.25), **settings)
    small = hdr.merge(dn[:, :2, :2], (1.0, 0.25), **settings)
    for whole, part in zip((radiance, variance), small, strict=False):
        expect_near(whole[:2, :2], part, relative=1e-6)
        inner = whole[1:-1]
        expect_near([inner.min(), inner.max()], [part[1, 0], part[1, 0]], relative=1e-6)
    if valid[-1, -1] or not valid[:-1].all():
        raise ExpectationError(
            "valid: got another mask, expected all but the last pixel, saturated in every frame"
        )
    return f"{radiance.size / 1e6:.3g} million pixels, equal to a small image"


def _missed_range(_: InputPrecision) -> str:
    # columns: below the noise of all, saturated in all, in all but the shortest, in none
    dn = np.array(
        [[512, 16383, 16383, 9000], [512, 16383, 16383, 2634], [512, 16383, 3000, 1042]], np.uint16
    )[:, :, None]
    radiance, variance, valid = hdr.merge(
        dn, (1.0, 0.25, 0.0625), gain=0.5, read_noise=3.0, black=512.0, white=16383.0
    )
    if valid[:, 0].tolist() != [True, False, True, True]:
        raise ExpectationError(f"valid: got {valid[:, 0].tolist()}, expected all but the second")
    expect_finite(radiance, valid, label="radiance")
    expect_near(radiance[2, 0], (3000 - 512) / 0.0625, relative=1e-5)
    expect_within(
        radiance[0, 0] / np.sqrt(variance[0, 0]), -1.0, 1.0, label="darkness over its error"
    )
    return expect_valid_fraction(valid, fraction_range=(0.75, 0.75))


def _mirror_and_chalk(real: InputPrecision) -> str:
    lights = np.concatenate([ring_directions(24, 0.6), ring_directions(12, 0.3)])
    samples = np.zeros((36, 1, 3))
    samples[5, 0, 0] = 1.0  # a mirror reflects one light only
    samples[:, 0, 1] = lights[:, 2]  # chalk
    samples[:, 0, 2] = lights[:, 2]
    samples[7, 0, 2] += 50.0  # chalk under varnish
    found = stereo.estimate_normals(real(samples), lights)
    if found.valid.tolist() != [[False, True, True]]:
        raise ExpectationError(f"valid: got {found.valid.tolist()}, expected all but the mirror")
    off = np.arccos(np.clip(found.normals[0, 1:, 2], -1.0, 1.0))
    return "mirror masked; error of chalk and varnish " + expect_within(
        np.degrees(off), 0.0, 0.1, label="degrees"
    )


def _conditions(real: InputPrecision) -> str:
    rng = np.random.default_rng(0)
    one = rng.random(20)
    conditions, worst = [], []
    for distance in (1.0, 1e-3, 1e-6, 1e-9, 1e-12):
        each = np.concatenate([[0.0], np.full(5, distance)])[:, None] * rng.random((6, 20))
        basis = np.asarray(real(one + each), np.float64)
        conditions.append(float(np.linalg.cond(basis)))
        samples = rng.random((5, 6)) @ basis
        got = reduced_spaces.mixture_coordinates(samples, basis, None)
        expect_within(got, 0.0, 1e3, label="weights")
        worst.append(np.max(np.abs(got @ basis - samples)) / samples.max())
    # in float32, materials nearer than its rounding are equal and the condition stops to rise
    expect_rising(conditions[: 2 if real.single else 5], label="conditions")
    return (
        f"conditions {conditions[0]:.2g} to {max(conditions):.2g}: relative misfit of the samples "
        + expect_within(worst, 0.0, 1e-6, label="fraction")
    )


def _light_in_renderer(_: InputPrecision) -> str:
    def scene(emitter: dict[str, object]) -> dict[str, object]:
        film = {"type": "hdrfilm", "width": 4, "height": 4}
        return {
            "type": "scene",
            "sensor": {"type": "perspective", "film": film},
            "shape": {"type": "sphere", "center": [0.0, 0.0, 5.0]},
            "light": emitter,
            "integrator": {"type": "path"},
        }

    emitters: list[dict[str, object]] = []
    for bad in (np.nan, np.inf, -1.0):
        value = {"type": "rgb", "value": [1.0, float(bad), 1.0]}
        emitters += [
            {"type": "constant", "radiance": value},
            {"type": "point", "position": [0.0, 0.0, 0.0], "intensity": value},
            {"type": "envmap", "bitmap": np.full((4, 8, 3), bad, np.float32)},
        ]
    for emitter in emitters:
        expect_error(
            lambda emitter=emitter: scene_radiance.radiance(scene(emitter), kind="rgb", samples=1),  # type: ignore[misc]
            render_error.RenderError,
            "light",
        )
    return f"RenderError naming the light, for {len(emitters)} lights"
