"""Generate a patch of facial skin at ten micrometers: grooves, pores, plateaus, cells, pigment.

Everything is a function of the position and the seed, so a larger patch of the same seed contains
the smaller one at its center. Vellus hair is omitted.

Sources. Primary grooves are 20 to 100 um deep, secondary ones 5 to 40 um (Pierard, Uhoda,
Pierard-Franchimont 2003, doi:10.1111/j.1473-2130.2003.00012.x). The horny layer is 16.8 um thick on
the cheek (Egawa, Hirao, Takahashi 2007, doi:10.2340/00015555-0183), thinner when counted in layers.
Indented upright, horny layer and epidermis have 1 to 2 MPa alike (Geerligs et al. 2011,
doi:10.1016/j.jbiomech.2011.01.015), so a layer is only a few times stiffer than what bears it as
long as it is moist; dry ones are an order stiffer (Yuan and Verma 2006,
doi:10.1016/j.colsurfb.2005.12.013). Relief governs how skin folds at such moderate ratios
(Leyva-Mendivil et al. 2018, doi:10.1039/c7sm01969f). The differences of the three sites, and all
numbers without a citation, are this project's choice, within those ranges.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np
from scipy.ndimage import map_coordinates

from rigsim.arrays import Float32Array, Float64Array
from rigsim.geometry.polygon_net import polygon_edge_distance
from rigsim.geometry.surface_noise import random_spots, smooth_noise, vessel_network
from rigsim.package_data import package_table
from rigsim.subject.person_skin import PersonSkin, PersonSkinError, SiteSkin
from rigsim.subject.pigment import MAX_MELANIN
from rigsim.tissue.lateral_kernels import SIGMAS_MM
from rigsim.tissue.skin_layers import MAX_C_HD, TissueProperties
from rigsim.tissue.skin_table import SkinTable

SiteName = Literal["forehead", "cheek", "chin"]
PIGMENT_LOG_MEAN: Final = -0.050
"""Mean of the logarithm of the patches' melanin over that of the site, from 18 patches of 4 mm."""
PIGMENT_LOG_VARIANCE: Final = 0.099
"""Variance of that logarithm."""
SITE_NAMES: Final = get_args(SiteName)
"""Names of the sites."""

TEXEL_RANGE_UM: Final = (2.0, 40.0)
SIZE_RANGE_MM: Final = (0.1, 40.0)
MAX_TEXELS: Final = 4096
CAMERA_BAND_NM: Final = (450.0, 650.0)
"""Band of a monochrome camera under white LEDs, equally weighted; this project's choice."""


class MicroSkinError(ValueError):
    """Error for a patch that cannot be made, or with inconsistent values."""


@dataclass(frozen=True, slots=True)
class _Site:
    spacing_mm: float
    depth_um: float
    width_mm: float
    elongation: float
    direction_deg: float
    jitter: float
    second_um: float
    fine_um: float
    dome_um: float
    cells_um: float
    pores: float
    pore_um: float
    layer_um: float
    thin: float
    stiffness_ratio: float
    poisson: float
    alpha: float


_SITE_PARAMETERS: Final = {
    name: _Site(**numbers) for name, numbers in package_table("skin_sites").items()
}


@dataclass(frozen=True, slots=True, eq=False)
class MicroSkin:
    """A patch in its neutral state; maps are (N, N), row 0 is +y, N even, center at the origin."""

    site: str
    """One of `SITE_NAMES`."""
    seed: int
    skin: SiteSkin
    """Mean melanin and blood of the patch, and its other properties."""
    texel_um: float
    """Distance of texels, um."""
    height_um: Float32Array
    """Height of the neutral surface, um, mean 0 over large areas, pits are negative."""
    albedo: Float32Array
    """Diffuse reflectance in `CAMERA_BAND_NM`, 0 to 1."""
    alpha: Float32Array
    """GGX roughness of facets below 10 um, 0.1 to 0.5."""
    layer_um: Float32Array
    """Thickness of the stiff layer, um, > 0; thinner in grooves."""
    stiffness_ratio: float
    """Modulus of the layer over that of the tissue that bears it, > 0."""
    poisson: float
    """Poisson's number of the tissue that bears it, 0 to 0.5. Below 0.5 fluid leaves or enters it
    while it is held, so that it thickens less than a fixed volume would."""

    def __post_init__(self) -> None:
        shape = self.height_um.shape
        if len(shape) != 2 or shape[0] != shape[1] or shape[0] % 2 or shape[0] < 8:
            raise MicroSkinError(f"height_um: got shape {shape}, expected (N, N), N even, >= 8")
        for name in ("height_um", "albedo", "alpha", "layer_um"):
            values = getattr(self, name)
            if values.shape != shape or not np.isfinite(values).all():
                raise MicroSkinError(f"{name}: expected finite values of shape {shape}")
        if not TEXEL_RANGE_UM[0] <= self.texel_um <= TEXEL_RANGE_UM[1]:
            raise MicroSkinError(f"texel_um: got {self.texel_um}, expected {TEXEL_RANGE_UM}")
        if self.layer_um.min() <= 0.0:
            raise MicroSkinError(f"layer_um: got {self.layer_um.min()}, expected > 0")
        if not 1e-3 <= self.stiffness_ratio <= 1e4:
            raise MicroSkinError(
                f"stiffness_ratio: got {self.stiffness_ratio}, expected 0.001 to 10000"
            )
        if not 0.0 <= self.poisson <= 0.5:
            raise MicroSkinError(f"poisson: got {self.poisson}, expected 0 to 0.5")

    @property
    def size_mm(self) -> float:
        """Return the side of the patch, mm."""
        return self.height_um.shape[0] * self.texel_um * 1e-3


def make_micro_skin(
    site: SiteName | str,
    *,
    seed: int = 0,
    size_mm: float,
    texel_um: float = 10.0,
    preset: str = "III",
    person: PersonSkin | None = None,
) -> MicroSkin:
    """Draw a patch of skin.

    Parameters
    ----------
    site
        "forehead", "cheek" or "chin".
    seed
        Seed of every pattern, >= 0.
    size_mm
        Side of the patch, 0.1 to 40 mm, rounded up to an even number of texels. See
        `rigsim.skin_patch.stretch.required_size_mm` for the size that a field of view needs.
    texel_um
        Distance of texels, 2 to 40 um; detail finer than two texels is omitted.
    preset
        One of `rigsim.subject.pigment.MELANIN_PRESETS`.
    person
        Skin of the person; None: the preset's, with the same seed.

    Returns
    -------
    MicroSkin

    Raises
    ------
    MicroSkinError
        When an argument is outside its range.

    Examples
    --------
    >>> skin = make_micro_skin("cheek", seed=3, size_mm=0.5)
    >>> skin.height_um.shape, bool(skin.height_um.min() < 0.0)
    ((50, 50), True)
    """
    if site not in _SITE_PARAMETERS:
        raise MicroSkinError(f"site: got {site!r}, expected one of {', '.join(SITE_NAMES)}")
    try:
        skin = (person or PersonSkin.of_preset(preset, seed=seed)).at(site)
    except PersonSkinError as error:
        raise MicroSkinError(str(error)) from error
    if not TEXEL_RANGE_UM[0] <= texel_um <= TEXEL_RANGE_UM[1]:
        raise MicroSkinError(f"texel_um: got {texel_um}, expected {TEXEL_RANGE_UM}")
    if not SIZE_RANGE_MM[0] <= size_mm <= SIZE_RANGE_MM[1]:
        raise MicroSkinError(f"size_mm: got {size_mm}, expected {SIZE_RANGE_MM}")
    count = max(8, 2 * math.ceil(size_mm * 500.0 / texel_um - 1e-9))
    if count > MAX_TEXELS:
        raise MicroSkinError(f"size_mm: got {count} texels per side, expected <= {MAX_TEXELS}")
    where = _SITE_PARAMETERS[site]
    points, own = _texel_positions_mm(count, texel_um), _patch_seed(site, seed)
    height, furrow = _relief(where, points, texel_um * 1e-3, own)
    return MicroSkin(
        site=site,
        seed=seed,
        skin=skin,
        texel_um=texel_um,
        height_um=height,
        albedo=_albedo(points, furrow, skin, own),
        alpha=_alpha(where, points, own),
        layer_um=np.asarray(where.layer_um * (1.0 - (1.0 - where.thin) * furrow), np.float32),
        stiffness_ratio=where.stiffness_ratio,
        poisson=where.poisson,
    )


def change_patch_tissue(patch: MicroSkin, tissue: TissueProperties) -> MicroSkin:
    """Return a patch of `make_micro_skin` with other tissue, the same patch for the same tissue.

    Parameters
    ----------
    patch
        The patch.
    tissue
        Properties of its skin except for melanin and blood.

    Examples
    --------
    >>> from dataclasses import replace
    >>> patch = make_micro_skin("cheek", seed=3, size_mm=0.5)
    >>> other = change_patch_tissue(patch, replace(patch.skin.tissue, scattering_per_mm=12.0))
    >>> bool((other.albedo > patch.albedo).all()), other.height_um is patch.height_um
    (True, True)
    """
    if tissue == patch.skin.tissue:
        return patch
    where, skin = _SITE_PARAMETERS[patch.site], dataclasses.replace(patch.skin, tissue=tissue)
    points = _texel_positions_mm(len(patch.layer_um), patch.texel_um)
    furrow = (1.0 - patch.layer_um / where.layer_um) / (1.0 - where.thin)  # of `make_micro_skin`
    albedo = _albedo(points, furrow, skin, _patch_seed(patch.site, patch.seed))
    return dataclasses.replace(patch, skin=skin, albedo=albedo)


def _texel_positions_mm(count: int, texel_um: float) -> Float32Array:
    """Return the positions of a patch's texels, shape (count, count, 3)."""
    places = (np.arange(count) - 0.5 * (count - 1)) * texel_um * 1e-3
    points = np.zeros((count, count, 3), np.float32)
    points[..., 0], points[..., 1] = places[None, :], places[::-1, None]
    return points


def _patch_seed(site: str, seed: int) -> int:
    return len(SITE_NAMES) * seed + SITE_NAMES.index(site)


def _relief(
    where: _Site, points: Float32Array, texel_mm: float, seed: int
) -> tuple[Float32Array, Float32Array]:
    """Return height in um and each texel's groove weight, 0 to 1."""
    salt = 1000 * seed
    angle = math.radians(where.direction_deg)
    cell = where.spacing_mm
    # Domain warping: smooth noise displaces positions before the nets are drawn, so lines are not
    # straight.
    x = points[..., 0] + 0.06 * cell * smooth_noise(points, (1.3 * cell, 0.45 * cell), seed=salt)
    y = points[..., 1] + 0.06 * cell * smooth_noise(
        points, (1.3 * cell, 0.45 * cell), seed=salt + 1
    )
    along = math.cos(angle) * x + math.sin(angle) * y
    across = -math.sin(angle) * x + math.cos(angle) * y

    def net(scale: float, turn: int) -> tuple[Float32Array, Float32Array]:
        distance, number = polygon_edge_distance(
            along / (where.elongation * scale * cell),
            across / (scale * cell),
            jitter=where.jitter,
            seed=salt + turn,
        )
        return np.asarray(distance * scale * cell, np.float32), number

    def furrow_of(distance: Float32Array, width_mm: float) -> Float32Array:
        # Groove profile: rounded at the bottom, with the flank of a fold.
        round_mm = 0.35 * width_mm
        return np.asarray(
            np.exp(-(np.sqrt(distance**2 + round_mm**2) - round_mm) / (0.5 * width_mm)), np.float32
        )

    first, _ = net(1.0, 2)
    second, level = net(0.47, 3)
    third, _ = net(0.24, 4)
    vary = 1.0 + 0.25 * smooth_noise(points, (1.7 * cell,), seed=salt + 5)
    vary_second = np.clip(0.9 + 0.5 * smooth_noise(points, (1.1 * cell,), seed=salt + 6), 0.0, None)
    deep = furrow_of(first, where.width_mm)
    shallow = furrow_of(second, 0.6 * where.width_mm)
    fine = furrow_of(third, 0.4 * where.width_mm)
    height = -where.depth_um * vary * deep
    height -= where.second_um * vary_second * shallow * (1.0 - 0.6 * deep)
    if 0.4 * where.width_mm > 1.5 * texel_mm:
        height -= where.fine_um * fine * (1.0 - 0.6 * deep)
    # Plateaus: each small polygon has its own level and bulges towards its center.
    height += where.dome_um * (level - 0.5) * (1.0 - shallow)
    height += 2.0 * where.dome_um * np.minimum(first / cell, 0.5)
    pores = random_spots(
        points,
        np.full(points.shape[:-1], where.pores, np.float32),
        cell_mm=1.0,
        radius_mm=(0.05, 0.13),
        seed=salt + 7,
        softness=3.0,
        min_radius_mm=0.8 * texel_mm,
    )
    height -= where.pore_um * pores
    # Corneocytes, 35 um across, some lifted; then grain down to the texel.
    if texel_mm <= 0.0175:
        edge, lifted = polygon_edge_distance(
            points[..., 0].astype(np.float64) / 0.035,
            points[..., 1].astype(np.float64) / 0.035,
            jitter=0.9,
            seed=salt + 8,
        )
        height += where.cells_um * (2.0 * lifted - 1.0) * np.minimum(edge / 0.25, 1.0)
    grain = tuple(size for size in (0.11, 0.055, 0.03) if size >= 2.0 * texel_mm)
    if grain:
        height += 1.4 * where.cells_um * smooth_noise(points, grain, seed=salt + 9)
    thin = np.maximum(np.maximum(deep, 0.5 * shallow), 0.6 * pores)
    # The expected mean, not the patch's, so that height does not depend on the patch's size.
    return np.asarray(height + 0.45 * where.depth_um, np.float32), np.asarray(
        np.clip(thin, 0.0, 1.0), np.float32
    )


def _albedo(points: Float32Array, furrow: Float32Array, skin: SiteSkin, seed: int) -> Float32Array:
    """Return diffuse reflectance: melanin in specks of 40 to 150 um, a few vessels and spots."""
    salt = 1000 * seed + 500
    speckle = 0.5 * smooth_noise(points, (0.15,), seed=salt)
    speckle += 0.4 * smooth_noise(points, (0.08,), seed=salt + 1)
    speckle += 0.3 * smooth_noise(points, (0.05,), seed=salt + 2)
    slow = smooth_noise(points, (1.5, 0.6), seed=salt + 3)
    spots = random_spots(
        points,
        np.full(points.shape[:-1], 0.35, np.float32),
        cell_mm=0.5,
        radius_mm=(0.03, 0.12),
        seed=salt + 4,
        softness=4.0,
    )
    pattern = 0.45 * speckle + 0.12 * slow + 0.5 * spots - 0.1 * furrow
    vessels = vessel_network(points, 1.6, 0.04, seed=salt + 5)
    patchy = np.clip(smooth_noise(points, (1.1,), seed=salt + 6), 0.0, 1.0)
    c_hd = skin.c_hd * np.exp(0.10 * slow + 0.8 * vessels * patchy)
    table = SkinTable.load(skin.tissue)
    band = (table.wavelength_nm >= CAMERA_BAND_NM[0]) & (table.wavelength_nm <= CAMERA_BAND_NM[1])
    # The shift keeps the mean reflectance that of the site: R falls with the power p of melanin.
    ends = table.spectra(skin.c_m * np.array([0.8, 1.25]), skin.c_hd)[:, band].mean(axis=-1)
    p = -math.log(ends[1] / ends[0]) / math.log(1.25 / 0.8)
    shift = 0.5 * p * PIGMENT_LOG_VARIANCE - PIGMENT_LOG_MEAN
    c_m = skin.c_m * np.exp(pattern + shift)
    nodes_m = np.geomspace(skin.c_m / 12.0, min(12.0 * skin.c_m, MAX_MELANIN), 48)
    nodes_h = np.geomspace(skin.c_hd / 3.0, min(5.0 * skin.c_hd, MAX_C_HD), 24)
    tabulated = table.spectra(nodes_m[:, None], nodes_h[None, :])[..., band].mean(axis=-1)
    at_m = np.log(np.clip(c_m, nodes_m[0], nodes_m[-1]) / nodes_m[0])
    at_h = np.log(np.clip(c_hd, nodes_h[0], nodes_h[-1]) / nodes_h[0])
    at_m *= (len(nodes_m) - 1) / math.log(nodes_m[-1] / nodes_m[0])
    at_h *= (len(nodes_h) - 1) / math.log(nodes_h[-1] / nodes_h[0])
    return np.asarray(map_coordinates(tabulated, [at_m, at_h], order=1, mode="nearest"), np.float32)


def _alpha(where: _Site, points: Float32Array, seed: int) -> Float32Array:
    """Return GGX roughness: films of oil lower it locally."""
    oil = smooth_noise(points, (2.5, 0.7), seed=1000 * seed + 900)
    return np.asarray(np.clip(where.alpha * (1.0 + 0.07 * oil), 0.1, 0.5), np.float32)


def lateral_kernel(skin: MicroSkin) -> tuple[Float64Array, Float64Array]:
    """Return widths in mm and weights of the Gaussians of the camera's band, shape (K,) each."""
    table = SkinTable.load(skin.skin.tissue)
    band = (table.wavelength_nm >= CAMERA_BAND_NM[0]) & (table.wavelength_nm <= CAMERA_BAND_NM[1])
    weights = (band / band.sum())[:, None]
    kernels = table.lateral_kernels(skin.skin.c_m, skin.skin.c_hd, weights)
    gaussians = kernels.gaussians(SIGMAS_MM)
    return gaussians.sigmas_mm, gaussians.weights[0]
