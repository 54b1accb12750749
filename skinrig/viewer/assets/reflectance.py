"""Build the page's fitted reflectance: basis BRDFs as one table, weights, diffusion profile.

Names in the page: textures `lobe_atlas` (see `build_atlas`), `lobe_shares` (weights, layers of four
basis BRDFs) and `translucency` (local width of scattering relative to the profile); facts
`reflectance` and `profile` (variances and weights of the Gaussians, stated errors).
"""

from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from model import color_table, merl, skin_reflectance, spectra
from model.brdf import tables as brdf_tables
from model.brdf.tables import NODES_D, NODES_H, NODES_PHI, BrdfBasis
from model.skin import SkinAppearance
from model.skin_reflectance import TRANSLUCENCY_MAP
from model.tissue_optics.layers import ANISOTROPY_SKIN
from model.traits import storage as trait_storage
from reconstruction.surface import texture_fill
from skinrig.appearances.contents import FUSION_KEY
from skinrig.arrays import BoolArray, Float32Array, Float64Array
from skinrig.editing import surface_mixtures
from skinrig.viewer.assets import gaussian_profiles
from skinrig.viewer.assets.gaussian_profiles import GaussianProfile
from skinrig.viewer.scene import Assets, SceneSource, Texture

TRIED_SLABS: Final = (1, 2, 3, 4, 6, 12)
MIN_STRONG_FRACTION: Final = 0.01
"""Minimum value, fraction of a BRDF's peak, for the error of single values."""
MAX_SHAPE_ERROR: Final = 0.01
"""Limit of both relative errors of a chosen table."""
LOBES_PER_LOOKUP: Final = 4
"""Basis BRDFs per look-up."""


@dataclass(frozen=True, slots=True, eq=False)
class CompactBrdf:
    """Basis BRDFs in a compact table, with errors and cost.

    Attributes
    ----------
    slabs : int
        Number of slabs of phi_d.
    table : ndarray of float64, shape (32, 12, 90, K)
        1/sr, values as decoded by the page at the nodes of `model.brdf.tables`.
    rms_error, strong_error : float
        See `compute_table_errors`.
    """

    slabs: int
    table: Float64Array
    rms_error: float
    strong_error: float

    @property
    def lookups(self) -> int:
        """Filtered look-ups per light for all basis BRDFs."""
        return -(-self.table.shape[-1] // LOBES_PER_LOOKUP)

    @property
    def size_bytes(self) -> int:
        """Size before compression, 16 bits per value."""
        return 2 * self.slabs * NODES_D * NODES_H * self.lookups * LOBES_PER_LOOKUP


def choose_table(lobes: BrdfBasis) -> CompactBrdf:
    """Choose the table with the fewest slabs whose errors are within `MAX_SHAPE_ERROR`.

    The finest table has only rounding errors of 16 bits, so that one always suffices.
    """
    table = lobes.table[..., : lobes.size].astype(np.float64)
    for slabs in TRIED_SLABS:
        back = average_slabs(table, slabs)
        found = CompactBrdf(slabs, back, *compute_table_errors(back, table))
        if max(found.rms_error, found.strong_error) <= MAX_SHAPE_ERROR:
            break
    return found


def average_slabs(table: Float64Array, slabs: int) -> Float64Array:
    """Average runs of phi_d nodes over the visible half-space, (32, 12, 90, K)."""
    if slabs not in TRIED_SLABS:
        raise ValueError(f"slabs: got {slabs}, expected one of {', '.join(map(str, TRIED_SLABS))}")
    weight = _cosines()[..., None] + 1e-9
    width = NODES_PHI // slabs
    parts = table.reshape(NODES_D, slabs, width, NODES_H, -1)
    share = weight.reshape(NODES_D, slabs, width, NODES_H, 1)
    mean = (parts * share).sum(axis=2, keepdims=True) / share.sum(axis=2, keepdims=True)
    held = np.asarray(mean, np.float16).astype(np.float64)
    return np.broadcast_to(held, parts.shape).reshape(table.shape)


def build_atlas(found: CompactBrdf) -> Float32Array:
    """Arrange a table as an image for bilinear look-ups, (G * slabs * 32, 90, 4).

    Group g of four basis BRDFs, slab s and node i of theta_d are row (g * slabs + s) * 32 + i;
    columns are theta_h; basis BRDF 4 g + c is channel c. Unused channels are 0.
    """
    kept = found.table[:, :: NODES_PHI // found.slabs].astype(np.float32)
    layers = pack_fours(kept)
    return np.ascontiguousarray(layers.transpose(0, 2, 1, 3, 4)).reshape(
        -1, NODES_H, LOBES_PER_LOOKUP
    )


def pack_fours(values: Float32Array) -> Float32Array:
    """Arrange values of basis BRDFs, (..., K), in layers of four, (L, ..., 4), padded with 0."""
    groups = -(-values.shape[-1] // LOBES_PER_LOOKUP)
    missing = groups * LOBES_PER_LOOKUP - values.shape[-1]
    padded = np.pad(values, (*[(0, 0)] * (values.ndim - 1), (0, missing)))
    split = padded.reshape(*values.shape[:-1], groups, LOBES_PER_LOOKUP)
    return np.ascontiguousarray(np.moveaxis(split, -2, 0))


def compute_table_errors(decoded: Float64Array, table: Float64Array) -> tuple[float, float]:
    """Return two errors of decoded values, (32, 12, 90, K), each of the worst basis BRDF.

    Returns
    -------
    rms : float
        RMS difference relative to the BRDF's RMS, weighted by solid angle and both cosines.
    strong : float
        95th percentile of the relative difference of values above `MIN_STRONG_FRACTION` of the
        peak.
    """
    weight = (compute_solid_angle_weights() * _cosines())[..., None]
    off = np.sum(weight * (decoded - table) ** 2, axis=(0, 1, 2))
    own = np.sum(weight * table**2, axis=(0, 1, 2))
    rms = float(np.sqrt(np.max(np.where(own > 0.0, off / np.maximum(own, 1e-300), 0.0))))
    worst = 0.0
    for k in range(table.shape[-1]):
        one = table[..., k]
        strong = (one > MIN_STRONG_FRACTION * one.max()) & (_cosines() > 0.0)
        if strong.any():
            relative = np.abs(decoded[..., k] - one)[strong] / one[strong]
            worst = max(worst, float(np.percentile(relative, 95.0)))
    return rms, worst


def compute_solid_angle_weights() -> Float64Array:
    """Return the solid angle of each node up to a factor, (32, 12, 90)."""
    d, _, h = brdf_tables.grid_nodes()
    solid = np.sin(2.0 * d)[:, None, None] * (np.sin(h) * np.gradient(h))
    return np.asarray(np.broadcast_to(solid, (NODES_D, NODES_PHI, NODES_H)))


def _cosines() -> Float64Array:
    """Return the product of the cosines of light and view at the nodes, 0 below the horizon."""
    d, phi, h = np.meshgrid(*brdf_tables.grid_nodes(), indexing="ij")
    light, view = merl.to_directions(h, d, phi)
    mu_l, mu_v = light[..., 2], view[..., 2]
    return np.asarray(np.where((mu_l > 0.0) & (mu_v > 0.0), mu_l * mu_v, 0.0))


WEIGHT_MAP_PX: Final = 256
"""Maximum side of weight maps; finer ones are averaged."""
WEIGHT_BITS: Final = 7
"""Binary digits of a weight in the page: within 0.8 %, a sixth of a fit's errors."""
TRANSLUCENCY_PX: Final = 128
"""Side of the map of scattering widths; it is smooth, as it is interpolated from a few sites."""
POPULATION_SPACE: Final = "surface"
"""Space of the trait library whose center is the mean surface of a population."""
FACIAL_R_D: Final = (0.46, 0.31, 0.23)
"""R_d of facial skin, Weyrich et al. 2006, figure 11, linear sRGB; it shapes the profile's core."""
TYPICAL_CHROMOPHORES: Final = (0.03, 0.03)
"""Volume fractions of melanosomes and blood whose color replaces an unmeasured R_d; the shape of a
profile depends little on it."""

Origin = Literal["fitted", "population"]


@dataclass(frozen=True, slots=True, eq=False)
class PageLobes:
    """Basis BRDFs and weights before packing.

    Attributes
    ----------
    lobes
        K basis BRDFs, 1/sr.
    shares : ndarray of float32, shape (H, W, K)
        Weights; row 0 at the top.
    mix : ndarray of float64, shape (K, M)
        Each basis BRDF as a mixture of `materials`.
    materials
        Names of the M materials.
    origin
        "fitted" to a face, or "population": the mean of simulated people.
    """

    lobes: BrdfBasis
    shares: Float32Array
    mix: Float64Array
    materials: tuple[str, ...]
    origin: Origin


def build_lobe_assets(source: SceneSource, found: PageLobes) -> Assets:
    """Build the assets of basis BRDFs, including those added by traits."""
    compact = choose_table(found.lobes)
    profile, widths, origin = _diffusion_of(source)
    # the packer flips images vertically; the rows of this one must keep the shader's order
    rows = np.ascontiguousarray(build_atlas(compact)[::-1])
    textures = {
        "lobe_atlas": Texture(rows, "f16"),
        "lobe_shares": Texture(round_weights(pack_fours(found.shares)), "f16"),
    }
    if widths is not None:
        textures["translucency"] = Texture(widths[..., None], "u8")
    return {
        "textures": textures,
        "facts": {"reflectance": _facts(found, compact), "profile": profile.facts(origin)},
        "left_out": _list_omissions(found, origin),
    }


def build_default_scattering(source: SceneSource) -> Assets:
    """Build the diffusion profile of the population's mean dipole, for unmeasured skin.

    The page can switch between it and the profile of the fitted reflectance.
    """
    depth_mm, origin = skin_reflectance.population_mean_mm()
    profile = gaussian_profiles.fit_gaussians(FACIAL_R_D, 1.0 / depth_mm)
    return {"facts": {"scattering": profile.facts(origin)}}


def read_lobes(source: SceneSource) -> PageLobes:
    """Read the basis BRDFs and weights of a face, or of a population's mean."""
    for appearance in source.fitted:
        if skin_reflectance.BASIS_FILE in appearance.files:
            lobes = skin_reflectance.load_basis(appearance)
            mixtures = surface_mixtures.read(appearance)
            shares = fill_texels(
                mixtures.weights().astype(np.float32), mixtures.valid, WEIGHT_MAP_PX
            )
            shares = np.maximum(shares, np.float32(0.0))  # filling can undershoot
            return PageLobes(lobes, shares, mixtures.mix, mixtures.materials, "fitted")
    space = trait_storage.load_packaged_traits().spaces[POPULATION_SPACE]
    materials = brdf_tables.default_basis()
    if space.names and space.names != materials.names:
        raise RuntimeError("the packaged traits are of other materials than this package's")
    mix = np.maximum(space.center, 0.0)[None, :]
    total = float(mix.sum())
    shares = np.full((1, 1, 1), total, np.float32)
    lobes = materials.mix_materials(mix / total)
    return PageLobes(lobes, shares, mix / total, materials.names, "population")


def round_weights(values: Float32Array) -> Float32Array:
    """Round weights to `WEIGHT_BITS` binary digits, since fits are accurate to percents.

    Examples
    --------
    >>> round_weights(np.array([0.0, 1.0, 1.01, -0.3], np.float32)).tolist()
    [0.0, 1.0, 1.015625, -0.30078125]
    """
    mantissa, exponent = np.frexp(values)
    steps = np.float32(2**WEIGHT_BITS)
    return np.asarray(np.ldexp(np.rint(mantissa * steps) / steps, exponent), np.float32)


def fill_texels(values: Float32Array, valid: BoolArray, max_px: int) -> Float32Array:
    """Fill invalid texels from their surroundings and reduce to at most `max_px` per side.

    Parameters
    ----------
    values
        (H, W, C).
    valid
        (H, W).
    max_px
        Maximum side of the result, (h, w, C); larger maps are averaged over whole blocks.
    """
    step = -(-max(values.shape[:2]) // max_px)
    kept = valid.astype(np.float32)
    held = np.where(valid[..., None], values, np.float32(0.0))
    if step > 1:
        held, kept = _blocks(held, step), _blocks(kept[..., None], step)[..., 0]
        held = held / np.maximum(kept, np.float32(1e-6))[..., None]
    if not kept.any():
        return np.zeros(held.shape, np.float32)
    return np.asarray(texture_fill.push_pull(held, kept).values, np.float32)


def _diffusion_of(source: SceneSource) -> tuple[GaussianProfile, Float32Array | None, str]:
    """Return the profile of a face's mean, its relative width per texel, and its source.

    Returns
    -------
    profile
        Profile of the mean translucency and albedo.
    widths : ndarray of float32, shape (H, W), or None
        Geometric mean over channels of 1/sigma_tr relative to the profile; None: 1 everywhere.
    origin
        Source of the translucency, in words.
    """
    mean_mm, origin = skin_reflectance.population_mean_mm()
    probe = source.appearances.get("probe")
    if not source.fitted and probe is None:
        return gaussian_profiles.fit_gaussians(_typical_r_d(), 1.0 / mean_mm), None, origin
    r_d = _mean_albedo(source.fitted[0]) if source.fitted else _typical_r_d()
    appearance = source.fitted[0] if probe is None else probe
    depth = appearance.maps.get(TRANSLUCENCY_MAP)
    if depth is None or not (known := depth.mask & (depth.values > 0).all(-1)).any():
        return gaussian_profiles.fit_gaussians(r_d, 1.0 / mean_mm), None, origin
    logs = np.log(np.where(known[..., None], depth.values, 1.0)).astype(np.float32)
    mean = logs[known].astype(np.float64).mean(axis=0)
    off = (logs - mean.astype(np.float32)).mean(axis=-1, keepdims=True)
    widths = np.exp(fill_texels(off, known, TRANSLUCENCY_PX)[..., 0])
    record: Any = appearance.parameters.get("reflectance_model")
    fused: Any = appearance.parameters.get(FUSION_KEY, {"maps": {}})
    by_probe = appearance is probe or "probe" in fused["maps"].get(TRANSLUCENCY_MAP, ())
    if by_probe or (isinstance(record, dict) and record.get("translucency") == "measured"):
        origin = "a fiber probe on this face"
    even = float(np.ptp(widths)) < 1e-3
    return gaussian_profiles.fit_gaussians(r_d, np.exp(-mean)), None if even else widths, origin


def _mean_albedo(appearance: SkinAppearance) -> Float64Array:
    r_d = appearance.maps.get("r_d")
    if r_d is None or not r_d.mask.any():
        return _typical_r_d()
    middle = np.median(r_d.values[r_d.mask].astype(np.float64), axis=0)
    return np.asarray(np.clip(middle, 0.01, 0.98))


def _typical_r_d() -> Float64Array:
    table = color_table.build(spectra.LINEAR_SRGB, "D65", size=32, anisotropy=ANISOTROPY_SKIN)
    return np.asarray(table.lookup(*TYPICAL_CHROMOPHORES))


def _blocks(values: Float32Array, step: int) -> Float32Array:
    """Return means over blocks of `step` texels, without incomplete blocks."""
    height, width = (size // step * step for size in values.shape[:2])
    cut = values[:height, :width]
    parts = cut.reshape(height // step, step, width // step, step, -1)
    return np.asarray(parts.mean(axis=(1, 3)), np.float32)


def _facts(found: PageLobes, compact: CompactBrdf) -> dict[str, Any]:
    of_table = ("slabs", "lookups", "rms_error", "strong_error")
    return {
        "origin": found.origin,
        "lobes": found.lobes.size,
        "table_bytes": compact.size_bytes,
        **{name: getattr(compact, name) for name in of_table},
        "light_radius_rad": found.lobes.light_radius_rad,
    }


def _list_omissions(found: PageLobes, origin: str) -> tuple[tuple[str, str], ...]:
    rows = {}
    if found.origin == "population":
        rows["basis BRDFs of this face"] = (
            "not fitted; the mean of simulated people is displayed. Use `skinrig view MODEL` with "
            "the maps of a dome for those of a face"
        )
    if "probe" not in origin:
        rows["diffuse mean free path of this face"] = f"not measured by a probe: {origin}"
    return tuple(rows.items())
