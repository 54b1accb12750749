"""Extremes of documented domains of arguments: their ends, and values beyond."""

import numpy as np

from capture import hdr
from model import fresnel, microstructure, photon_table
from model.texture_statistics import masks as texture_masks
from model.tissue_optics import adding_doubling, layered_diffusion
from reconstruction import photometric_stereo as stereo
from skinrig.extremes.expectations import (
    ExpectationError,
    expect_error,
    expect_finite,
    expect_near,
    expect_valid_fraction,
    expect_within,
)
from skinrig.extremes.inputs import InputPrecision, ring_directions, sheet_faces, stretched_sheet

INVALID_COEFFICIENTS = (np.nan, np.inf, -1.0)


def _far_lights(real: InputPrecision) -> str:
    lights = ring_directions(8, np.pi / 6)
    normal = np.array([0.1, -0.2, np.sqrt(0.95)])
    lit = real((lights @ normal)[:, None, None])
    infinite = stereo.estimate_normals(lit, lights)
    # lights at 1 km = 1e6 mm: irradiance falls by the square of the distance, 1e-12
    far = stereo.estimate_normals(
        1e-12 * lit, lights, light_positions_mm=1e6 * lights, points_mm=np.zeros((1, 1, 3))
    )
    expect_valid_fraction(infinite.valid & far.valid, fraction_range=(1.0, 1.0))
    expect_near(far.normals, infinite.normals, absolute=1e-5)
    expect_error(
        lambda: stereo.estimate_normals(
            lit, lights, light_positions_mm=np.inf * np.sign(lights), points_mm=np.zeros((1, 1, 3))
        ),
        stereo.PhotometricStereoError,
        "light_positions_mm",
    )
    return "at 1 km equal to no distance; infinity rejected"


def _one_photon(real: InputPrecision) -> str:
    rng = np.random.default_rng(9)
    lights = ring_directions(24, np.arcsin(0.6))

    def estimate(photons: float) -> stereo.NormalMaps:
        electrons = rng.poisson(photons, (24, 1, 1, 2000)) + rng.standard_normal((24, 1, 1, 2000))
        frames = np.rint(512.0 + electrons / 0.5).astype(np.uint16)
        merged = [
            hdr.merge(frame, (1.0,), gain=0.5, read_noise=1.0, black=512.0, white=16383.0)
            for frame in frames
        ]
        radiance, variance, valid = (np.stack(part) for part in zip(*merged, strict=True))
        return stereo.estimate_normals(real(radiance), lights, variance=real(variance), valid=valid)

    dark, bright = estimate(1.0), estimate(100.0)
    expect_valid_fraction(dark.valid, fraction_range=(0.0, 0.05))
    expect_finite(dark.normals, np.ones_like(dark.valid))
    expect_valid_fraction(bright.valid, fraction_range=(1.0, 1.0))
    off = np.arccos(np.clip(bright.normals[..., 2], -1.0, 1.0))
    # The angle of two equal Gaussian components is Rayleigh distributed: 68.27 % of angles are
    # below sqrt(-ln(1 - 0.6827)) = 1.0714 root mean squares.
    inside = float(np.mean(off <= 1.0714 * bright.stderr_rad))
    return f"{dark.valid.sum()} of 2000 with a normal; at 100 photons " + expect_within(
        inside, 0.60, 0.76, label="coverage"
    )


def _one_turned_triangle(real: InputPrecision) -> str:
    flat, moved, uv = (real(part) for part in stretched_sheet((1.1, 1.0, 1.0)))
    faces = sheet_faces(9)
    faces[20] = faces[20][::-1]
    found = microstructure.strain(flat, moved, faces, uv)
    expect_valid_fraction(found.valid, fraction_range=(1.0, 1.0))
    return expect_near(found.r_s, np.full(81, 1.1), relative=1e-5)


def _profile_beyond_numbers(real: InputPrecision) -> str:
    ends = real([1e-18, 1e18] if real.single else [1e-50, 1e50])
    slopes = photon_table.derivatives(ends, real(0.02), real(1.0))
    expect_finite(np.stack(slopes), np.ones((3, 2), bool), label="profile and slopes")
    expect_near(slopes.reflectance_per_mm2[1], 0.0, absolute=1e-30)
    for index, name in enumerate(("radius_mm", "sigma_a_per_mm", "sigma_s_prime_per_mm")):
        for bad in INVALID_COEFFICIENTS:
            values = [real(1.0), real(0.1), real(1.0)]
            values[index] = real(bad)
            expect_error(lambda v=values: photon_table.reflectance(*v), ValueError, name)  # type: ignore[misc]
    expect_error(lambda: photon_table.reflectance(1e301, 0.1, 1.0), ValueError, "radius_mm")
    return "finite at both ends; the error names the invalid argument"


def _layers_of_no_medium(real: InputPrecision) -> str:
    rejected = 0
    for solver in (adding_doubling, layered_diffusion):
        for index, name in enumerate(("sigma_a_per_mm", "sigma_s_prime_per_mm", "thickness_mm")):
            for bad in (np.nan, -1.0):
                values = [real([[0.1, 0.1]]), real([[1.0, 1.0]]), real([[0.2, np.inf]])]
                values[index][0, 0] = bad
                expect_error(lambda v=values, s=solver: s.reflectance(*v), ValueError, name)  # type: ignore[misc]
                rejected += 1
    return f"ValueError naming the argument, {rejected} times"


def _nothing_to_continue(real: InputPrecision) -> str:
    image = real(np.full((7, 5, 3), 0.4))
    expect_error(
        lambda: texture_masks.fill_smoothly(image, np.zeros((7, 5), bool)), ValueError, "valid"
    )
    one = np.zeros((7, 5), bool)
    one[3, 2] = True
    image[~one] = np.nan
    return expect_near(
        texture_masks.fill_smoothly(image, one), np.full((7, 5, 3), 0.4), relative=1e-6
    )


def _index_of_nothing(real: InputPrecision) -> str:
    averages = (fresnel.normal_reflectance, fresnel.boundary_factor, fresnel.diffuse_internal)
    for average in averages:
        for bad in (np.nan, np.inf, 0.0, -1.0):
            expect_error(lambda a=average, b=bad: a(float(real(b))), ValueError, "eta")  # type: ignore[misc]
    most = float(np.finfo(real.dtype).max)
    for eta, cosine in ((most, 0.5), (1.0 / most, 0.5), (most, 0.0)):
        if not 0.0 <= float(fresnel.reflectance(real(cosine), eta)) <= 1.0:
            raise ExpectationError(f"eta {eta:g}: expected a reflectance from 0 to 1")
    matched = [float(fresnel.reflectance(real(c), 1.0)) for c in (0.0, 1e-3, 1.0)]
    return expect_within(matched, 0.0, 1e-12, label="matched: reflectance")
