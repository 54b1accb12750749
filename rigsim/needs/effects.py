"""Record the effects of light in a scene, each with its verdict and reason.

A scene builds only the effects that change an image. The criterion, for the plan's sensor and the
subject, is an effect's largest change of any pixel relative to that pixel's noise. Effects below
`NEGLIGIBLE_NOISE_RATIO` may be omitted; `skinrig bench --stage omissions` renders scenes with and
without them to check that.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias, get_args

import numpy as np

from capture.plan import Plan
from capture.plan.rows import step_lights
from rigsim.arrays import Float64Array, FloatArray
from rigsim.package_data import package_table
from rigsim.sensor import Sensor

Verdict: TypeAlias = Literal["built", "negligible", "absent", "asked", "unmodeled"]

NEGLIGIBLE_NOISE_RATIO: Final = 0.1
"""Largest change of a pixel over its noise that may be omitted."""

VERDICT_MEANINGS: Final[dict[str, str]] = {
    "built": "it changes pixels and is in the image",
    "negligible": f"its change of any pixel is below {NEGLIGIBLE_NOISE_RATIO:g} of its noise",
    "absent": "the simulated world has none: by rig, plan or subject",
    "asked": "it would change pixels, but its omission was requested",
    "unmodeled": "a real rig has it and it may change pixels: the simulator does not model it",
}
"""Meaning of each verdict."""

SWITCH_FIELDS: Final[dict[str, str]] = {"subsurface": "lateral", "shadows": "relief_shadows"}
"""Fields of `SceneEffects` for switches whose rigs use another name."""


class NeedsError(ValueError):
    """A record that contradicts itself."""


@dataclass(frozen=True, slots=True)
class PixelNoise:
    """Noise variance of one pixel in one exposure, in units of full scale."""

    scale: float
    """Variance per signal, > 0: shot noise."""
    offset: float
    """Variance without signal, >= 0: dark, read and rounding noise."""

    def __post_init__(self) -> None:
        """Check signs."""
        if not (0.0 < self.scale < math.inf and 0.0 <= self.offset < math.inf):
            raise NeedsError(
                f"noise: got scale {self.scale}, offset {self.offset}, expected > 0 and >= 0"
            )

    @classmethod
    def of(cls, sensor: Sensor, exposure_s: float = 0.0) -> PixelNoise:
        """Return the noise of a sensor's pixels.

        Parameters
        ----------
        sensor
            The sensor.
        exposure_s
            Exposure time, s; the shortest of a plan is the least noisy.
        """
        return cls(*sensor.noise_profile(exposure_s))

    def sigma(self, level: FloatArray | float) -> Float64Array:
        """Return the standard deviation at signals of any shape; below 0 as at 0.

        Examples
        --------
        >>> float(PixelNoise(1e-4, 9e-8).sigma(1.0).round(5))
        0.01
        """
        return np.sqrt(self.scale * np.maximum(level, 0.0) + self.offset)

    def change_over_noise(self, change: float, level: float = 1.0) -> float:
        """Return a relative change of a signal over its noise.

        Parameters
        ----------
        change
            Change relative to the signal.
        level
            The signal, full scales. At 1, the brightest, a relative change is largest over noise.

        Examples
        --------
        >>> round(PixelNoise(1e-4, 0.0).change_over_noise(0.002), 3)
        0.2
        """
        return abs(change) * level / float(self.sigma(level))


@dataclass(frozen=True, slots=True)
class SceneEffects:
    """Requested effects of light: True, False, or None to decide by their sizes.

    A scene ignores the fields that do not apply to its rig.

    Examples
    --------
    >>> SceneEffects.from_switches({"subsurface": False, "optics": True}).lateral
    False
    """

    lateral: bool | None = None
    """Lateral scattering of light in the skin."""
    interreflections: bool | None = None
    """Interreflection between parts of the skin."""
    spectral: bool | None = None
    """Interreflection per wavelength instead of per channel."""
    optics: bool | None = None
    """Blur and diffraction of the lens."""
    relief_shadows: bool | None = None
    """Shadows of the relief on itself; on a face, those of the wrinkles after movement."""
    thickness: bool | None = None
    """The person's thickness of the epidermis, instead of a typical one."""
    melanin_depth: bool | None = None
    """The person's melanin by depth."""
    oxygenation: bool | None = None
    """The person's oxygenation of blood."""
    scattering: bool | None = None
    """The person's scattering of skin."""
    absorption: bool | None = None
    """The person's baseline absorption, kind of melanin and blood in the epidermis."""
    crosstalk: bool | None = None
    """Light of a fiber of the probe that leaves through others."""
    wings: bool | None = None
    """Wide wings of the lens's blur around the spots of the probe."""
    dark_current: bool | None = None
    """Dark current and hot pixels of the probe's camera."""
    spectral_step: int | None = None
    """Interreflection uses every n-th of the table's wavelengths; None: by the selection's rule."""
    last_bounce: float | None = None
    """Fraction of the first bounce at which the sum ends; None: by the selection's rule."""

    @classmethod
    def from_switches(cls, switches: Mapping[str, Any]) -> SceneEffects:
        """Return the effects requested by switches, see `Effect.switch`."""
        return cls(**{SWITCH_FIELDS.get(name, name): asked for name, asked in switches.items()})


AUTOMATIC_EFFECTS: Final = SceneEffects()
"""All effects that are large enough to change pixels, and no others."""


@dataclass(frozen=True, slots=True)
class Effect:
    """One effect of light on an image."""

    name: str
    """Name, in words."""
    verdict: Verdict
    """Decision, see `VERDICT_MEANINGS`."""
    reason: str
    """Reason, in words."""
    over_noise: float | None = None
    """Largest change of a pixel over its noise by the scene's rule; None: the rule needs none."""
    switch: str = ""
    """Argument of `SceneEffects.from_switches` that switches the effect; empty: none."""
    choice: float | None = None
    """Value of a numeric switch by the scene's rule, such as a step through wavelengths; None: the
    switch is none of them."""

    def __post_init__(self) -> None:
        """Refuse a verdict that contradicts the size."""
        if self.verdict not in get_args(Verdict):
            expected = ", ".join(get_args(Verdict))
            raise NeedsError(
                f"{self.name}: verdict: got {self.verdict!r}, expected one of {expected}"
            )
        if not (self.name and self.reason):
            raise NeedsError(f"effect {self.name!r}: got no name or no reason, expected both")
        small = self.over_noise is not None and self.over_noise < NEGLIGIBLE_NOISE_RATIO
        if self.verdict == "negligible" and self.over_noise is not None and not small:
            raise NeedsError(
                f"{self.name}: negligible: got a change of {self.over_noise:.3g} of the noise, "
                f"expected below {NEGLIGIBLE_NOISE_RATIO:g}; build it"
            )

    @property
    def is_built(self) -> bool:
        """Whether it is in the image."""
        return self.verdict == "built"

    def document(self) -> dict[str, str | float | None]:
        """Return the effect as JSON values.

        Examples
        --------
        >>> Effect("ambient light", "absent", "the room is dark").document()["verdict"]
        'absent'
        """
        return {
            "name": self.name,
            "verdict": self.verdict,
            "reason": self.reason,
            "over_noise": None if self.over_noise is None else float(f"{self.over_noise:.4g}"),
            "switch": self.switch,
        }


@dataclass(frozen=True, slots=True)
class EffectSelection:
    """All effects that a scene considers.

    Examples
    --------
    >>> needs = EffectSelection((
    ...     Effect("polarization", "built", "polarizers before lights and camera"),
    ...     Effect("ambient light", "absent", "the room is dark"),
    ... ))
    >>> needs.builds("polarization"), needs.omitted
    (True, [('ambient light', 'the room is dark')])
    """

    effects: tuple[Effect, ...]

    def __post_init__(self) -> None:
        """Refuse duplicate effects."""
        names = [effect.name for effect in self.effects]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise NeedsError(f"effects: got {', '.join(twice)} twice, expected each once")

    def __iter__(self) -> Iterator[Effect]:
        """Iterate over the effects."""
        return iter(self.effects)

    def __getitem__(self, name: str) -> Effect:
        """Return an effect by its name."""
        for effect in self.effects:
            if effect.name == name:
                return effect
        raise KeyError(name)

    def builds(self, name: str) -> bool:
        """Return whether an effect is built."""
        return self[name].is_built

    @property
    def omitted(self) -> list[tuple[str, str]]:
        """Return the effects that are not built, with the reasons."""
        return [(effect.name, effect.reason) for effect in self.effects if not effect.is_built]

    def document(self) -> list[dict[str, str | float | None]]:
        """Return the effects as JSON values."""
        return [effect.document() for effect in self.effects]


def merge_selections(selections: Sequence[EffectSelection]) -> EffectSelection:
    """Merge the selections of several cameras: a scene builds what any of them requires.

    Parameters
    ----------
    selections
        One per camera, at least one.

    Examples
    --------
    >>> coarse, fine = (
    ...     EffectSelection((decide_effect("blur", size, None, switch="optics", reason="a lens"),))
    ...     for size in (0.01, 5.0)
    ... )
    >>> merge_selections([coarse, fine])["blur"].over_noise
    5.0
    """
    found: dict[str, Effect] = {}
    for effect in (effect for needs in selections for effect in needs):
        other = found.get(effect.name)
        if other is None or _priority(effect) > _priority(other):
            found[effect.name] = effect
    return EffectSelection(tuple(found.values()))


def _priority(effect: Effect) -> tuple[bool, float]:
    return effect.is_built, effect.over_noise or 0.0


def decide_effect(
    name: str,
    over_noise: float,
    requested: bool | None,
    *,
    switch: str,
    reason: str,
    choice: float | None = None,
) -> Effect:
    """Decide whether a scene builds an effect: as requested, or by its size.

    Parameters
    ----------
    name
        Name of the effect.
    over_noise
        Largest change of a pixel over its noise by the scene's rule, >= 0.
    requested
        True builds it, False omits it, None decides by its size.
    switch
        See `Effect.switch`.
    reason
        Source of the size.
    choice
        See `Effect.choice`.

    Examples
    --------
    >>> decide_effect("bounces", 3.0, None, switch="bounces", reason="hollows").verdict
    'built'
    >>> decide_effect("bounces", 0.0, None, switch="bounces", reason="all is flat").verdict
    'negligible'
    >>> decide_effect("bounces", 3.0, False, switch="bounces", reason="hollows").reason
    'bounces=False requests it; hollows: up to 3 times the noise'
    """
    if not over_noise >= 0.0:
        raise NeedsError(f"{name}: over_noise: got {over_noise}, expected >= 0")
    size = f"{reason}: up to {over_noise:.3g} times the noise"
    if requested is None:
        verdict: Verdict = "built" if over_noise >= NEGLIGIBLE_NOISE_RATIO else "negligible"
        return Effect(name, verdict, size, over_noise, switch, choice)
    if requested:
        text = (
            size if over_noise >= NEGLIGIBLE_NOISE_RATIO else f"{switch}=True requests it; {size}"
        )
        return Effect(name, "built", text, over_noise, switch, choice)
    if over_noise < NEGLIGIBLE_NOISE_RATIO:
        return Effect(name, "negligible", size, over_noise, switch, choice)
    return Effect(name, "asked", f"{switch}=False requests it; {size}", over_noise, switch, choice)


def max_on_time_s(plan: Plan) -> float | None:
    """Return the longest on-time of lights in one exposure of a plan, s; None: they are never on.

    Parameters
    ----------
    plan
        Plan of LEDs. An on-time is weighted by its level, 0 to 1, and by the number of LEDs that a
        step names, which together emit more light than one.

    Examples
    --------
    >>> from capture.plan.gradient import gradient_plan
    >>> from capture.rig import load_rig
    >>> max_on_time_s(gradient_plan(load_rig("gradient")))
    0.018
    """
    lit = [
        max(len(step_lights(step)), 1)
        * float(step.settings["level"])
        * float(step.settings["exposure_s"])
        for step in plan.steps
        if "level" in step.settings and "exposure_s" in step.settings
    ]
    return max(lit, default=0.0) or None


def omitted_effects(*images: str) -> list[Effect]:
    """Return the effects that images always omit, from the tables of ``left_out.toml``."""
    tables = package_table("left_out")
    verdicts: tuple[Verdict, ...] = ("absent", "unmodeled")
    return [
        Effect(name, verdict, reason)
        for image in images
        for verdict in verdicts
        for name, reason in tables[image].get(verdict, {}).items()
    ]
