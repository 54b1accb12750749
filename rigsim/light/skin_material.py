"""Describe the reflection of skin and targets to Mitsuba, as `skincoat` or its own materials."""

from typing import Any, Final

import numpy as np

from rigsim.arrays import Float32Array
from rigsim.light import surface_brdf as brdf
from rigsim.targets import Target
from rigsim.tissue.skin_layers import ETA

SURFACE_PARAMETERS: Final = ("alpha", "oil", "vellus", "bare")
COATING_PARAMETERS: Final = ("film", "film_alpha", "film_ior", "powder")
"""Parameters of `skincoat` in the order of `rigsim.light.surface_brdf.SkinSurface.packed`."""


def describe_skin(layers: Float32Array) -> dict[str, Any]:
    """Return the description of skin as a `skincoat` (`rigsim.mitsuba.skin_coat`).

    Parameters
    ----------
    layers
        Surface and unit normals with relief in the last three, (N, N, 10) or with a coating
        (N, N, 14), row 0 is the top (v = 1); dilated, so that sampling may interpolate.
    """
    surface, normals = np.maximum(layers[..., :-3], np.float32(0.0)), layers[..., -3:]
    names = SURFACE_PARAMETERS + COATING_PARAMETERS
    scalars = dict(zip(names, np.moveaxis(surface[..., 3:], -1, 0), strict=False))
    return {
        "type": "skincoat",
        "int_ior": ETA,
        "oil_ior": brdf.ETA_OIL,
        "oil_smoothing": brdf.OIL_SMOOTHING,
        "vellus_albedo": brdf.FUZZ_ALBEDO,
        "powder_albedo": brdf.POWDER_ALBEDO,
        "powder_asymmetry": brdf.POWDER_ASYMMETRY,
        "r_d": describe_texture(surface[..., :3]),
        "normals": describe_texture(normals),
        **{name: describe_texture(values) for name, values in scalars.items()},
    }


def describe_target(target: Target, camera: str, illuminant: str) -> dict[str, Any]:
    """Return the description of a reflecting target by Mitsuba's own materials.

    Parameters
    ----------
    target
        A diffuse or a metal target.
    camera, illuminant
        Names in `model.spectra`.
    """
    color = describe_texture(target.rgb(camera, illuminant), filter_type="nearest")
    if target.kind != "metal":
        return {"type": "diffuse", "reflectance": color}
    return {
        "type": "roughconductor",
        "distribution": "ggx",
        "alpha": float(target.alpha),
        "material": "none",
        "specular_reflectance": color,
    }


def describe_texture(values: Float32Array, *, filter_type: str = "bilinear") -> dict[str, Any]:
    """Return the description of a linear texture, shape (N, N[, 3]), row 0 is the top (v = 1)."""
    return {
        "type": "bitmap",
        "bitmap": np.flipud(values),  # Mitsuba's v runs down the rows
        "raw": True,
        "filter_type": filter_type,
        "wrap_mode": "clamp",
    }
