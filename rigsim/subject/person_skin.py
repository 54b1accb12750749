"""The skin of one person, which every rig simulates: its layers by site, state and wavelength."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from math import exp
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from rigsim.arrays import Float32Array
from rigsim.package_data import package_table
from rigsim.subject import pigment
from rigsim.subject.face_regions import region_masks
from rigsim.subject.head import LANDMARKS_MM
from rigsim.subject.perfusion import draw_perfusion
from rigsim.subject.thickness import thickness_ratio
from rigsim.tissue.skin_layers import (
    PROPERTY_RANGES,
    TYPICAL_SKIN,
    TissueProperties,
    skin_layer_stack,
)
from rigsim.tissue.tissue_mc import LayerStack

MELANIN_RANGE: Final = (0.001, 0.45)
"""Range of the volume fraction of melanosomes around which a person's skin varies."""
SITE_RADIUS_MM: Final = 8.0
"""Radius of a site of the face."""
ABDOMEN_SITE: Final = "abdomen"
_FACE_SITES: Final[Mapping[str, tuple[str, float, float, float]]] = package_table("face")["sites"]
SITE_NAMES: Final = (*_FACE_SITES, ABDOMEN_SITE)
"""Names of the sites."""
_ABDOMEN_MELANIN_STEP: Final = -0.2
"""Logarithm of the abdomen's melanin over the face's; it is out of the sun."""
_ABDOMEN_BLOOD_RATIO: Final = 0.45
"""Blood of the abdomen over that of the face between its regions: that of arms, median over 1,600
people (Lu et al. 2025, doi:10.1038/s41597-025-04857-5)."""


_TISSUE_DEVIATIONS: Final[Mapping[str, tuple[float, bool]]] = {
    "oxygenation": (0.055, False),
    "scattering_per_mm": (0.084, True),
    "scattering_slope": (0.175, False),
    "baseline_amplitude": (0.139, True),
    "eumelanin_fraction": (0.07, False),
    "epidermis_mm": (0.0875, True),
}
"""Standard deviations over people, of the logarithm where True: a tenth of each published range.
Ranges are those of Jacques 2013, doi:10.1088/0031-9155/58/11/R37, and Donner et al. 2008; 0.05 to
0.12 mm for the thickness: mean 0.069, deviation 0.023 mm over people and sites (Tsugita et al.
2013, doi:10.1111/srt.12021). Ranges include differences of method. With an eighth, 2 of the 87
people of the population lie outside 5 to 95 % of measured skin."""


MAX_DEVIATIONS: Final = 2.0
"""Standard deviations within which people's properties lie."""
PUBLISHED_SPREAD: Final = 2.5
"""Spread at which these deviations are a quarter of each published range, as the range of plus and
minus two standard deviations. The estimators' intervals assume a thickness that varies 1.3 times as
much, up to 0.15 mm."""


class PersonSkinError(ValueError):
    """A person's skin with invalid properties, or an unknown site."""


@dataclass(frozen=True, slots=True)
class SiteSkin:
    """Skin at one site in one state."""

    c_m: float
    """Volume fraction of melanosomes in an epidermis of `TissueProperties.melanin_reference_mm`."""
    c_hd: float
    """Volume fraction of blood in the dermis."""
    tissue: TissueProperties
    """All other properties, of this site."""


@dataclass(frozen=True, slots=True)
class PersonSkin:
    """What the skin of a person is made of; equal fields are the same person in every rig."""

    melanin: float
    """Volume fraction of melanosomes around which the skin varies, 0.001 to 0.45."""
    blood: float = 1.0
    """Factor of all blood, 0.1 to 4."""
    seed: int = 0
    """Seed of all random draws, >= 0."""
    freckles: float | None = None
    """Amount of freckles, 0 to 1; None: drawn."""
    tissue: TissueProperties = TYPICAL_SKIN
    """All other properties."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("melanin", *MELANIN_RANGE),
            ("blood", 0.1, 4.0),
            ("seed", 0, 2**63),
        ):
            if not low <= (value := getattr(self, name)) <= high:
                wanted = ">= 0" if name == "seed" else f"{low:g} to {high:g}"
                raise PersonSkinError(f"{name}: got {value}, expected {wanted}")

    @classmethod
    def of_preset(cls, preset: str, *, seed: int = 0, blood: float = 1.0) -> PersonSkin:
        """Return typical skin of a preset of `rigsim.subject.pigment.MELANIN_PRESETS`.

        Raises
        ------
        PersonSkinError
            The preset is unknown, or a number is out of range.
        """
        if preset not in pigment.MELANIN_PRESETS:
            known = ", ".join(pigment.MELANIN_PRESETS)
            raise PersonSkinError(f"preset: got {preset!r}, expected one of {known}")
        return cls(pigment.MELANIN_PRESETS[preset], blood, seed)

    @property
    def base_blood(self) -> float:
        """Blood volume fraction between the regions of the face."""
        return self.blood * pigment.typical_blood(self.melanin)

    def at(self, site: str, state: str = "neutral") -> SiteSkin:
        """Return the skin at a site: the mean over a disc of `SITE_RADIUS_MM` on the face.

        Parameters
        ----------
        site
            One of `SITE_NAMES`.
        state
            One of `rigsim.subject.perfusion.STATE_NAMES`; the abdomen has only "neutral".

        Raises
        ------
        PersonSkinError
            The site is unknown.
        rigsim.subject.perfusion.StateError
            The state is unknown.

        Examples
        --------
        >>> skin = PersonSkin.of_preset("III", seed=1)
        >>> skin.at("cheek").c_hd > skin.at("forehead").c_hd > skin.at("abdomen").c_hd
        True
        """
        return _site_skin(self, site, state)


@lru_cache(maxsize=64)
def _site_skin(person: PersonSkin, site: str, state: str) -> SiteSkin:
    if site == ABDOMEN_SITE:
        rng = np.random.default_rng([person.seed, 0x6162])
        melanin, blood = np.exp(rng.normal(0.0, (0.05, 0.1)))
        return SiteSkin(
            person.melanin * exp(_ABDOMEN_MELANIN_STEP) * float(melanin),
            person.base_blood * _ABDOMEN_BLOOD_RATIO * float(blood),
            person.tissue.with_thickness_ratio(1.0),
        )
    steps = np.arange(-SITE_RADIUS_MM, SITE_RADIUS_MM + 0.5)
    x, y = np.meshgrid(steps, steps)
    inside = np.hypot(x, y) <= SITE_RADIUS_MM
    points = _site_points(site, x[inside], y[inside])
    melanin, blood = _maps_at(person, state, points)
    ratio = thickness_ratio(region_masks(points), person.tissue.site_contrast)
    return SiteSkin(
        float(np.exp(np.log(melanin).mean())),
        float(blood.mean()),
        person.tissue.with_thickness_ratio(float(np.exp(np.log(ratio).mean()))),
    )


def skin_maps(
    person: PersonSkin, site: str, state: str, x_mm: ArrayLike, y_mm: ArrayLike
) -> tuple[Float32Array, Float32Array]:
    """Return melanin and blood at points of the mean head around a site.

    Parameters
    ----------
    person
        The person.
    site
        One of `SITE_NAMES` on the face.
    state
        One of `rigsim.subject.perfusion.STATE_NAMES`.
    x_mm, y_mm
        Offsets from the site in front view, to the face's left and up, mm, shape (...).

    Returns
    -------
    melanin, blood : ndarray of float32
        Volume fractions of melanosomes and of blood, shape (...).

    Raises
    ------
    PersonSkinError
        The site is not on the face.

    Examples
    --------
    >>> skin = PersonSkin.of_preset("III")
    >>> melanin, blood = skin_maps(skin, "cheek", "neutral", [0.0, 4.0], 0.0)
    >>> melanin.shape, bool((blood > 0.0).all())
    ((2,), True)
    """
    return _maps_at(person, state, _site_points(site, x_mm, y_mm))


def _site_points(site: str, x_mm: ArrayLike, y_mm: ArrayLike) -> Float32Array:
    """Return points of the mean head at offsets from a site of the face."""
    if site not in _FACE_SITES:
        raise PersonSkinError(f"site: got {site!r}, expected one of {', '.join(SITE_NAMES)}")
    landmark, height_mm, slope_x, slope_y = _FACE_SITES[site]
    x, y = np.broadcast_arrays(np.asarray(x_mm, np.float64), np.asarray(y_mm, np.float64))
    offset = np.stack([x, y, height_mm + slope_x * x + slope_y * y], axis=-1)
    return np.asarray(offset + np.array(LANDMARKS_MM[landmark]), np.float32)


def _maps_at(
    person: PersonSkin, state: str, points: Float32Array
) -> tuple[Float32Array, Float32Array]:
    """Return melanin and blood at points of the mean head."""
    regions = region_masks(points)
    melanin = pigment.draw_melanin_map(
        points, regions, person.melanin, seed=person.seed, freckles=person.freckles
    )
    perfusion = draw_perfusion(points, regions, person.base_blood, seed=person.seed)
    return melanin, perfusion.blood(state)


def draw_tissue(
    seed: int, typical: TissueProperties = TYPICAL_SKIN, *, spread: float = 1.0
) -> TissueProperties:
    """Draw the properties of a person's skin except for melanin and blood.

    Parameters
    ----------
    seed
        Seed of the person, >= 0.
    typical
        Properties around which people vary. The thickness between sites of one face has the
        published contrast.
    spread
        Factor of the deviations; `PUBLISHED_SPREAD` fills the published ranges.

    Examples
    --------
    >>> draw_tissue(1) == draw_tissue(1), draw_tissue(1) == draw_tissue(2)
    (True, False)
    """
    rng = np.random.default_rng([seed, 0x7469])
    drawn = {}
    for name, (deviation, of_logarithm) in _TISSUE_DEVIATIONS.items():
        drawn_deviations = np.clip(rng.standard_normal(), -MAX_DEVIATIONS, MAX_DEVIATIONS)
        step = spread * deviation * float(drawn_deviations)
        value = getattr(typical, name)
        value = value * exp(step) if of_logarithm else value + step
        drawn[name] = float(np.clip(value, *PROPERTY_RANGES[name]))
    return replace(typical, **drawn, site_contrast=1.0)


def layers(person: PersonSkin, site: str, state: str, wavelength_nm: float) -> LayerStack:
    """Return the layers of a person's skin, as every rig simulates it.

    Parameters
    ----------
    person
        The person.
    site
        One of `SITE_NAMES`.
    state
        One of `rigsim.subject.perfusion.STATE_NAMES`.
    wavelength_nm
        Wavelength in nm, 380 to 780.

    Returns
    -------
    LayerStack
        See `rigsim.tissue.skin_layers.skin_layer_stack`.

    Raises
    ------
    PersonSkinError
        The site is unknown.

    Examples
    --------
    >>> stack = layers(PersonSkin.of_preset("III"), "cheek", "neutral", 540.0)
    >>> stack.layers[0].sigma_a_per_mm > stack.layers[-1].sigma_a_per_mm
    True
    """
    skin = person.at(site, state)
    return skin_layer_stack(wavelength_nm, skin.c_m, skin.c_hd, skin.tissue)
