"""Fitted reflectance for the page: lobes as one table, their shares, a profile of scattering.

Names in the page: textures `lobe_atlas` (see `compact_brdf.atlas`), `lobe_shares` (layers of four
lobes) and `translucency` (how much wider than the profile light spreads at a texel); facts
`reflectance` and `profile` (variances and weights of the Gaussians, stated errors).
"""

from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from model import color_table, skin_reflectance, spectra
from model.brdf import tables as brdf_tables
from model.brdf.tables import BrdfBasis
from model.skin import SkinAppearance
from model.skin_reflectance import TRANSLUCENCY_MAP
from model.tissue_optics.layers import ANISOTROPY_SKIN
from model.traits import storage as trait_storage
from reconstruction.surface import texture_fill
from skinrig.arrays import BoolArray, Float32Array, Float64Array
from skinrig.editing import surface_mixtures
from skinrig.viewer.assets import compact_brdf, gaussian_profiles
from skinrig.viewer.assets.compact_brdf import CompactBrdf
from skinrig.viewer.assets.gaussian_profiles import GaussianProfile
from skinrig.viewer.scene import Assets, SceneSource, Texture

SHARES_PX: Final = 256
"""Most texels a side of the maps of shares; finer ones are averaged."""
SHARE_BITS: Final = 7
"""Binary digits of a share in the page: within 0.8 %, a sixth of a fit's own errors."""
TRANSLUCENCY_PX: Final = 128
"""Texels a side of the map of widths: a probe measures few places, between them it is smooth."""
POPULATION_SPACE: Final = "surface"
"""Space of the trait library whose centre is the mean surface of a population."""
FACIAL_R_D: Final = (0.46, 0.31, 0.23)
"""R_d of facial skin, Weyrich et al. 2006, figure 11, linear sRGB; it shapes the profile's core."""
TYPICAL_CHROMOPHORES: Final = (0.03, 0.03)
"""Volume fractions of melanin and hemoglobin, whose color stands in for R_d where there is none:
the shape of a profile depends little on it."""

Origin = Literal["fitted", "population"]


@dataclass(frozen=True, slots=True, eq=False)
class PageLobes:
    """Lobes and shares before they are packed.

    Attributes
    ----------
    lobes
        K lobes, 1/sr.
    shares : ndarray of float32, shape (H, W, K)
        Row 0 at the top.
    mix : ndarray of float64, shape (K, M)
        Each lobe as a mixture of `materials`.
    materials
        M names.
    origin
        "fitted" to a face, or "population": the mean of simulated people.
    """

    lobes: BrdfBasis
    shares: Float32Array
    mix: Float64Array
    materials: tuple[str, ...]
    origin: Origin


def assemble(source: SceneSource, found: PageLobes) -> Assets:
    """Return the assets of some lobes, which may hold those of traits too."""
    compact = compact_brdf.chosen(found.lobes)
    profile, widths, told = _diffusion_of(source)
    # the packer turns pictures over; this one's rows stand as the shader counts them
    rows = np.ascontiguousarray(compact_brdf.atlas(compact)[::-1])
    textures = {
        "lobe_atlas": Texture(rows, "f16"),
        "lobe_shares": Texture(rounded(compact_brdf.in_fours(found.shares)), "f16"),
    }
    if widths is not None:
        textures["translucency"] = Texture(widths[..., None], "u8")
    return {
        "textures": textures,
        "facts": {"reflectance": _facts(found, compact), "profile": profile.facts(told)},
        "left_out": _left_out(found, told),
    }


def default_scattering(source: SceneSource) -> Assets:
    """Return the profile of the population's mean dipole, for skin of which nothing was measured.

    The page switches between it and that of the fitted reflectance.
    """
    depth_mm, told = skin_reflectance.population_mean_mm()
    profile = gaussian_profiles.fit(FACIAL_R_D, 1.0 / depth_mm)
    return {"facts": {"scattering": profile.facts(told)}}


def lobes_of(source: SceneSource) -> PageLobes:
    """Return the lobes of a face, or of the mean of a population."""
    for appearance in source.fitted:
        if skin_reflectance.BASIS_FILE in appearance.files:
            lobes = skin_reflectance.lobes_of(appearance)
            mixtures = surface_mixtures.read(appearance)
            shares = filled(mixtures.weights().astype(np.float32), mixtures.valid, SHARES_PX)
            shares = np.maximum(shares, np.float32(0.0))  # filling can undershoot
            return PageLobes(lobes, shares, mixtures.mix, mixtures.materials, "fitted")
    space = trait_storage.default().spaces[POPULATION_SPACE]
    materials = brdf_tables.default()
    if space.names and space.names != materials.names:
        raise RuntimeError("the packaged traits are of other materials than this package's")
    mix = np.maximum(space.center, 0.0)[None, :]
    total = float(mix.sum())
    shares = np.full((1, 1, 1), total, np.float32)
    lobes = materials.mixed(mix / total)
    return PageLobes(lobes, shares, mix / total, materials.names, "population")


def rounded(values: Float32Array) -> Float32Array:
    """Return numbers with `SHARE_BITS` binary digits, the nearest: a fit knows shares to percents.

    Examples
    --------
    >>> rounded(np.array([0.0, 1.0, 1.01, -0.3], np.float32)).tolist()
    [0.0, 1.0, 1.015625, -0.30078125]
    """
    mantissa, exponent = np.frexp(values)
    steps = np.float32(2**SHARE_BITS)
    return np.asarray(np.ldexp(np.rint(mantissa * steps) / steps, exponent), np.float32)


def filled(values: Float32Array, valid: BoolArray, most: int) -> Float32Array:
    """Return (h, w, C) with values in texels that have none, no more than `most` a side.

    Parameters
    ----------
    values
        (H, W, C).
    valid
        (H, W).
    most
        Texels a side; larger maps are averaged over whole blocks.
    """
    step = -(-max(values.shape[:2]) // most)
    kept = valid.astype(np.float32)
    held = np.where(valid[..., None], values, np.float32(0.0))
    if step > 1:
        held, kept = _blocks(held, step), _blocks(kept[..., None], step)[..., 0]
        held = held / np.maximum(kept, np.float32(1e-6))[..., None]
    if not kept.any():
        return np.zeros(held.shape, np.float32)
    return np.asarray(texture_fill.push_pull(held, kept).values, np.float32)


def _diffusion_of(source: SceneSource) -> tuple[GaussianProfile, Float32Array | None, str]:
    """Return the profile at a face's mean, how much wider it is at each texel, and where from.

    Returns
    -------
    profile
        Of the mean translucency and albedo.
    widths : ndarray of float32, shape (H, W), or None
        Geometric mean over the channels of 1/sigma_tr over that of the profile; None: everywhere 1.
    told
        Where the translucency comes from, for people.
    """
    for appearance in source.fitted:
        r_d = _mean_albedo(appearance)
        if TRANSLUCENCY_MAP in appearance.maps:
            depth = appearance.maps[TRANSLUCENCY_MAP]
            known = depth.mask & np.isfinite(depth.values).all(-1) & (depth.values > 0).all(-1)
            if known.any():
                logs = np.log(np.where(known[..., None], depth.values, 1.0)).astype(np.float32)
                mean = logs[known].astype(np.float64).mean(axis=0)
                off = (logs - mean.astype(np.float32)).mean(axis=-1, keepdims=True)
                widths = np.exp(filled(off, known, TRANSLUCENCY_PX)[..., 0])
                even = float(np.ptp(widths)) < 1e-3
                profile = gaussian_profiles.fit(r_d, np.exp(-mean))
                return profile, None if even else widths, _told(appearance)
        mean_mm, told = skin_reflectance.population_mean_mm()
        return gaussian_profiles.fit(r_d, 1.0 / mean_mm), None, told
    mean_mm, told = skin_reflectance.population_mean_mm()
    return gaussian_profiles.fit(_typical_r_d(), 1.0 / mean_mm), None, told


def _mean_albedo(appearance: SkinAppearance) -> Float64Array:
    if "r_d" not in appearance.maps:
        return _typical_r_d()
    r_d = appearance.maps["r_d"]
    good = r_d.mask & np.isfinite(r_d.values).all(-1)
    if not good.any():
        return _typical_r_d()
    return np.asarray(np.clip(np.median(r_d.values[good].astype(np.float64), axis=0), 0.01, 0.98))


def _typical_r_d() -> Float64Array:
    table = color_table.build(spectra.LINEAR_SRGB, "D65", size=32, anisotropy=ANISOTROPY_SKIN)
    return np.asarray(table.lookup(*TYPICAL_CHROMOPHORES))


def _told(appearance: SkinAppearance) -> str:
    record: Any = appearance.parameters.get("reflectance_model")
    if isinstance(record, dict) and record.get("translucency") == "measured":
        return "a fibre probe on this face"
    return skin_reflectance.population_mean_mm()[1]


def _blocks(values: Float32Array, step: int) -> Float32Array:
    """Return means over blocks of `step` texels; what is beyond whole blocks is left out."""
    height, width = (size // step * step for size in values.shape[:2])
    cut = values[:height, :width]
    parts = cut.reshape(height // step, step, width // step, step, -1)
    return np.asarray(parts.mean(axis=(1, 3)), np.float32)


def _facts(found: PageLobes, compact: CompactBrdf) -> dict[str, Any]:
    return {
        "origin": found.origin,
        "lobes": found.lobes.size,
        "slabs": compact.slabs,
        "table_bytes": compact.size_bytes,
        "lookups": compact.lookups,
        "rms_error": compact.rms_error,
        "strong_error": compact.strong_error,
        "light_radius_rad": found.lobes.light_radius_rad,
    }


def _left_out(found: PageLobes, told: str) -> tuple[tuple[str, str], ...]:
    rows = {}
    if found.origin == "population":
        rows["lobes of this face"] = (
            "none are fitted: the fitted reflectance shown is the mean surface of simulated "
            "people; `skinrig view MODEL` with a dome's maps shows a face's own"
        )
    if "probe" not in told:
        rows["translucency of this face"] = f"no probe measured it: {told}"
    return tuple(rows.items())
