"""Select the properties of a person's tissue that change images; the others count as typical.

The rule of a property compares the person's skin with the same skin whose property is typical, by
the Monte Carlo tables and before anything is rendered.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from math import exp
from typing import Final

import numpy as np

from rigsim.arrays import Float64Array, FloatArray
from rigsim.caching import cached_method
from rigsim.fiber.probe_tissue import ProbedTissue, SkinTissue
from rigsim.needs.effects import Effect, EffectSelection, PixelNoise, SceneEffects, decide_effect
from rigsim.skin_patch.microrelief import MicroSkin, change_patch_tissue
from rigsim.subject import SimulatedSubject
from rigsim.subject.thickness import LOG_RATIO_RANGE
from rigsim.targets import Target
from rigsim.tissue.skin_layers import (
    DERMIS_SCATTERING_RATIO,
    TYPICAL_SKIN,
    TissueProperties,
    skin_coefficients,
)
from rigsim.tissue.skin_table import WAVELENGTH_NM, interpolate_spectra
from rigsim.tissue.skin_transport import SkinTransportError

RULE_WAVELENGTH_STEP: Final = 2
"""Rules use every n-th wavelength of the tables: every 20 nm, half of the bands of hemoglobin."""


@dataclass(frozen=True, slots=True)
class TissueRule:
    """Properties of tissue that are built together or count as typical."""

    name: str
    """Name of the effect."""
    switch: str
    """Its field of `SceneEffects`."""
    fields: tuple[str, ...]
    """Fields of `TissueProperties`."""


TISSUE_RULES: Final = (
    TissueRule("thickness of the epidermis", "thickness", ("epidermis_mm", "site_contrast")),
    TissueRule("depth of melanin", "melanin_depth", ("basal_melanin_fraction",)),
    TissueRule("oxygenation of blood", "oxygenation", ("oxygenation",)),
    TissueRule(
        "scattering of skin",
        "scattering",
        ("scattering_per_mm", "rayleigh_fraction", "scattering_slope"),
    ),
    TissueRule(
        "other absorption of skin",
        "absorption",
        ("epidermal_blood_ratio", "baseline_amplitude", "eumelanin_fraction"),
    ),
)
"""One rule per property. Each field of `TissueProperties` has one rule, except for the thickness to
which melanin refers: skin of another thickness has the same melanin per area."""


def select_tissue_effects(
    tissue: TissueProperties,
    change_over_noise: Callable[[TissueProperties], float],
    requested: SceneEffects | None,
) -> list[Effect]:
    """Return whether a scene requires each property of a person's tissue.

    Parameters
    ----------
    tissue
        Properties of the person's skin.
    change_over_noise
        Returns the largest change of a pixel over its noise between the person's skin and other
        skin.
    requested
        Requested effects; None for scenes without switches.

    Returns
    -------
    list of Effect
        One for each of `TISSUE_RULES`; "absent" where the person's property is typical.

    Examples
    --------
    >>> pale = TissueProperties(oxygenation=0.6)
    >>> made = select_tissue_effects(pale, lambda other: 2.0, SceneEffects())
    >>> [effect.name for effect in made if effect.is_built]
    ['oxygenation of blood']
    """
    made = []
    for rule in TISSUE_RULES:
        switch = rule.switch if requested is not None else ""
        other = _typical_in(tissue, rule.fields)
        if other == tissue:
            made.append(Effect(rule.name, "absent", "it is that of typical skin", 0.0, switch))
            continue
        try:
            change = change_over_noise(other)
        except SkinTransportError:  # the tables end between the person and typical skin
            change = np.inf
        reason = ", ".join(
            f"{name} {getattr(tissue, name):.3g} instead of {getattr(TYPICAL_SKIN, name):.3g}"
            for name in rule.fields
            if getattr(tissue, name) != getattr(TYPICAL_SKIN, name)
        )
        asked = getattr(requested, rule.switch, None)
        made.append(decide_effect(rule.name, change, asked, switch=switch, reason=reason))
    return made


def select_tissue(tissue: TissueProperties, needs: EffectSelection) -> TissueProperties:
    """Return the tissue of a scene: the person's where a property is built, else typical.

    Examples
    --------
    >>> person = TissueProperties(oxygenation=0.6, scattering_slope=1.42)
    >>> needs = EffectSelection(tuple(select_tissue_effects(
    ...     person, lambda other: 10.0 * abs(other.oxygenation - 0.6), SceneEffects())))
    >>> select_tissue(person, needs) == TissueProperties(oxygenation=0.6)
    True
    """
    for rule in TISSUE_RULES:
        if not needs.builds(rule.name):
            tissue = _typical_in(tissue, rule.fields)
    return tissue


def select_face_tissue(
    subject: SimulatedSubject | Target, needs: EffectSelection
) -> SimulatedSubject | Target:
    """Return a face with the tissue that its scene builds; targets have none."""
    if not isinstance(subject, SimulatedSubject):
        return subject
    tissue = select_tissue(subject.tissue, needs)
    if tissue == subject.tissue:
        return subject
    rest = None if subject.rest is None else dataclasses.replace(subject.rest, tissue=tissue)
    return dataclasses.replace(subject, tissue=tissue, rest=rest)


def select_patch_tissue(patch: MicroSkin | str, needs: EffectSelection) -> MicroSkin | str:
    """Return a patch with the tissue that its scene builds; targets have none."""
    if isinstance(patch, str):
        return patch
    return change_patch_tissue(patch, select_tissue(patch.skin.tissue, needs))


def select_probed_tissue(tissue: ProbedTissue, needs: EffectSelection) -> ProbedTissue:
    """Return tissue under the probe with the properties that its scene builds."""
    if not isinstance(tissue, SkinTissue):
        return tissue
    person = tissue.person
    return SkinTissue(dataclasses.replace(person, tissue=select_tissue(person.tissue, needs)))


def _typical_in(tissue: TissueProperties, fields: tuple[str, ...]) -> TissueProperties:
    typical = {name: getattr(TYPICAL_SKIN, name) for name in fields}
    return dataclasses.replace(tissue, **typical)


@dataclass(frozen=True, eq=False)
class SkinSample:
    """Skins that represent a subject: signals of its pixels, and its lateral scattering."""

    c_m: Float64Array
    """Volume fractions of melanosomes, shape (P,)."""
    c_hd: Float64Array
    """Volume fractions of blood, shape (P,)."""
    band_weights: Float64Array
    """Weights of every `RULE_WAVELENGTH_STEP`-th wavelength of the tables, (W, C)."""

    @classmethod
    def from_extremes(
        cls, c_m: FloatArray, c_hd: FloatArray, band_weights: Float64Array
    ) -> SkinSample:
        """Return all pairs of least, median and largest melanin and blood.

        Parameters
        ----------
        c_m, c_hd
            Volume fractions of a subject, any shapes.
        band_weights
            Weights at every `RULE_WAVELENGTH_STEP`-th wavelength.
        """
        each = (np.quantile(np.asarray(part, np.float64), (0.0, 0.5, 1.0)) for part in (c_m, c_hd))
        melanin, blood = (part.ravel() for part in np.meshgrid(*each))
        return cls(melanin, blood, band_weights)

    @cached_method
    def signals(self, tissue: TissueProperties) -> Float64Array:
        """Return the reflectance in the camera's channels, shape (P, C)."""
        wavelength = WAVELENGTH_NM[::RULE_WAVELENGTH_STEP]
        spectra = interpolate_spectra(self.c_m, self.c_hd, tissue, wavelength)
        return np.asarray(spectra @ self.band_weights)

    @cached_method
    def diffuse_path_mm(self, tissue: TissueProperties) -> Float64Array:
        """Return the mean free path of diffuse light in the dermis, 1 / sigma_tr, shape (P, C)."""
        wavelength = WAVELENGTH_NM[::RULE_WAVELENGTH_STEP]
        found = skin_coefficients(wavelength, self.c_m[:, None], self.c_hd[:, None], tissue)
        total = found.dermis + DERMIS_SCATTERING_RATIO * found.scattering
        return np.asarray((1.0 / np.sqrt(3.0 * found.dermis * total)) @ self.band_weights)

    def change_over_noise(
        self,
        tissue: TissueProperties,
        other: TissueProperties,
        *,
        level: FloatArray | float,
        lost: FloatArray | float,
        gain: FloatArray | float,
        noise: PixelNoise,
    ) -> float:
        """Return the largest change of a pixel over its noise between two tissues.

        Parameters
        ----------
        tissue, other
            The person's tissue, and another.
        level
            Signal of the brightest skin, full scales, shape (C,).
        lost
            Fraction of its light beyond the edge of a shadow, see
            `rigsim.needs.effect_sizes.edge_loss`, shape (C,); 0 without lateral scattering.
        gain
            Relative change of a pixel per relative change of reflectance, shape (C,): above 1 by
            interreflection.
        noise
            Noise of the sensor.

        Notes
        -----
        The loss beyond a shadow's edge grows with the mean free path of diffuse light in the
        dermis. Two tissues change a pixel by both, color and lateral scattering; the larger counts.
        Regions of another thickness than the rest are compared, too.
        """
        contrast = max(tissue.site_contrast, other.site_contrast)
        by_color = 0.0
        for step in (0.0, *LOG_RATIO_RANGE) if contrast > 0.0 else (0.0,):
            own, changed = (
                self.signals(one.with_thickness_ratio(exp(step * one.site_contrast)))
                for one in (tissue, other)
            )
            shown = np.minimum(level * own / own.max(axis=0), 1.0)
            change = gain * np.abs(changed / own - 1.0) * shown / noise.sigma(shown)
            by_color = max(by_color, float(change.max()))
        longer = self.diffuse_path_mm(other) / self.diffuse_path_mm(tissue) - 1.0
        scattered = np.minimum(np.asarray(lost, np.float64) * level, 1.0)
        by_path = np.abs(longer) * scattered / noise.sigma(scattered)
        return max(by_color, float(by_path.max()))
