"""Information of narrow-band LEDs on melanin, blood and oxygenation, before a session.

The errors are Cramér-Rao bounds of the linearized signals with all priors: sensor noise of the
frames, averaged as in the reconstruction; unknown properties of skin; what the model leaves
unexplained of measured spectra; and shading under its prior.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from capture.plan import Plan
from capture.rig import Rig
from model import spectra
from model.tissue_optics import SKIN_CONSTANTS
from model.tissue_optics.band_signals import NUISANCE_SD, BandSignals
from model.tissue_optics.skin_spectra import SKIN_PARAMETERS, typical_skin
from reconstruction.chromophores.shading_prior import face_prior
from reconstruction.narrow_bands.band_fit import MAX_STDERR_FRACTION, prior_moments
from reconstruction.pipeline.flash.oxygenation import SUPERPIXELS_PER_PX, WINDOW_MM
from rigsim.scenes.flash.scene import METERING_LEVEL
from rigsim.sensor import make_sensor
from skinrig.arrays import Float64Array
from skinrig.planning.camera_separability import TYPICAL_SKIN

SKIN_TYPES: Final[Mapping[str, str]] = {"light": "II", "medium": "IV", "dark": "VI"}
"""Skin types of the table."""
REPORTED_PROPERTIES: Final = ("melanin_optical_depth", "blood", "oxygenation", "epidermis_mm")
"""Reported properties. Distribution of melanin by depth acts on signals like the thickness."""


@dataclass(frozen=True, slots=True)
class LedInformation:
    """Bounds of one person's properties from the colors and some LEDs."""

    person: str
    """Key of `SKIN_TYPES`."""
    leds: tuple[str, ...]
    """LEDs that are used with the camera's colors."""
    stderr: Mapping[str, float]
    """Standard errors by `REPORTED_PROPERTIES`; of all but oxygenation relative ones."""
    determined: tuple[str, ...]
    """Properties on which the signals have at least the information of the prior."""

    def to_document(self) -> dict[str, Any]:
        """Return the bounds as JSON values."""
        return {
            "person": self.person,
            "leds": list(self.leds),
            "stderr": dict(self.stderr),
            "determined": list(self.determined),
        }


def assess_leds(rig: Rig, plan: Plan, leds: Sequence[str]) -> tuple[LedInformation, ...]:
    """Return the bounds without LEDs, with each alone, and with one after the other.

    Parameters
    ----------
    rig
        The flash rig.
    plan
        Plan with a frame per LED and crossed frames; its powers and numbers of frames set the
        noise.
    leds
        Names of the LEDs in the order in which they are added.

    Returns
    -------
    tuple of LedInformation
        For each person: the colors alone, with each LED alone, then with the first two, three, ...

    Examples
    --------
    >>> from capture.plan import flash_plan
    >>> from capture.rig import load_rig
    >>> rig, leds = load_rig("flash"), ("LED-450-20", "LED-580-20")
    >>> found = assess_leds(rig, flash_plan(rig, leds=leds), leds)
    >>> [len(one.leds) for one in found if one.person == "light"]
    [0, 1, 1, 2]
    """
    singles = [(led,) for led in leds]
    sets = [(), *singles, *(tuple(leds[: k + 1]) for k in range(1, len(leds)))]
    prior = face_prior()
    moments = prior_moments((prior.mean, prior.sd))[1]
    view = rig.views[0]
    whole = BandSignals(view.spectral_sensitivity, rig.lights[0].illuminant, tuple(leds))
    found = []
    for person, kind in SKIN_TYPES.items():
        c_m, blood = TYPICAL_SKIN[kind]
        skin = typical_skin(c_m * SKIN_CONSTANTS.melanin_depth_factor, blood)
        light = np.exp(whole.log_signals(skin) + prior.mean)
        noise = _noise_variance(rig, plan, leds, light) / light**2
        covariance = whole.residual_covariance(skin) + np.diag(noise)
        slopes = whole.jacobian(skin)
        slopes = np.column_stack([slopes, np.ones(len(slopes))])
        sd = np.concatenate([moments[:2], NUISANCE_SD, moments[3:]])
        for chosen in sets:
            rows = [0, 1, 2, *(3 + list(leds).index(led) for led in chosen)]
            weights = np.linalg.inv(covariance[np.ix_(rows, rows)])
            fisher = slopes[rows].T @ weights @ slopes[rows] + np.diag(sd**-2.0)
            stderr = np.sqrt(np.diag(np.linalg.inv(fisher)))
            at = {name: SKIN_PARAMETERS.index(name) for name in REPORTED_PROPERTIES}
            found.append(
                LedInformation(
                    person,
                    chosen,
                    {name: float(stderr[k]) for name, k in at.items()},
                    tuple(n for n, k in at.items() if stderr[k] <= MAX_STDERR_FRACTION * sd[k]),
                )
            )
    return tuple(found)


def _noise_variance(rig: Rig, plan: Plan, leds: Sequence[str], light: Float64Array) -> Float64Array:
    """Return the noise variance of each signal, averaged over the reconstruction's window."""
    view = rig.views[0]
    sensor = make_sensor(view)
    shots = [step for step in plan.steps if step.kind == "subject"]
    first = shots[0].index.get("state")
    shots = [step for step in shots if step.index.get("state") == first]
    side_px = WINDOW_MM / (view.field_mm[0] / view.width_px) * SUPERPIXELS_PER_PX
    # a superpixel averages one red, one blue and two green sites
    sites = np.array([1.0, 2.0, 1.0]) * max(side_px, 1.0) ** 2
    variances = []
    for name in (rig.lights[0].illuminant, *leds):
        own = [
            step
            for step in shots
            if step.index.get("light", "") == ("" if name not in leds else name)
            and step.settings["polarizer"] == "crossed"
        ]
        if not own:
            raise ValueError(f"plan: got no crossed frame under {name}, expected one; add it")
        power = float(np.mean([float(step.settings["power"]) for step in own]))
        gain, floor = sensor.noise_profile(float(own[0].settings["exposure_s"]))
        white = METERING_LEVEL * spectra.camera_white(view.spectral_sensitivity, name)
        levels = light[:3] if name not in leds else light[3 + list(leds).index(name)]
        noise = (gain * power * white * levels + floor) / sites / len(own) / power**2
        if name in leds:
            variances.append(np.array([noise.sum() / white.sum() ** 2]))
        else:
            variances.append(noise / white**2)
    return np.concatenate(variances)


def format_information(rows: Sequence[LedInformation]) -> list[str]:
    """Format bounds as lines of text, one table per person; none without bounds.

    Examples
    --------
    >>> errors = dict.fromkeys(REPORTED_PROPERTIES, 0.25)
    >>> format_information([LedInformation("light", (), errors, ("blood",))])[1].split()
    ['colors', 'alone', '25', '%', '25', '%', '*', '0.250', '25', '%']
    """
    heads = ("melanin", "blood", "oxygenation", "thickness")
    lines = []
    people = dict.fromkeys(row.person for row in rows)
    for person in people:
        label = f"absolute errors, {person} skin (type {SKIN_TYPES[person]})"
        lines.append(f"{label:<44}" + "".join(f"{head:>13}" for head in heads))
        for row in rows:
            if row.person != person:
                continue
            named = [":".join(led.split("-")[1:]) for led in row.leds]
            what = f"colors and LEDs {', '.join(named)}" if named else "colors alone"
            cells = []
            for name in REPORTED_PROPERTIES:
                value = row.stderr[name]
                text = f"{value:.3f}" if name == "oxygenation" else f"{100 * value:.0f} %"
                cells.append(f"{text}{' *' if name in row.determined else '  '}")
            lines.append(f"  {what:<42}" + "".join(f"{cell:>13}" for cell in cells))
    if lines:
        lines.append(
            "* the signals have at least the information of the prior over people; the thickness "
            "is not separable from how melanin is distributed by depth"
        )
    return lines
