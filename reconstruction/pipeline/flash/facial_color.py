"""Fit a hemoglobin rig to flash sessions: align images, invert them jointly, take statistics.

Each image is warped to the first neutral one. Repeats of a state are averaged. All states share
one melanin map. The remaining blood volume fraction makes the rig of `model.facial_color`.

References
----------
Jimenez et al. 2010, doi:10.1145/1866158.1866167, sections 3 and 4
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from model.checks import Checks
from model.facial_color import HemoglobinRig
from model.skin import MAP_UNITS, SkinMap
from reconstruction.arrays import BoolArray, Float32Array, Float64Array
from reconstruction.chromophores import model_error
from reconstruction.chromophores.pixel_checks import is_detectable
from reconstruction.chromophores.posterior import errors_within_face
from reconstruction.correspondence import expression_alignment
from reconstruction.correspondence.expression_alignment import Alignment
from reconstruction.facial_color import registration_error as misplacement
from reconstruction.facial_color import repeat_average, repeatability, shared_melanin
from reconstruction.facial_color.repeatability import MapDrift, Repeatability, RepeatabilityError
from reconstruction.facial_color.shared_melanin import SharedMelanin
from reconstruction.pipeline import graph as stages
from reconstruction.pipeline.flash.stages import NOISE_STDERR_SUFFIX, load_skin_colors, map_stderr
from reconstruction.pipeline.flash.state_images import (
    NEUTRAL_STATE,
    Landmarks,
    StateImage,
    SubjectImages,
)
from reconstruction.pipeline.masked_map import masked_map

NOISE_CORRELATION_PX: Final = 3.0
"""Correlation length of the noise after demosaicing and interpolation, in pixels."""
RADIUS_FRACTION: Final = 1 / 32
"""Default radius of the disc over the larger side of the map."""


class FacialColorFitError(ValueError):
    """Sessions that a hemoglobin rig cannot be fitted to."""


class UnknownBloodError(FacialColorFitError):
    """Skin whose colors leave its blood volume fraction at rest undetermined."""


@dataclass(frozen=True, slots=True, eq=False)
class AlignedImage:
    """One image warped to the neutral one.

    Attributes
    ----------
    image
        State, repeat and session of the image.
    rgb, variance
        (H, W, 3): diffuse reflectance and its variance; 0 where not ``valid``.
    valid
        (H, W).
    alignment
        Warp to the neutral image; None for that image itself.
    """

    image: StateImage
    rgb: Float32Array
    variance: Float32Array
    valid: BoolArray
    alignment: Alignment | None


@dataclass(frozen=True, slots=True)
class Repeats:
    """Repeatability of states, each image inverted alone.

    Attributes
    ----------
    hemoglobin
        Within-state against between-state variation.
    melanin_drift
        Drift of melanin over the time of capture, by region; empty where undetermined.
    """

    hemoglobin: Repeatability
    melanin_drift: tuple[MapDrift, ...]


@dataclass(frozen=True, slots=True, eq=False)
class FacialColorFit:
    """Result of a fit to one subject's sessions.

    Attributes
    ----------
    rig
        Hemoglobin rig of all states.
    melanin
        Shared by the states; its standard error contains noise and model error.
    hemoglobin
        Blood volume fraction of each state in the neutral image's frame, with standard errors.
    changes
        Blood of each state minus the neutral, with the standard error of the difference.
    aligned
        Every image.
    shared
        Result of the joint inversion.
    repeats
        Repeatability of the states; None where no state was captured twice.
    omitted
        Images and states that were not used, each with the reason.
    """

    rig: HemoglobinRig
    melanin: SkinMap
    hemoglobin: Mapping[str, SkinMap]
    changes: Mapping[str, SkinMap]
    aligned: tuple[AlignedImage, ...]
    shared: SharedMelanin
    repeats: Repeats | None
    omitted: tuple[tuple[str, str], ...]


def fit_facial_color(
    subject: SubjectImages,
    *,
    radius_px: float | None = None,
    landmarks: Mapping[str, Landmarks] | None = None,
    stored_size: int | None = 256,
    progress: Callable[[str], None] | None = None,
) -> FacialColorFit:
    """Fit the hemoglobin rig of a subject.

    Parameters
    ----------
    subject
        Images of at least the neutral and one other state.
    radius_px
        Radius of the disc of eq. (1), px of the maps; None: a 32nd of the larger side.
    landmarks
        Named points of each state's images, px of the maps; None: features are matched, as
        for states without landmarks.
    stored_size
        Size of the stored scale and bias maps, cells per side.
    progress
        Called with one line per step.

    Returns
    -------
    FacialColorFit

    Raises
    ------
    FacialColorFitError
        When the neutral state is the only one, or no other can be aligned to it.
    """
    states = subject.states
    alone, expected = "the neutral state alone", "at least one other; add its session"
    Checks(FacialColorFitError).require(len(states) > 1, "sessions", alone, expected)
    report = progress or (lambda _: None)
    base = subject.images_of_state(NEUTRAL_STATE)[0]
    shape = base.maps["diffuse"].values.shape[:2]
    radius = max(shape) * RADIUS_FRACTION if radius_px is None else radius_px
    aligned, left_out = _align(subject, base, landmarks or {}, report)
    of_state: dict[str, list[AlignedImage]] = {
        state: own
        for state in states
        if (own := [one for one in aligned if one.image.state == state])
    }
    if len(of_state) < 2:
        reasons = "; ".join(f"{what}: {why}" for what, why in left_out)
        hint = "capture again, or give landmarks"
        got = f"no state could be aligned to the neutral one: {reasons}"
        raise FacialColorFitError(f"sessions: {got}; {hint}")
    report("one melanin for all states")
    shared = _one_melanin(subject, list(of_state.values()))
    blood = {state: _blood(shared, k) for k, state in enumerate(of_state)}
    if not blood[NEUTRAL_STATE].mask.any():
        raise UnknownBloodError(
            "blood at rest: got a standard error above half of it all over the face, expected "
            "pixels that determine it; take more light or, for very dark skin, estimate melanin "
            "alone: skinrig reconstruct --maps melanin"
        )
    report("scale and bias maps")
    mask = {state: found.mask for state, found in blood.items()}
    known = {state: np.where(mask[state], blood[state].values, np.nan) for state in blood}
    noise = dict(zip(blood, shared.noise_stderr_hemoglobin, strict=True))
    rig = HemoglobinRig.from_maps(
        known[NEUTRAL_STATE],
        {state: values for state, values in known.items() if state != NEUTRAL_STATE},
        radius_px=radius,
        valid=mask,
        stderr={state: np.where(mask[state], noise[state], np.nan) for state in blood},
        stored_size=stored_size,
        common_log_sd=_common_log_sd(shared),
    )
    within = errors_within_face(shared.stderr_melanin, shared.optics_stderr_melanin)
    good = is_detectable(shared.melanin, within, shared.valid)
    what = f"shared by {len(blood)} states"
    return FacialColorFit(
        rig=rig,
        melanin=masked_map(shared.melanin, shared.stderr_melanin, good, MAP_UNITS["melanin"], what),
        hemoglobin=blood,
        changes={
            state: _change(shared, k) for k, state in enumerate(blood) if state != NEUTRAL_STATE
        },
        aligned=tuple(aligned),
        shared=shared,
        repeats=_repeats(aligned, timed=subject.timed),
        omitted=tuple(left_out),
    )


def _one_melanin(subject: SubjectImages, of_states: list[list[AlignedImage]]) -> SharedMelanin:
    """Average the images of each state, and fit one melanin map to all."""

    def average(images: list[AlignedImage]) -> tuple[Float32Array, Float32Array, BoolArray]:
        parts = zip(*((one.rgb, one.variance, one.valid) for one in images), strict=True)
        return repeat_average.average_repeats(*map(np.stack, parts))

    averages = [average(images) for images in of_states]
    rgb, variance, valid = (np.stack(parts) for parts in zip(*averages, strict=True))
    table, prior = load_skin_colors(subject.camera, subject.illuminant, has_white=subject.has_white)
    return shared_melanin.estimate_shared_melanin(
        rgb,
        table,
        prior=prior,
        variance=variance,
        model_error=_model_error(averages),
        state_covariance=np.stack([_own_error(images) for images in of_states]),
        valid=valid,
        shading_window_px=shared_melanin.SHADING_WINDOW_PX,
        one_face=subject.has_white,
    )


def _align(
    subject: SubjectImages,
    base: StateImage,
    landmarks: Mapping[str, Landmarks],
    report_progress: Callable[[str], None],
) -> tuple[list[AlignedImage], list[tuple[str, str]]]:
    """Warp every image to the first neutral one."""
    found: list[AlignedImage] = []
    left_out: list[tuple[str, str]] = []
    fixed = base.maps["diffuse"]
    for image in subject.images:
        diffuse = image.maps["diffuse"]
        if image is base:
            found.append(_aligned(image, diffuse, None))
            continue
        report_progress(f"align {image.name} to the neutral image")
        marks = landmarks.get(image.state), landmarks.get(NEUTRAL_STATE)
        both = marks[0] is not None and marks[1] is not None
        try:
            alignment = expression_alignment.align(
                _light(diffuse),
                _light(fixed),
                landmarks_moving=marks[0] if both else None,
                landmarks_neutral=marks[1] if both else None,
                valid_moving=diffuse.mask,
                valid_neutral=fixed.mask,
            )
        except expression_alignment.AlignmentError as error:
            left_out.append((image.name, str(error)))
            continue
        found.append(_aligned(image, alignment.warp_map(diffuse), alignment))
    return found, left_out


def _repeats(aligned: list[AlignedImage], *, timed: bool) -> Repeats | None:
    """Compare repeats; None where no state has any, or their common valid area is too small."""
    states = [one.image.state for one in aligned]
    if len(set(states)) == len(states) or "hemoglobin" not in aligned[0].image.maps:
        return None

    def laid(one: AlignedImage, name: str) -> tuple[Any, Any, Any]:
        found, noise = one.image.maps[name], one.image.maps[name + NOISE_STDERR_SUFFIX]
        if one.alignment is None:
            return found.values, noise.values, found.mask
        values, good = one.alignment.warp(found.values, found.mask)
        return values, one.alignment.warp_stderr(found.values, noise.values, found.mask), good

    def over(name: str) -> dict[str, Any]:
        parts = zip(*(laid(one, name) for one in aligned), strict=True)
        of_maps = zip(("maps", "stderr", "valid"), map(np.stack, parts), strict=True)
        return dict(of_maps, states=states, correlated_px=NOISE_CORRELATION_PX)

    try:
        compared = repeatability.compare_states(**over("hemoglobin"))
    except RepeatabilityError:
        return None
    drifts: tuple[MapDrift, ...] = ()
    if timed:
        with suppress(RepeatabilityError):
            times_s = [one.image.captured_s for one in aligned]
            drifts = repeatability.fit_drift(times_s=times_s, **over("melanin"))
    return Repeats(compared, drifts)


def _light(diffuse: SkinMap) -> Float32Array:
    return np.where(diffuse.mask[..., None], diffuse.values, np.nan).astype(np.float32)


def _aligned(image: StateImage, diffuse: SkinMap, alignment: Alignment | None) -> AlignedImage:
    good = diffuse.mask & (diffuse.values > 0).all(axis=-1)
    return AlignedImage(
        image,
        np.where(good[..., None], diffuse.values, 0.0),
        np.where(good[..., None], map_stderr(diffuse) ** 2, 0.0),
        good,
        alignment,
    )


def _model_error(averages: list[tuple[Float32Array, Float32Array, BoolArray]]) -> Float64Array:
    """Return each pixel's model error covariance, averaged over the states that observe it."""
    total = np.zeros((*averages[0][2].shape, 3, 3))
    count = np.zeros(averages[0][2].shape)
    for rgb, variance, valid in averages:
        good = model_error.usable_pixels(rgb, valid)
        total += np.where(
            good[..., None, None], model_error.image_covariance(rgb, variance, valid), 0.0
        )
        count += good
    mean = total / np.maximum(count, 1.0)[..., None, None]
    return np.where((count > 0)[..., None, None], mean, model_error.load_error_terms().transport)


def _own_error(images: list[AlignedImage]) -> Float64Array:
    """Return the covariance of a state's mean color that its registration error causes.

    Repeats move alike, so their registration errors are fully correlated: the covariance of the
    mean is the mean covariance, without a division by the number of repeats.
    """
    total = np.zeros((*images[0].valid.shape, 3, 3))
    count = np.zeros(images[0].valid.shape)
    for one in images:
        count += one.valid
        if one.alignment is not None:
            total += misplacement.registration_covariance(
                one.rgb,
                one.variance,
                one.valid,
                one.alignment,
                light_window_px=shared_melanin.SHADING_WINDOW_PX,
            )
    return np.asarray(total / np.maximum(count, 1.0)[..., None, None])


def _blood(shared: SharedMelanin, k: int) -> SkinMap:
    good = shared.valid_states[k] & ~shared.is_misfit[k]
    blood, stderr = shared.hemoglobin[k], shared.stderr_hemoglobin[k]
    good &= is_detectable(
        blood, errors_within_face(stderr, shared.optics_stderr_hemoglobin[k]), good
    )
    what = "given the melanin that all states share"
    return masked_map(blood, stderr, good, MAP_UNITS["hemoglobin"], what)


def _common_log_sd(shared: SharedMelanin) -> float:
    """Return the standard error of log blood by optics; it is one number for a face."""
    relative = shared.optics_stderr_hemoglobin / shared.hemoglobin
    known = relative[np.isfinite(relative)]
    return float(np.median(known)) if known.size else 0.0


def _change(shared: SharedMelanin, k: int) -> SkinMap:
    both = shared.valid_states[k] & shared.valid_states[shared.reference]
    good = both & ~shared.is_misfit[k] & np.isfinite(shared.stderr_change[k])
    what = "minus the neutral state; errors common to both cancel"
    change, stderr = shared.change[k], shared.stderr_change[k]
    return masked_map(change, stderr, good, MAP_UNITS["hemoglobin"], what)


def alignment_document(fit: FacialColorFit) -> list[dict[str, Any]]:
    """Return the alignment of each image to the neutral one, as JSON values."""
    rows = []
    for one in fit.aligned:
        if (found := one.alignment) is None:
            continue
        error = found.error_px[found.valid]
        rows.append(
            stages.select_attributes(one.image, "state repeat session")
            | {
                "by": found.by,
                "landmark_rms_px": _number(found.landmark_rms_px),
                "median_error_px": _number(np.median(error)) if error.size else None,
                "folded_fraction": found.folded_fraction,
                "valid_fraction": float(found.valid.mean()),
            }
        )
    return rows


def _number(value: Any) -> Any:
    """Convert a number to JSON: None where it is not finite."""
    if isinstance(value, str | bool | int):
        return value
    return float(value) if np.isfinite(value) else None


def repeats_document(fit: FacialColorFit) -> dict[str, Any] | None:
    """Return the repeatability of the states, as JSON values; None without repeats."""
    if fit.repeats is None:
        return None

    def rows(found: Sequence[Any], names: str) -> list[dict[str, Any]]:
        return [
            {"region": one.name}
            | {name: _number(value) for name, value in stages.select_attributes(one, names).items()}
            for one in found
        ]

    of_regions = "pixels within between correlation correlation_stderr p_value scatters"
    of_drifts, found = "slope_per_minute slope_stderr p_value drifts", fit.repeats.hemoglobin
    return {
        "false_alarm": found.false_alarm,
        "hemoglobin": rows(found.regions, f"{of_regions} change_to_scatter"),
        "melanin_drift": rows(fit.repeats.melanin_drift, of_drifts),
    }
