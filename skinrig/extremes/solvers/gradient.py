"""Extremes of normals from gradient patterns on a mirror-like surface under an even sphere."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.gradient_normals import from_patterns
from reconstruction.normal_maps import NormalMaps
from skinrig.arrays import Float64Array
from skinrig.extremes.expectations import (
    expect_error,
    expect_finite,
    expect_near,
    expect_valid_fraction,
)
from skinrig.extremes.inputs import InputPrecision

PATTERN_AXES = ("x", "y", "z")


def _images(
    real: InputPrecision, normals: Float64Array, scale: float = 1.0
) -> dict[tuple[str, str], NDArray[Any]]:
    """Return images of specular reflection alone: the mirror direction's gradients, both signs."""
    mirror = 2.0 * normals[..., 2:] * normals - np.array([0.0, 0.0, 1.0])
    images: dict[tuple[str, str], NDArray[Any]] = {}
    for polarizer, gain in (("parallel", 1.0), ("crossed", 0.0)):
        images["full", polarizer] = real(gain * scale * np.ones(normals.shape[:2]))
        for k, axis in enumerate(PATTERN_AXES):
            for name, sign in ((axis, 1.0), (f"-{axis}", -1.0)):
                shown = 0.5 * (1.0 + sign * mirror[..., k])
                images[name, polarizer] = real(gain * scale * shown)
    return images


def _tilted(degrees: float) -> Float64Array:
    angle = np.deg2rad(degrees)
    one = np.array([np.sin(angle), 0.0, np.cos(angle)])
    return np.broadcast_to(one, (4, 4, 3)).copy()


def _solve(real: InputPrecision, normals: Float64Array, scale: float = 1.0) -> NormalMaps:
    return from_patterns(_images(real, normals, scale))


def _steep_mirror(real: InputPrecision) -> str:
    texts = []
    for degrees in (0.0, 45.0, 80.0):
        normals = _tilted(degrees)
        found = _solve(real, normals)
        texts.append(expect_valid_fraction(found.valid, fraction_range=(1.0, 1.0)))
        expect_near(found.normals, normals, absolute=1e-3)
    return f"{', '.join(texts)}, within 0.001"


def _no_reflection(real: InputPrecision) -> str:
    return expect_valid_fraction(_solve(real, _tilted(10.0), 0.0).valid)


def _faint_reflection(real: InputPrecision) -> str:
    normals = _tilted(20.0)
    for scale in (1e-9, 1e9):
        found = _solve(real, normals, scale)
        expect_near(found.normals, normals, absolute=1e-3)
    return "equal normals at 1e-9 and 1e9"


def _broken_pixels(real: InputPrecision) -> str:
    images = _images(real, _tilted(15.0))
    bad = np.array(images["x", "parallel"])
    bad[0, 0], bad[1, 1] = np.nan, np.inf
    images["x", "parallel"] = bad
    found = from_patterns(images)
    expect_finite(found.normals, found.valid, label="normals")
    return expect_valid_fraction(found.valid, fraction_range=(0.85, 1.0))


def _missing_axis(real: InputPrecision) -> str:
    images = _images(real, _tilted(15.0))
    kept = {key: image for key, image in images.items() if key[0] not in ("y", "-y")}
    return expect_error(lambda: from_patterns(kept), ValueError)
