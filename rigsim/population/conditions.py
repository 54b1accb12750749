"""Apply cold, heat, sweat, lotion, makeup and powder to a face.

A condition changes the causes of the appearance, never images: the radius of the vessels, the oil,
the facets, and the layers on the skin (`rigsim.light.surface_brdf.Coating`). Amounts range from 0,
which changes nothing, to 1.

======== ========================================================================================
normal   no change
cold     vessels narrow by 25 %, most in the cheeks and nose; half of the oil; facets 6 % rougher
hot      vessels widen by 28 %, most in the cheeks; oil 1.6 times; a thin film of sweat on forehead,
         nose and upper lip
sweat    water (index 1.333) on 70 % of forehead and nose and on patches of the rest, very smooth
lotion   an oily emulsion (index 1.45) on 75 %, smooth; facets 15 % smoother; vellus hair flattened
makeup   pigment that covers and equalizes 70 % of the diffuse color, a satin film on 45 %, half
         of the oil
powder   grains on 45 %, which scatter back; a matte white part below them; a fifth of the oil
======== ========================================================================================

Single scattering by grains goes in all directions, and eq. (6) attributes its minimum to diffuse
light: under powder the minimum is about 13 % above R_d
(`rigsim.light.surface_brdf.min_surface_reflection`, the ground truth's map ``r_d_floor``).

All these amounts are chosen; their direction and order of magnitude are known:

- The flow of sebum falls by 10 % per degree of skin temperature (Cunliffe, Burton and Shuster
  1970, British Journal of Dermatology 83, 650-654).
- Vessels of the face narrow in cold and widen in heat; a vessel's blood is proportional to the
  square of its radius (`rigsim.subject.perfusion`).
- Water: index 1.333 (Hale and Querry 1973, doi:10.1364/AO.12.000555). Oils and emulsifiers of
  lotions: 1.44 to 1.48; binders and esters of foundations: about 1.5 (handbook values).
- Powder suppresses specular reflection and backscatters: Hapke 1981, doi:10.1029/JB086iB04p03039.
- Dataset A of Weyrich et al. 2006, doi:10.1145/1141911.1141987, section 10, has these seven.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from rigsim.arrays import Float32Array
from rigsim.geometry.surface_noise import smooth_noise
from rigsim.light.surface_brdf import Coating, SkinSurface, skin_surface
from rigsim.shading import interior_scale
from rigsim.subject import SimulatedSubject, face_regions
from rigsim.tissue.skin_layers import ETA

CONDITION_NAMES: Final = ("normal", "cold", "hot", "sweat", "lotion", "makeup", "powder")
"""The seven conditions of dataset A."""

POWDER_COLOR: Final = np.array([0.55, 0.54, 0.52], np.float32)
"""Multiple scattering of the grains, in the unit of R_d; with `POWDER_ALBEDO` below 1."""

MAX_OIL: Final = 0.95
ROUGHNESS_RANGE: Final = (0.1, 0.6)


class ConditionError(ValueError):
    """Unknown name or amount of a condition."""


@dataclass(frozen=True, slots=True)
class _Film:
    share: float
    alpha: float
    eta: float
    shiny: float
    """Excess of the film where oil and sweat are most, 0 (uniform) to 1."""
    broken: float
    """Fragmentation into drops and patches, 0 (closed) to 1."""
    cell_mm: float
    """Size of its patches, mm."""


@dataclass(frozen=True, slots=True)
class _Change:
    vessels: float = 0.0
    oil: float = 1.0
    roughness: float = 1.0
    fuzz: float = 1.0
    film: _Film | None = None
    cover: float = 0.0
    powder: float = 0.0


_CONDITION_CHANGES: Final[Mapping[str, _Change]] = {
    "normal": _Change(),
    "cold": _Change(vessels=-0.25, oil=0.5, roughness=1.06),
    "hot": _Change(vessels=0.28, oil=1.6, film=_Film(0.3, 0.12, 1.333, 1.0, 0.7, 3.0)),
    "sweat": _Change(vessels=0.06, film=_Film(0.7, 0.09, 1.333, 0.6, 0.8, 3.5)),
    "lotion": _Change(roughness=0.85, fuzz=0.4, film=_Film(0.75, 0.17, 1.45, 0.0, 0.15, 12.0)),
    "makeup": _Change(oil=0.5, fuzz=0.7, cover=0.7, film=_Film(0.45, 0.3, 1.5, 0.0, 0.1, 9.0)),
    "powder": _Change(oil=0.2, roughness=1.08, fuzz=0.8, powder=0.45),
}


def validate_conditions(conditions: Mapping[str, float]) -> dict[str, float]:
    """Validate conditions and sort them in the order of their application.

    Parameters
    ----------
    conditions
        Name to amount, 0 to 1.

    Raises
    ------
    ConditionError
        A name or an amount is unknown.

    Examples
    --------
    >>> validate_conditions({"powder": 1, "lotion": 0.6})
    {'lotion': 0.6, 'powder': 1.0}
    """
    for name, amount in conditions.items():
        if name not in CONDITION_NAMES:
            raise ConditionError(
                f"condition: got {name!r}, expected one of {', '.join(CONDITION_NAMES)}"
            )
        if not 0.0 <= amount <= 1.0:
            raise ConditionError(f"amount of {name}: got {amount}, expected 0 to 1")
    return {name: float(conditions[name]) for name in CONDITION_NAMES if name in conditions}


def condition_subject(
    subject: SimulatedSubject, conditions: Mapping[str, float]
) -> SimulatedSubject:
    """Return a face whose vessels respond to conditions; its surface is unchanged.

    Parameters
    ----------
    subject
        The face.
    conditions
        Name to amount, 0 to 1.

    Returns
    -------
    SimulatedSubject
        The same object where nothing changes.
    """
    change = sum(
        a * _CONDITION_CHANGES[name].vessels for name, a in validate_conditions(conditions).items()
    )
    if change == 0.0:
        return subject
    regions = subject.perfusion.regions
    answer = 0.7 + 0.3 * np.maximum(regions["cheeks"], regions["nose"])
    perfusion = subject.perfusion.dilate(change * answer)
    rest = subject.rest
    if rest is not None:
        rest = dataclasses.replace(rest, perfusion=perfusion)
    return dataclasses.replace(subject, perfusion=perfusion, rest=rest)


def apply_condition(
    surface: SkinSurface,
    condition: str,
    amount: float = 1.0,
    *,
    points_mm: Float32Array | None = None,
    foundation: ArrayLike | None = None,
    seed: int = 0,
) -> SkinSurface:
    """Return a surface under a condition; for its blood see `condition_subject`.

    Parameters
    ----------
    surface
        The surface before; its coating stays below, as a mean film.
    condition
        One of `CONDITION_NAMES`.
    amount
        0 to 1; 0 returns the surface itself.
    points_mm
        The texels on the mean head, shape (N, N, 3): films accumulate and break up into patches,
        lips keep their color. ``None`` applies everything uniformly.
    foundation
        R_d of the makeup, shape (3,); ``None`` takes the median of the face.
    seed
        Seed of the patches.

    Returns
    -------
    SkinSurface

    Raises
    ------
    ConditionError
        The condition or its amount is unknown.
    """
    (amount,) = validate_conditions({condition: amount}).values()
    change = _CONDITION_CHANGES[condition]
    if amount == 0.0 or change == _Change():
        return surface

    def part(factor: float) -> np.float32:
        return np.float32(1.0 + amount * (factor - 1.0))

    regions = None if points_mm is None else face_regions.region_masks(points_mm)
    found = dataclasses.replace(
        surface,
        roughness=np.clip(surface.roughness * part(change.roughness), *ROUGHNESS_RANGE),
        oil=np.clip(surface.oil * part(change.oil), 0.0, MAX_OIL),
        fuzz=surface.fuzz * part(change.fuzz),
    )
    if change.cover > 0.0:
        found = _apply_foundation(found, amount * change.cover, regions, foundation)
    on = surface.coating
    zero = np.zeros_like(surface.oil)
    if on is None:
        on = Coating(zero, zero + np.float32(0.2), zero + np.float32(ETA), zero)
    if change.film is not None:
        share = amount * _film_coverage(change.film, surface, points_mm, regions, seed)
        on = _add_film(on, change.film, np.asarray(share, np.float32))
    if change.powder > 0.0:
        grainy = np.float32(amount * change.powder) * surface.bare
        found = _mix_color(found, grainy, POWDER_COLOR)
        on = dataclasses.replace(on, powder=np.asarray(1.0 - (1.0 - on.powder) * (1.0 - grainy)))
    return dataclasses.replace(found, coating=on)


def conditioned_surface(
    subject: SimulatedSubject, camera: str, light: str, conditions: Mapping[str, float]
) -> SkinSurface:
    """Return the reflection of a face under conditions: vessels, surface and coating.

    Parameters
    ----------
    subject
        The face without conditions.
    camera, light
        Names in `model.spectra`.
    conditions
        Name to amount, 0 to 1.
    """
    changed = condition_subject(subject, conditions)
    return apply_conditions(changed, skin_surface(changed, camera, light), conditions)


def apply_conditions(
    subject: SimulatedSubject, surface: SkinSurface, conditions: Mapping[str, float]
) -> SkinSurface:
    """Return the surface of a face under conditions, in order, on its own points and seed."""
    wanted = {
        name: a
        for name, a in validate_conditions(conditions).items()
        if a > 0.0 and name != "normal"
    }
    if not wanted:
        return surface
    points = subject.perfusion.points_mm
    for name, amount in wanted.items():
        surface = apply_condition(
            surface, name, amount, points_mm=points, seed=subject.seed + CONDITION_NAMES.index(name)
        )
    return surface


def _apply_foundation(
    surface: SkinSurface,
    cover: float,
    regions: Mapping[str, Float32Array] | None,
    foundation: ArrayLike | None,
) -> SkinSurface:
    """Cover the diffuse color by a pigment, except on hair and, where known, on lips."""
    if foundation is None:
        skin = (surface.bare > 0.98) & (np.linalg.norm(surface.normal, axis=-1) > 0.5)
        if not skin.any():
            skin = np.ones_like(skin)
        color = np.median(surface.r_d[skin], axis=0).astype(np.float32)
    else:
        color = np.asarray(foundation, np.float32)
        if color.shape != (3,) or not (np.all(color >= 0.0) and np.all(color <= 1.0)):
            raise ConditionError(f"foundation: got {color.tolist()}, expected 3 values, 0 to 1")
    share = np.float32(cover) * surface.bare
    if regions is not None:
        share = share * (1.0 - regions["lips"])
    return _mix_color(surface, share, color)


def _mix_color(surface: SkinSurface, fraction: Float32Array, color: Float32Array) -> SkinSurface:
    """Return a surface with a fraction of another diffuse color."""
    part, scale = fraction[..., None], np.float32(interior_scale(ETA))
    reflectance = (1.0 - part) * surface.reflectance + part * color / scale
    return dataclasses.replace(
        surface,
        r_d=np.asarray((1.0 - part) * surface.r_d + part * color, np.float32),
        reflectance=np.asarray(reflectance, np.float32),
    )


def _film_coverage(
    film: _Film,
    surface: SkinSurface,
    points_mm: Float32Array | None,
    regions: Mapping[str, Float32Array] | None,
    seed: int,
) -> Float32Array:
    """Return the fraction covered by a film, shape (N, N), 0 to 1."""
    share = np.full(surface.oil.shape, film.share, np.float32)
    if points_mm is None or regions is None:
        return share
    wet = np.maximum(np.maximum(regions["forehead"], regions["nose"]), 0.7 * regions["chin"])
    share *= 1.0 - np.float32(film.shiny) * (1.0 - wet)
    patches = smooth_noise(points_mm, (film.cell_mm, 0.4 * film.cell_mm), seed=seed + 401)
    whole = 1.0 / (1.0 + np.exp(-4.0 * (patches + 0.3)))
    share *= 1.0 - np.float32(film.broken) * (1.0 - whole)
    return np.asarray(np.clip(share, 0.0, 1.0), np.float32)


def _add_film(below: Coating, film: _Film, fraction: Float32Array) -> Coating:
    """Add a film to a coating; alpha and index of overlapping films are weighted means."""
    total = below.film + fraction
    weight = np.where(total > 0.0, fraction / np.maximum(total, np.float32(1e-6)), 1.0)
    return Coating(
        film=np.asarray(1.0 - (1.0 - below.film) * (1.0 - fraction), np.float32),
        film_alpha=np.asarray((1.0 - weight) * below.film_alpha + weight * film.alpha, np.float32),
        film_eta=np.asarray((1.0 - weight) * below.film_eta + weight * film.eta, np.float32),
        powder=below.powder,
    )
