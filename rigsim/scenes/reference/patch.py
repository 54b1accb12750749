"""A patch of a person's face as voxels, before the flash rig's camera and lights."""

from collections.abc import Callable
from dataclasses import dataclass
from math import atan, degrees, hypot
from typing import Any, Final

import numpy as np

from capture.rig import Rig
from model import spectra
from rigsim import shading
from rigsim.arrays import Float32Array, Float64Array
from rigsim.geometry.atlas import unwrap
from rigsim.geometry.mesh import Mesh, build_mesh
from rigsim.light.subsurface_radiance import scatter_patterned_light
from rigsim.mitsuba.scene_radiance import look_at, radiance
from rigsim.scenes.reference.flat_layers import describe_boundary, render_voxels
from rigsim.skin_patch.microrelief import make_micro_skin
from rigsim.subject.person_skin import PersonSkin, skin_maps
from rigsim.tissue.lateral_kernels import SIGMAS_MM
from rigsim.tissue.skin_color import skin_color
from rigsim.tissue.skin_layers import (
    BASAL_THICKNESS_FRACTION,
    DERMIS_SCATTERING_RATIO,
    ETA,
    SKIN_ANISOTROPY,
    TissueProperties,
    skin_coefficients,
)
from rigsim.tissue.skin_table import WAVELENGTH_NM, SkinTable

MARGIN_MM: Final = 4.0
"""Voxels beyond the field; skin continues beyond them as at their border."""
SKIN_HALF_MM: Final = 60.0
"""Half-width of the boundary."""
FLOOR_MM: Final = 60.0
ROWS_PER_EPIDERMIS: Final = 3
RELIEF_ROWS_PER_EPIDERMIS: Final = 6
RELIEF_TEXEL_UM: Final = 20.0
SMOOTH_ROUGHNESS: Final = 0.05
"""Beckmann roughness of a flat boundary. Mitsuba's facets lose what they reflect onto each other:
0.6 % of all light in a white furnace at 0.05, 2.6 % at 0.15, 7 % at 0.25."""
MIN_SAMPLES: Final = 2
"""Samples per pixel at the wavelength to which the camera is least sensitive."""


@dataclass(frozen=True, slots=True, eq=False)
class SkinPatch:
    """Skin of a person around a site, plane but for its relief."""

    field_mm: float
    """Side of the camera's field, mm."""
    voxel_mm: float
    """Side of a voxel along the surface, mm."""
    x_mm: Float64Array
    """Positions of the voxels' centers along x and along y, shape (n,)."""
    melanin: Float32Array
    """Volume fraction of melanosomes, shape (n, n), rows along +y."""
    blood: Float32Array
    """Blood volume fraction, shape (n, n)."""
    tissue: TissueProperties
    """All other properties."""
    alpha: float
    """Beckmann roughness of the boundary."""
    height_mm: Float64Array | None
    """Height of the surface over its mean plane, shape (n, n); None: flat."""


@dataclass(frozen=True, slots=True, eq=False)
class PatchImage:
    """Light from below the surface over that of a white reference in its place."""

    rgb: Float64Array
    """White-balanced camera RGB, shape (H, W, 3)."""
    variance: Float64Array
    """Variance of the renderer's noise, shape (H, W, 3)."""


def draw_patch(
    person: PersonSkin,
    site: str,
    *,
    state: str = "neutral",
    field_mm: float,
    voxel_mm: float,
    alpha: float = SMOOTH_ROUGHNESS,
    relief: bool = False,
) -> SkinPatch:
    """Return the skin of a person around a site.

    Parameters
    ----------
    person, site, state
        As for `rigsim.subject.person_skin.skin_maps`.
    field_mm
        Side of the camera's field, mm.
    voxel_mm
        Side of a voxel along the surface, mm.
    alpha
        Beckmann roughness of the boundary, above 0.
    relief
        Whether the surface has the grooves of `rigsim.skin_patch.microrelief`.

    Examples
    --------
    >>> patch = draw_patch(PersonSkin.of_preset("III"), "cheek", field_mm=4.0, voxel_mm=0.5)
    >>> patch.melanin.shape, patch.height_mm is None
    ((24, 24), True)
    """
    count = round((field_mm + 2.0 * MARGIN_MM) / voxel_mm)
    x = np.asarray((np.arange(count) - 0.5 * (count - 1)) * voxel_mm, np.float64)
    melanin, blood = skin_maps(person, site, state, x[None, :], x[:, None])
    height = None
    if relief:
        size_mm = count * voxel_mm
        skin = make_micro_skin(
            site, seed=person.seed, size_mm=size_mm, texel_um=RELIEF_TEXEL_UM, person=person
        )
        height = _block_mean(1e-3 * skin.height_um[::-1].astype(np.float64), count)
        height -= float(height.mean())
    tissue = person.at(site).tissue
    return SkinPatch(field_mm, voxel_mm, x, melanin, blood, tissue, alpha, height)


def render_patch(
    patch: SkinPatch,
    rig: Rig,
    *,
    width_px: int,
    samples: int,
    seed: int,
    progress: Callable[[str], None] | None = None,
) -> PatchImage:
    """Render the patch before the flash rig, one band of the spectrum after the other.

    Parameters
    ----------
    patch
        The skin.
    rig
        The flash rig: positions and energies of its lights, and its first camera's.
    width_px
        Pixels along each side of the field.
    samples
        Samples per pixel at the wavelength to which the camera is most sensitive.
    seed
        Seed of the sampler, >= 0.
    progress
        Called with a line per wavelength.

    Returns
    -------
    PatchImage
        Ideal crossed polarizers remove the surface's own reflection; light from below it is
        unpolarized. Two renders of half of the samples give the variance.
    """
    view, light = rig.views[0], rig.lights[0].illuminant
    weights = spectra.band_weights(view.spectral_sensitivity, light, WAVELENGTH_NM)
    importance = weights.max(axis=1) / weights.max()
    white = _render_white(patch, rig, width_px)[..., None]
    rgb = np.zeros((2, width_px, width_px, 3))
    for band, wavelength_nm in enumerate(WAVELENGTH_NM):
        if progress is not None:
            progress(f"voxels: {wavelength_nm:g} nm, {band + 1} of {len(WAVELENGTH_NM)} bands")
        scene = describe_patch(patch, rig, float(wavelength_nm), width_px=width_px)
        spp = max(round(0.5 * samples * float(importance[band])), MIN_SAMPLES)
        for half in range(2):
            state = np.random.SeedSequence([seed, band, half]).generate_state(1)
            # 30 bits: Dr.Jit takes 31, and the parts of an image add to the seed
            image = render_voxels(scene, samples=spp, seed=int(state[0]) >> 2)
            rgb[half] += weights[band] * image[..., 1:2] / white
    # two values alone do not give a variance: the relative one is that of all pixels
    mean = rgb.mean(axis=0)
    relative = np.square(0.5 * (rgb[0] - rgb[1]) / mean).mean(axis=(0, 1))
    return PatchImage(mean, relative * np.square(mean))


def describe_patch(
    patch: SkinPatch, rig: Rig, wavelength_nm: float, *, width_px: int
) -> dict[str, Any]:
    """Describe the patch at one wavelength, with the rig's camera and lights, for `tissue`."""
    grid, low, high = _voxels(patch, wavelength_nm)
    half = 0.5 * patch.voxel_mm * len(patch.x_mm)
    box = np.diag([2.0 * half, 2.0 * half, high - low, 1.0])
    box[:3, 3] = -half, -half, low
    sigma_t = grid.sum(axis=-1, keepdims=True)

    def volume(values: Float64Array) -> dict[str, Any]:
        return {"type": "gridvolume", "grid": values, "filter_type": "nearest", "to_world": box}

    interior = {
        "type": "heterogeneous",
        "sigma_t": volume(sigma_t),
        "albedo": volume(grid[..., 1:] / sigma_t),
        "phase": {"type": "hg", "g": SKIN_ANISOTROPY},
    }
    skin: dict[str, Any] = {"bsdf": describe_boundary(ETA, patch.alpha), "interior": interior}
    if patch.height_mm is None:
        skin |= {"type": "rectangle", "to_world": np.diag([SKIN_HALF_MM, SKIN_HALF_MM, 1.0, 1.0])}
    else:
        skin |= {"type": "mesh", "mesh": _relief_mesh(patch), "face_normals": True}
    floor = np.diag([SKIN_HALF_MM, SKIN_HALF_MM, 1.0, 1.0])
    floor[2, 3] = -FLOOR_MM
    black = {"type": "diffuse", "reflectance": 0.0}
    return _before_rig(patch, rig, width_px) | {
        "integrator": {"type": "tissue", "max_depth": -1},
        "skin": skin,
        "floor": {"type": "rectangle", "to_world": floor, "bsdf": black},
    }


def predict_patch(patch: SkinPatch, rig: Rig, *, width_px: int) -> Float64Array:
    """Return the same image by the equations of the fast renderer, shape (H, W, 3).

    Color table and lateral profile of `rigsim.scenes.flash`, light that enters by T(n.l) and leaves
    by T(n.v).
    """
    view, light = rig.views[0], rig.lights[0].illuminant
    half = 0.5 * patch.voxel_mm * len(patch.x_mm)
    atlas = unwrap(_plane(half), len(patch.x_mm))
    # texture rows may run down: look the voxels up by position
    column, row = (
        np.clip(np.floor((atlas.position_mm[..., axis] + half) / patch.voxel_mm), 0, None)
        for axis in (0, 1)
    )
    last = len(patch.x_mm) - 1
    at = np.minimum(row, last).astype(np.intp), np.minimum(column, last).astype(np.intp)
    melanin, blood = patch.melanin[at], patch.blood[at]
    color = skin_color(view.spectral_sensitivity, light, patch.tissue)
    weights = spectra.band_weights(view.spectral_sensitivity, light, WAVELENGTH_NM)
    kernels = (
        SkinTable.load(patch.tissue)
        .lateral_kernels(float(np.median(melanin)), float(np.median(blood)), weights)
        .gaussians(SIGMAS_MM)
    )
    scattered = scatter_patterned_light(
        color.rgb(melanin, blood),
        color.rgb(np.zeros_like(melanin), blood),
        np.ones(melanin.shape, np.float32),
        atlas,
        kernels,
    )
    on_voxels = np.empty_like(scattered)
    on_voxels[at] = scattered
    return _pixel_means(patch, on_voxels.astype(np.float64), width_px) * fast_shading(rig)


def fast_shading(rig: Rig) -> float:
    """Return light of a facing plate over a white reference's, per unit of R_d, fast renderer."""
    entered = total = 0.0
    for light in rig.lights:
        x, y, z = light.position_mm
        cosine = z / hypot(x, y, z)
        energy = float(light.energy_ws or 1.0) * cosine / (x * x + y * y + z * z)
        total += energy
        entered += energy * _transmittance(cosine)
    return float(entered / total * _transmittance(1.0) * shading.interior_scale(ETA))


def pixel_truth(patch: SkinPatch, width_px: int) -> tuple[Float64Array, Float64Array]:
    """Return the means of melanin and blood over pixels, shape (H, W)."""
    stack = np.stack([patch.melanin, patch.blood], axis=-1).astype(np.float64)
    found = _pixel_means(patch, stack, width_px)
    return found[..., 0], found[..., 1]


def _transmittance(cosine: float) -> float:
    rs, rp = shading.fresnel_amplitudes(cosine, ETA)
    return float(1.0 - 0.5 * (rs**2 + rp**2))


def _voxels(patch: SkinPatch, wavelength_nm: float) -> tuple[Float64Array, float, float]:
    """Return sigma_a and sigma_s, shape (nz, n, n, 2), and the grid's bottom and top."""
    found = skin_coefficients(wavelength_nm, patch.melanin, patch.blood, patch.tissue)
    thickness = patch.tissue.epidermis_mm
    flat = patch.height_mm is None
    height = np.zeros(patch.melanin.shape) if patch.height_mm is None else patch.height_mm
    row = thickness / (ROWS_PER_EPIDERMIS if flat else RELIEF_ROWS_PER_EPIDERMIS)
    top = float(height.max())
    count = int(np.ceil((top - float(height.min()) + thickness) / row - 1e-9)) + 1
    z = top - (np.arange(count)[::-1] + 0.5) * row
    depth = height - z[:, None, None]
    upper = depth < (1.0 - BASAL_THICKNESS_FRACTION) * thickness
    epidermis = depth < thickness
    sigma_a = np.where(upper, found.upper, np.where(epidermis, found.basal, found.dermis))
    scattering = found.scattering / (1.0 - SKIN_ANISOTROPY)
    sigma_s = np.where(epidermis, scattering, DERMIS_SCATTERING_RATIO * scattering)
    return np.stack([sigma_a, sigma_s], axis=-1), top - count * row, top


def _before_rig(patch: SkinPatch, rig: Rig, width_px: int) -> dict[str, Any]:
    """Describe the camera, whose field is the patch's, and the lights as points."""
    view = rig.views[0]
    distance = hypot(*(a - b for a, b in zip(view.position_mm, view.target_mm, strict=True)))
    lights = {
        f"light{k}": {
            "type": "point",
            "position": [float(x) for x in light.position_mm],
            "intensity": float(light.energy_ws or 1.0),
        }
        for k, light in enumerate(rig.lights)
    }
    return {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": degrees(2.0 * atan(0.5 * patch.field_mm / distance)),
            "near_clip": 1.0,
            "far_clip": 1e4,
            # Mitsuba's local +x points to the left: the image then has x to the right
            "to_world": look_at(view.position_mm, view.target_mm, view.up),
            "film": {
                "type": "hdrfilm",
                "width": width_px,
                "height": width_px,
                "pixel_format": "luminance",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
        },
        **lights,
    }


def _render_white(patch: SkinPatch, rig: Rig, width_px: int) -> Float64Array:
    """Render a white diffuser in the patch's place, shape (H, W)."""
    plate = {
        "type": "rectangle",
        "to_world": np.diag([SKIN_HALF_MM, SKIN_HALF_MM, 1.0, 1.0]),
        "bsdf": {"type": "diffuse", "reflectance": 1.0},
    }
    scene = _before_rig(patch, rig, width_px) | {"integrator": {"type": "direct"}, "plate": plate}
    return radiance(scene, kind="mono", samples=256, seed=0).astype(np.float64)[..., 0]


def _plane(half: float) -> Mesh:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float64)
    xyz = np.column_stack([half * corners, np.zeros(4)])
    return build_mesh(xyz, [[0, 1, 2], [0, 2, 3]], 0.5 * (corners + 1.0))


def _relief_mesh(patch: SkinPatch) -> Mesh:
    """Return the relief as triangles between voxel centers, flat from its border on."""
    height = np.zeros(patch.melanin.shape) if patch.height_mm is None else patch.height_mm
    x = np.concatenate([[-SKIN_HALF_MM], patch.x_mm, [SKIN_HALF_MM]])
    z = np.pad(height, 1)
    count = len(x)
    px, py = (part.ravel() for part in np.meshgrid(x, x))
    at = np.arange(count * count).reshape(count, count)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    uv = 0.5 * (np.column_stack([px, py]) / SKIN_HALF_MM + 1.0)
    return build_mesh(np.column_stack([px, py, z.ravel()]), faces, uv)


def _pixel_means(patch: SkinPatch, values: Float64Array, width_px: int) -> Float64Array:
    """Return means over the image's pixels, row 0 at the top, shape (H, W, C)."""
    edge = np.searchsorted(patch.x_mm, [-0.5 * patch.field_mm, 0.5 * patch.field_mm])
    inner = values[edge[0] : edge[1], edge[0] : edge[1]]
    if len(inner) % width_px:
        raise ValueError(f"width_px: got {width_px}, expected a divisor of {len(inner)} voxels")
    return _block_mean(inner, width_px)[::-1]


def _block_mean(values: Float64Array, count: int) -> Float64Array:
    """Return the means of equal blocks, shape (count, count, ...)."""
    block = len(values) // count
    shape = (count, block, count, block, *values.shape[2:])
    inner = values[: count * block, : count * block].reshape(shape)
    return np.asarray(inner.mean(axis=(1, 3)), np.float64)
