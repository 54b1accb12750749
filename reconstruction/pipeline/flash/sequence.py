"""Stages of a flash session, and the blood curves of a sequence.

Each frame of a sequence is one cross-polarized image with its own time. The frames of one subject
share one melanin map, so that only blood varies between frames. Frames in which the face has moved
are warped to the face at rest. The curves use the measured times of the flash.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from capture.plan.phases import phase_grid
from capture.session import FrameRecord, Session
from model.skin import SkinMap
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from reconstruction.chromophores import model_error
from reconstruction.correspondence import expression_alignment, landmark_table
from reconstruction.facial_color import perfusion_curves, perfusion_fit
from reconstruction.facial_color.perfusion_samples import PoseStep
from reconstruction.pipeline import graph as stages
from reconstruction.pipeline.flash import sequence_blood
from reconstruction.pipeline.flash import stages as flash_stages
from reconstruction.pipeline.inputs import Inputs, InputsError

STAGE_REVISION = 10
CURVES_NAME = "perfusion_curves"
CURVES_FILE = "perfusion_curves.json"
MAP_NAMES = (*flash_stages.MAP_NAMES, CURVES_NAME)
"""Products of a flash session."""
FILE_NAMES = (CURVES_FILE,)
RADIUS_FRACTION = 0.02
"""Radius of a site's disc over the map's width: 5 mm of a face that fills the image."""
MAX_STILL_MOTION_PX = 0.1
"""Median displacement of the face below which it has not moved."""
BLOOD_CURVE_STDERR = 0.07
"""Standard error of the curvature of the square root of blood over its change. Not all vessels
respond alike, and interreflected light, which the inversion does not model, is absorbed twice.
Value: the smallest with which 95 % intervals cover 92 % or more (93 %) in 14 events of seeds 0 to
19, 192 px across; with 0 the coverage is 87 %."""


def products(session: Session) -> Mapping[str, tuple[str, ...]]:
    """Return the products that each name means."""
    return {CURVES_NAME: (CURVES_FILE,)}


def graph(inputs: Inputs) -> list[stages.PipelineStage]:
    """Return the stages of a flash session; see `graph.run_stages`."""
    session = inputs.session
    crossed = session.frames("subject", polarizer="crossed")
    refused = (
        f"{session.path}: has no frames with a time, expected a sequence; capture one, as with "
        "`skinrig capture flash --sequence smile`"
    )
    if any("time_s" in record.line.actual for record in crossed):
        refused = ""
    of_images = flash_stages.graph(inputs)
    stage = inputs.stage_maker(STAGE_REVISION)
    curves, identity = partial(_curves, inputs), model_error.data_hash()
    return [*of_images, stage(CURVES_NAME, "", CURVES_FILE, curves, refused, **identity)]


def _curves(inputs: Inputs) -> bytes:
    """Return the document of a sequence's curves."""
    session = inputs.session
    records = session.frames("subject", polarizer="crossed")
    rig = flash_stages.load_flash_rig(inputs)
    maps = list(flash_stages.separate_each(rig, records))
    actual = [record.line.actual for record in records]
    time = np.array([float(a.get("time_s", np.nan)) for a in actual])
    phase = np.array([float(a.get("phase_s", np.nan)) for a in actual])
    prompt_s = float(session.plan.limits.get("prompt_period_s", 0.0))
    limits = session.plan.limits
    moved, warped = np.zeros(len(maps), bool), maps
    if prompt_s > 0:
        phase = phase % (2 * prompt_s)
        moved, warped = _align_to_rest(maps, phase, prompt_s, inputs)
    places = _places(inputs, maps, ~moved)
    radius_px = RADIUS_FRACTION * maps[0].values.shape[1]
    light = sequence_blood.SkinColorModel.of(rig)
    blood = sequence_blood.average_disc_blood(warped, places, radius_px, light, moved=moved)
    means = blood.means
    if not means.valid.any():
        hint = "check the landmarks" if rig.white else "give it a calibration of white"
        what = f"got no skin color at {', '.join(places)} in enough frames"
        raise InputsError(f"{session.path}: {what}; {hint}")
    curves = zip(means.mean, means.stderr, means.pixels, blood.stderr_of_pose, strict=True)
    columns = ("hemoglobin", "stderr", "pixels", "stderr_of_pose")
    document: dict[str, Any] = {
        "schema": "skinrig.perfusion-curves/1",
        "state": _state(records),
        "prompt_period_s": prompt_s if prompt_s > 0 else None,
        "shot_period_s": limits.get("shot_period_s"),
        "places_px": {name: list(place) for name, place in places.items()},
        "radius_px": radius_px,
        "frames": [
            {"step": record.step_id, "time_s": time[k], "phase_s": phase[k]}
            | {name: actual[k].get(name) for name in ("late_s", "time_error_s", "block")}
            | {"moved": bool(moved[k])}
            for k, record in enumerate(records)
        ],
        "curves": {
            name: dict(zip(columns, curve, strict=True))
            for name, curve in zip(places, curves, strict=True)
        },
        "common_half_width": blood.common_half_width,
    }
    if prompt_s > 0:
        document |= _cycle_document(time, phase, blood, prompt_s, session, list(places))
    else:
        document |= _event_document(time, means, list(places))
    return stages.serialize_document(document)


def _state(records: Sequence[FrameRecord]) -> str:
    """Return the state of a sequence other than rest."""
    names = [str(record.index["state"]) for record in records if "time_s" in record.line.actual]
    return next((name for name in names if name != "neutral"), "neutral")


def _places(
    inputs: Inputs, maps: Sequence[SkinMap], at_rest: BoolArray
) -> dict[str, tuple[float, float]]:
    """Return the positions of the sites on the face at rest, px."""
    skin = np.mean([m.mask for m, rest in zip(maps, at_rest, strict=True) if rest], axis=0) > 0.5
    if inputs.landmarks is None:
        outline = "places: by the face's outline; give a table of landmarks for exact positions"
        inputs.assumed.append(outline)
        return perfusion_curves.standard_positions(skin)
    table = landmark_table.read_landmark_table(inputs.landmarks)
    try:
        return perfusion_curves.select_sites(table)
    except perfusion_curves.CurveError as error:
        raise InputsError(f"{inputs.landmarks}: {error}") from error


def _align_to_rest(
    maps: Sequence[SkinMap], phase: Float64Array, prompt_s: float, inputs: Inputs
) -> tuple[BoolArray, list[SkinMap]]:
    """Detect the frames in which the face has moved, and warp those to the face at rest."""
    settled_on = (phase > 0.5 * prompt_s) & (phase < prompt_s)
    settled_off = phase > 1.5 * prompt_s
    still = np.zeros(len(maps), bool)
    if not (settled_on.any() and settled_off.any()):
        return still, list(maps)
    on, on_valid = _mean(maps, settled_on)
    off, off_valid = _mean(maps, settled_off)
    try:
        alignment = expression_alignment.align(
            on, off, valid_moving=on_valid, valid_neutral=off_valid
        )
    except expression_alignment.AlignmentError as error:
        inputs.assumed.append(f"the face does not move with the expression ({error})")
        return still, list(maps)
    rows, columns = np.indices(off_valid.shape)
    shift = np.hypot(alignment.source_px[..., 0] - columns, alignment.source_px[..., 1] - rows)
    if not alignment.valid.any() or np.median(shift[alignment.valid]) < MAX_STILL_MOTION_PX:
        return still, list(maps)
    both = on_valid & off_valid
    moved = np.array([_is_more_similar(m, on, off, both) for m in maps])
    # one alignment warps all moved frames: its error is constant over them, so it enters the step
    # between poses and not the noise from frame to frame
    laid = [alignment.warp_map(m) if is_on else m for m, is_on in zip(maps, moved, strict=True)]
    return moved, laid


def _mean(maps: Sequence[SkinMap], chosen: BoolArray) -> tuple[Float32Array, BoolArray]:
    picked = [m for m, take in zip(maps, chosen, strict=True) if take]
    valid = np.logical_and.reduce([m.mask for m in picked])
    mean = np.asarray(np.mean([m.values for m in picked], axis=0, dtype=np.float64), np.float32)
    return mean, np.asarray(valid, bool)


def _is_more_similar(
    image: SkinMap, one: Float32Array, other: Float32Array, both: BoolArray
) -> bool:
    """Return whether a frame is closer to the first template, in red, where blood varies least."""
    good = both & image.mask
    if not good.any():
        return False

    def distance(template: Float32Array) -> float:
        ratio = np.log(image.values[good, 0]) - np.log(template[good, 0])
        return float(np.mean(np.abs(ratio - np.median(ratio))))

    return distance(one) < distance(other)


def _cycle_document(
    time: Float64Array,
    phase: Float64Array,
    blood: sequence_blood.SiteBlood,
    prompt_s: float,
    session: Session,
    names: Sequence[str],
) -> dict[str, Any]:
    """Return the document's part on a prompted cycle."""
    cycle_s = 2 * prompt_s
    known = np.isfinite(phase)
    groups = perfusion_curves.group_by_phase(phase[known], cycle_s=cycle_s)
    ordered = np.sort(phase[known])
    gaps = np.diff(ordered, append=ordered[0] + cycle_s)
    grid = phase_grid(prompt_s, float(session.plan.limits["shot_period_s"]))
    fits, seen, again = {}, {}, {}
    means = blood.means
    values = [(means.mean[k][known], means.stderr[k][known]) for k in range(len(names))]
    usable = [k for k, (value, _) in enumerate(values) if np.isfinite(value).sum() >= 8]
    for k in usable:
        value, stderr = values[k]
        good = np.isfinite(value)
        fits[names[k]] = _fit_document(_fit_prompts(phase[known], known, blood, [k], cycle_s), 0)
        seen[names[k]] = _transition_document(
            perfusion_curves.find_transition(
                phase[known][good], value[good], cycle_s=cycle_s, stderr=stderr[good]
            ),
            np.flatnonzero(known)[good],
        )
        again[names[k]] = perfusion_curves.estimate_reproducibility(
            time[known][good], phase[known][good], value[good], cycle_s=cycle_s
        )
    of_all = None
    if usable:
        of_all = _fit_document(_fit_prompts(phase[known], known, blood, usable, cycle_s), None)
    return {
        "cycle_s": cycle_s,
        "order": np.flatnonzero(known)[np.argsort(phase[known], kind="stable")],
        "phases": {
            "captures": int(known.sum()),
            "distinct": int(np.unique(groups).size),
            "interval_s": float(grid.interval_s),
            "largest_gap_s": float(gaps.max()),
            "aliased": grid.is_aliased,
        },
        "reproducibility": {name: asdict(one) for name, one in again.items()},
        "transition": seen,
        "fits": fits,
        "fit_of_all": of_all,
    }


def _fit_prompts(
    phase: Float64Array,
    known: BoolArray,
    blood: sequence_blood.SiteBlood,
    which: Sequence[int],
    cycle_s: float,
) -> perfusion_fit.RelaxationFit:
    """Fit the vessel radius of some sites; blood is proportional to its square."""
    means = blood.means.mean[which][:, known]
    root = np.sqrt(np.where(means > 0.0, means, np.nan))
    slope = 0.5 / root  # d sqrt(b) / db = 1 / (2 sqrt(b))
    stderr = np.array([_floor_stderr(row) for row in blood.means.stderr[which][:, known] * slope])
    of_pose = blood.stderr_of_pose[which] * np.nanmean(slope, axis=1)
    found = perfusion_fit.fit_cycle(
        phase,
        root,
        cycle_s=cycle_s,
        stderr=stderr,
        bend=BLOOD_CURVE_STDERR,
        pose=PoseStep(blood.moved[known], of_pose),
    )
    return perfusion_fit.square_levels(found)


def _floor_stderr(stderr: Float64Array) -> Float64Array:
    """Add the median standard error in quadrature, which limits the weight of single frames."""
    finite = stderr[np.isfinite(stderr)]
    usual = float(np.median(finite)) if finite.size else 0.0
    return np.asarray(np.hypot(stderr, usual))


def _event_document(
    time: Float64Array, means: perfusion_curves.DiscMeans, names: Sequence[str]
) -> dict[str, Any]:
    """Return the document's part on the response to an event."""
    known = np.isfinite(time)
    usable = [k for k in range(len(names)) if np.isfinite(means.mean[k][known]).sum() >= 5]
    radius = np.sqrt(np.maximum(means.mean, 0.0))  # of vessels, up to a factor
    at = time[known]

    def fit(which: Any) -> perfusion_fit.RelaxationFit:
        found = perfusion_fit.fit_course(at, radius[which][..., known], bend=BLOOD_CURVE_STDERR)
        return perfusion_fit.square_levels(found)

    fits = {names[k]: _fit_document(fit(k), 0) for k in usable}
    before = {names[k]: float(np.nanmean(means.mean[k][~known])) for k in usable if (~known).any()}
    of_all = _fit_document(fit(usable), None) if usable else None
    return {"before": before, "fits": fits, "fit_of_all": of_all}


def _fit_document(fit: perfusion_fit.RelaxationFit, curve: int | None) -> dict[str, Any]:
    """Return a fit's document, with the step between its levels in standard errors."""
    names = "time_constant_s stderr_time_constant_s interval_s interval_68_s known delay_s"
    document = stages.select_attributes(fit, f"{names} stderr_delay_s delay_interval_s")
    document["text"] = str(fit)
    if curve is not None:
        names = "start end stderr_start stderr_end stderr_change step stderr_step noise"
        of_curves = stages.select_attributes(fit, names)
        titles = {"step": "step_of_pose", "stderr_step": "stderr_step_of_pose"}
        document |= {titles.get(name, name): all_[curve] for name, all_ in of_curves.items()}
        apart = abs(float(fit.end[curve] - fit.start[curve]))
        document["levels_apart_sigmas"] = apart / max(float(fit.stderr_change[curve]), 1e-300)
    return document


def _transition_document(found: perfusion_curves.Transition, indices: Int64Array) -> dict[str, Any]:
    document = stages.select_attributes(found, "seen decided") | {"frames": indices[found.where]}
    return document | stages.select_attributes(found, "tested false_alarm power high low noise")
