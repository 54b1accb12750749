"""Normals, heights, strain and kernels of stretched skin against their truths."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from model import metrics
from model.skin import SkinAppearance, SkinMap
from reconstruction.normal_integration.height_filters import high_pass
from reconstruction.pipeline.gradient.stages import (
    CUTOFF_UM,
    HISTOGRAM_FILE,
    KERNEL_FILE,
    STRAIN_FILE,
)
from skinrig.appearances.contents import intersect_valid
from skinrig.arrays import Float32Array, Float64Array
from skinrig.evaluating.subsurface import parse_number, read_document
from skinrig.evaluating.surface import RAYLEIGH_68

MAX_NORMAL_ERROR_DEG = 1.5
MAX_HEIGHT_ERROR = 0.05
"""Error of the height, of the relief's own root mean square."""
MAX_STRAIN_ERROR = 0.005
MAX_HISTOGRAM_DISTANCE = 0.5
"""Distance of histograms with the fitted kernel, of that with the neutral only stretched."""


@dataclass(frozen=True, slots=True)
class ReliefAccuracy:
    """How normals and height of one state compare with the truth.

    Attributes
    ----------
    state
        Name.
    pixels, masked
        Pixels of skin with a truth, and the share of them without a valid estimate.
    mean_deg, median_deg, interval_deg
        Angle to the true normal as the lens shows it: mean, median with its 68 % interval.
    unblurred_deg
        Mean angle to the true normal at the pixel itself, which this aperture does not resolve.
    stderr_deg, coverage
        Median standard error in one direction, and the share of truths inside the 68 % region.
    height_um, relief_um
        Root mean square error of the height, and of the true relief itself, both without what is
        wider than a millimetre; NaN where no height was asked for.
    height_coverage
        Share of true heights within the standard error; the relief that the lens hides is no noise.
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
        """Error of the height over the relief."""
        return self.height_um / self.relief_um if self.relief_um > 0 else math.nan


@dataclass(frozen=True, slots=True)
class StretchAccuracy:
    """What caliper, images and truth say of a state's stretch along the jaws."""

    state: str
    reading: float
    truth: float
    found: float
    stderr: float

    @property
    def error(self) -> float:
        """Found less true."""
        return self.found - self.truth


def find_states(appearance: SkinAppearance) -> list[str]:
    """Return the names of the states that an appearance holds normals or heights of."""
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
    """Compare the normals and heights of every state with their truths, pixel by pixel.

    Parameters
    ----------
    appearance, truth
        On the camera's pixels.
    rng
        Of the bootstrap.
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
        covered = float(np.mean(np.abs(error) <= found.stderr[good]))
    return float(np.std(error)), float(np.std(relief[good])), covered


def true_relief(appearance: SkinAppearance, truth: SkinAppearance, state: str) -> Float32Array:
    """Return the true height of a state without what is wider than a millimetre, um.

    It has gone through the filter that the estimate went through, over the same pixels.
    """
    true, found = truth.maps[f"height_{state}"], appearance.maps[f"height_{state}"]
    pixel_um = float(str(appearance.parameters["pixel_um"]))
    good = intersect_valid(true) & intersect_valid(found)
    return np.asarray(
        high_pass(true.values, pixel=pixel_um, cutoff=CUTOFF_UM, valid=good), np.float32
    )


def compare_stretch(appearance: SkinAppearance, truth: SkinAppearance) -> list[StretchAccuracy]:
    """Compare the stretch of every state, as the caliper and the images say it, with the truth."""
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
    """Return state, stretch, and the distance of histograms before and after the fitted kernel."""
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
    """Return, by the caliper's angle, stretch and variance of n along the jaws, with errors.

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
