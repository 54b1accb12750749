"""Evaluate normals, heights, strain and kernels of stretched skin against ground truth."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from model import metrics
from model.skin import SkinAppearance, SkinMap
from reconstruction.normal_integration.height_filters import high_pass
from reconstruction.pipeline.gradient.patch_relief import CUTOFF_UM
from reconstruction.pipeline.gradient.stages import HISTOGRAM_FILE, KERNEL_FILE, STRAIN_FILE
from skinrig.appearances.contents import intersect_valid
from skinrig.arrays import Float32Array, Float64Array
from skinrig.evaluating.subsurface import parse_number, read_document
from skinrig.evaluating.surface import RAYLEIGH_68

MAX_NORMAL_ERROR_DEG = 1.5
MAX_HEIGHT_ERROR = 0.05
"""Limit of the height's error, as a fraction of the relief's root mean square."""
MAX_STRAIN_ERROR = 0.005
MAX_HISTOGRAM_DISTANCE = 0.5
"""Limit of the histogram distance with the fitted kernel, as a fraction of the distance with the
neutral relief only stretched."""


@dataclass(frozen=True, slots=True)
class ReliefAccuracy:
    """Accuracy of the normals and the height of one strain step.

    Attributes
    ----------
    state
        Name of the strain step.
    pixels, masked
        Pixels of skin with ground truth, and the fraction of them without a valid estimate.
    mean_deg, median_deg, interval_deg
        Angle to the true normal at the lens's resolution: mean, median with its 68 % interval.
    unblurred_deg
        Mean angle to the true normal at full resolution, which this aperture does not resolve.
    stderr_deg, coverage
        Median standard error in one direction, and the fraction of true normals in the 68 % region.
    height_um, relief_um
        Root mean square error of the height, and root mean square of the true relief, both
        high-passed at 1 mm; NaN without a height.
    height_coverage
        Fraction of true heights within the standard error, of heights less their mean, which
        normals do not determine. Relief below the lens's resolution is not part of the standard
        error.
    """

    state: str
    pixels: int
    masked: float
    mean_deg: float
    median_deg: float
    interval_deg: tuple[float, float]
    unblurred_deg: float
    stderr_deg: float
    coverage: float
    height_um: float
    relief_um: float
    height_coverage: float

    @property
    def height_relative(self) -> float:
        """Error of the height relative to the relief."""
        return self.height_um / self.relief_um if self.relief_um > 0 else math.nan


@dataclass(frozen=True, slots=True)
class StretchAccuracy:
    """Stretch of one strain step along the jaws: by caliper, by images, and true."""

    state: str
    reading: float
    truth: float
    found: float
    stderr: float

    @property
    def error(self) -> float:
        """Found minus true."""
        return self.found - self.truth


def find_states(appearance: SkinAppearance) -> list[str]:
    """Return the names of the strain steps with normals or heights."""
    return sorted(
        {
            name.removeprefix(kind)
            for name in appearance.maps
            for kind in ("normals_", "height_")
            if name.startswith(kind) and name.removeprefix(kind).startswith("a")
        }
    )


def compare(
    appearance: SkinAppearance, truth: SkinAppearance, *, rng: np.random.Generator
) -> list[ReliefAccuracy]:
    """Compare the normals and heights of every strain step with the ground truth, per pixel.

    Parameters
    ----------
    appearance, truth
        Maps on the camera's pixels.
    rng
        Generator of the bootstrap.
    """
    pixel_um = float(str(appearance.parameters.get("pixel_um", "nan")))
    rows = []
    for state in find_states(appearance):
        found, true = appearance.maps.get(f"normals_{state}"), truth.maps.get(f"normals_{state}")
        if found is None or true is None:
            continue
        skin = intersect_valid(true)
        good = skin & intersect_valid(found)
        seen = truth.maps.get(f"normals_seen_{state}", true)
        error = np.degrees(metrics.angular_error_rad(found.values[good], seen.values[good]))
        sharp = np.degrees(metrics.angular_error_rad(found.values[good], true.values[good]))
        stderr = np.degrees(_stderr(found)[good])
        middle, interval = metrics.median_with_interval(error, rng=rng)
        covered = error <= RAYLEIGH_68 * stderr
        masked = 1.0 - float(good.sum()) / max(int(skin.sum()), 1)
        off, unblurred, held = (
            float(each.mean()) if each.size else math.nan for each in (error, sharp, covered)
        )
        spread = float(np.median(stderr)) if stderr.size else math.nan
        angles = (off, middle, interval, unblurred, spread, held)
        heights = _height(appearance, truth, state, pixel_um)
        rows.append(ReliefAccuracy(state, int(skin.sum()), masked, *angles, *heights))
    return rows


def _height(
    appearance: SkinAppearance, truth: SkinAppearance, state: str, pixel_um: float
) -> tuple[float, float, float]:
    found, true = appearance.maps.get(f"height_{state}"), truth.maps.get(f"height_{state}")
    if found is None or true is None or not math.isfinite(pixel_um):
        return math.nan, math.nan, math.nan
    good = intersect_valid(found) & intersect_valid(true)
    if not good.any():
        return math.nan, math.nan, math.nan
    relief = true_relief(appearance, truth, state)
    error = (found.values - relief)[good]
    covered = math.nan
    if found.stderr is not None:
        # normals do not determine a relief's mean
        covered = float(np.mean(np.abs(error - error.mean()) <= found.stderr[good]))
    return float(np.std(error)), float(np.std(relief[good])), covered


def true_relief(appearance: SkinAppearance, truth: SkinAppearance, state: str) -> Float32Array:
    """Return the true height of a strain step, high-passed at 1 mm, um.

    The filter and its pixels are those of the estimate.
    """
    true, found = truth.maps[f"height_{state}"], appearance.maps[f"height_{state}"]
    pixel_um = float(str(appearance.parameters["pixel_um"]))
    good = intersect_valid(true) & intersect_valid(found)
    return np.asarray(
        high_pass(true.values, pixel=pixel_um, cutoff=CUTOFF_UM, valid=good), np.float32
    )


def compare_stretch(appearance: SkinAppearance, truth: SkinAppearance) -> list[StretchAccuracy]:
    """Compare the stretch by caliper and by images with the true one, for every strain step."""
    measured = read_document(appearance, STRAIN_FILE)
    known = truth.parameters.get("states")
    if measured is None or not isinstance(known, list):
        return []
    true = {str(state["name"]): state for state in known}
    rows = []
    for state in measured["states"]:
        name = str(state["name"])
        if name not in true or not state["valid"]:
            continue
        gradient = np.asarray(true[name]["gradient"], float)
        angle = math.radians(float(state["angle_deg"]))
        axis = np.array([math.cos(angle), math.sin(angle)])
        reading, truth_s = (
            parse_number(state["reading_ratio"]),
            float(np.linalg.norm(gradient @ axis)),
        )
        found, stderr = parse_number(state["stretch_s"]), parse_number(state["stretch_s_stderr"])
        rows.append(StretchAccuracy(name, reading, truth_s, found, stderr))
    return rows


def distances(appearance: SkinAppearance) -> list[tuple[str, float, float, float]]:
    """Return strain step, stretch, and histogram distance without and with the fitted kernel."""
    fitted = read_document(appearance, KERNEL_FILE)
    if fitted is None:
        return []
    fits = [fit for fit in fitted["fits"] if fit["valid"]]
    distance = [
        (parse_number(fit["distance_before"]), parse_number(fit["distance"])) for fit in fits
    ]
    return [
        (str(fit["name"]), parse_number(fit["stretch_s"]), *both)
        for fit, both in zip(fits, distance, strict=True)
    ]


def normal_variances(
    appearance: SkinAppearance,
) -> Mapping[float, list[tuple[float, float, float, float]]]:
    """Return stretch and variance of n along the jaws, with errors, by the caliper's angle.

    Returns
    -------
    mapping
        Angle in degrees -> list of (stretch, its standard error, variance, its standard error), by
        stretch.
    """
    histograms = read_document(appearance, HISTOGRAM_FILE)
    strain = read_document(appearance, STRAIN_FILE)
    if histograms is None or strain is None:
        return {}
    stretch = {s["name"]: s for s in strain["states"] if s["valid"]}
    found: dict[float, list[tuple[float, float, float, float]]] = {}
    for entry in histograms["states"]:
        state = stretch.get(entry["name"])
        if state is None or entry["variance_s"] is None:
            continue
        along = parse_number(state["stretch_s"]), parse_number(state["stretch_s_stderr"])
        spread = parse_number(entry["variance_s"]), parse_number(entry["variance_s_stderr"])
        found.setdefault(float(state["angle_deg"]), []).append((*along, *spread))
    return {angle: sorted(rows) for angle, rows in sorted(found.items())}


def _stderr(skin_map: SkinMap) -> Float64Array:
    if skin_map.stderr is None:
        return np.full(skin_map.values.shape[:2], np.nan)
    spread = skin_map.stderr.astype(np.float64)
    return spread if spread.ndim == 2 else spread[..., 0]
