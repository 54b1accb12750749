"""Stages of images under listed lights, without a calibrated rig: normals and albedo."""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from capture.importers.exif import EXPOSURE_TERMS, compare_exposures
from capture.session import Session
from capture.session.view import FrameRecord
from model.checks import Checks
from model.skin import MAP_UNITS, SkinMap
from model.vectors import unit_vectors
from reconstruction.arrays import BoolArray, Float32Array, Float64Array
from reconstruction.normal_maps import NormalMaps, PhotometricStereoError
from reconstruction.photometric_stereo import estimate_normals
from reconstruction.pipeline import graph as stages
from reconstruction.pipeline.diagnosed_images import FAULTS_NOTE, DiagnosedImages
from reconstruction.pipeline.inputs import Inputs, InputsError
from reconstruction.pipeline.linear_frame import read_linear
from reconstruction.pipeline.masked_map import masked_map
from reconstruction.stack_diagnosis import Diagnosis, diagnose_stack

STAGE_REVISION = 8
"""Grows when the code of a stage changes its result, so that older maps are recomputed."""

MAP_NAMES = ("normals", "albedo", "residual")
"""Maps of a session with a light list."""

MEMORY_BYTES = 2**30
"""Stacks above this size are stored in a file, not in memory."""
MIN_KEPT_IMAGES = 4
"""Images without which none is left out."""
ORDER_FAULTS = frozenset({"order of lights", "swapped lights"})
"""Faults without effect on the maps: another order is used."""
LEFT_OUT_FAULTS = frozenset(
    {
        *("wrong light", "moved image", "mirrored image"),
        *("empty image", "dead light", "padded image", "full-bright image"),
    }
)
"""Faults without effect on the maps if their images are left out."""
OUTLIER_SIGMAS = 4.0


@dataclass(frozen=True, slots=True)
class LightStack:
    """Gray images under each light, over exposure and strength of the light."""

    gray: Float32Array
    """(N, H, W)."""
    usable: BoolArray
    """(N, H, W)."""
    inside: BoolArray
    """(H, W)."""
    records: tuple[FrameRecord, ...]
    gain: Float64Array
    """(N, 3): factor on the values of each frame, per channel."""
    folder: Any
    """Keeps the temporary folder of a large stack alive."""


@dataclass(frozen=True, slots=True)
class StackLights:
    """Lights in the order that agrees with the shading."""

    vectors: Float64Array
    """(N, 3) in the order of the stack: directions, or positions in mm where near."""
    near: bool
    mm_per_px: float
    alive: BoolArray
    stderr_rad: float
    """Standard error of the directions, where they were estimated from the images; else 0."""


def graph(inputs: Inputs) -> list[stages.PipelineStage]:
    """Return the stages of a session with a light list; see `graph.run_stages`."""
    stage = inputs.stage_maker(STAGE_REVISION)
    known = "stack lights normals gray_albedo"
    return [
        stage("stack", "", "stack", partial(_stack, inputs.session, inputs.assumed)),
        stage("lights", "stack", "lights", partial(_lights, inputs)),
        stage("normals", "stack lights", "normals residual gray_albedo", partial(_normals, inputs)),
        stage("albedo", known, "albedo", partial(_albedo, inputs.session)),
    ]


def _stack(session: Session, assumed: list[str]) -> LightStack:
    records = tuple(session.frames("olat"))
    got = f"{len(records)} frames under one light at a time"
    Checks(InputsError).require(len(records) >= 3, f"{session.path}", got, "3; add images")
    settings = [record.settings for record in records]
    exposures, _ = compare_exposures(settings)
    gain = np.ones((len(records), 3))
    if exposures:
        gain *= (np.median(exposures) / np.array(exposures))[:, None]
    elif any(name in one for one in settings for name in EXPOSURE_TERMS):
        assumed.append("exposures of the images cannot be compared: all count as exposed alike")
    listed = session.manifest.extra.get("light_list")
    strength = listed.get("intensity") if isinstance(listed, dict) else None
    if strength is not None:
        level = np.asarray(strength, np.float64)
        gain /= level / level.mean()
    folder: Any = None
    for number, record in enumerate(records):
        values, good = read_linear(session.read(record))
        if number == 0:
            shape = (len(records), *good.shape)
            gray: Any = np.empty(shape, np.float32)
            usable: Any = np.empty(shape, bool)
            if gray.nbytes > MEMORY_BYTES:
                folder = tempfile.TemporaryDirectory(prefix="skinrig-")
                at = Path(folder.name)
                gray = np.memmap(at / "gray", np.float32, "w+", shape=shape)
                usable = np.memmap(at / "usable", np.bool_, "w+", shape=shape)
        factor = gain[number, : values.shape[2]].astype(np.float32)
        gray[number] = (values * factor).mean(axis=-1)
        usable[number] = good
    inside = np.ones(gray.shape[1:], bool)
    if "mask.png" in session.attachments():
        import cv2

        data = np.frombuffer(session.attachment("mask.png"), np.uint8)
        mask = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
        if mask is None or mask.shape != inside.shape:
            hint = "give a mask of the images' size"
            raise InputsError(f"{session.path}: its mask does not fit its images; {hint}")
        inside = np.asarray(mask > 127)
    return LightStack(gray, usable, inside, records, gain, folder)


def _lights(inputs: Inputs, stack: LightStack) -> StackLights:
    """Diagnose the images; use the order that the pixels show, without images that are wrong."""
    vectors, near, scale = _listed_lights(inputs.session, stack)
    given = inputs.session.manifest.extra["light_list"].get("stderr_deg")
    stderr_rad = 0.0 if given is None else float(np.radians(np.median(given)))
    alive = np.ones(len(vectors), bool)
    try:
        found = _diagnose(stack, vectors, near=near)
    except PhotometricStereoError as error:
        inputs.assumed.append(f"the lights belong to their images ({error})")
        return StackLights(vectors, near, scale, alive, stderr_rad)
    inputs.assumed += [f"{one.fault}: {one.evidence}; {one.remedy}" for one in found.findings]
    inputs.noted["diagnosis"] = [one.to_json() for one in found.findings]
    corrected = ORDER_FAULTS
    if np.count_nonzero(~found.left_out) >= MIN_KEPT_IMAGES:
        alive, corrected = ~found.left_out, ORDER_FAULTS | LEFT_OUT_FAULTS
    faults = dict.fromkeys(one.fault for one in found.findings if one.fault not in corrected)
    inputs.noted[FAULTS_NOTE] = list(faults)
    return StackLights(vectors[found.order], near, scale, alive, stderr_rad)


def _listed_lights(session: Session, stack: LightStack) -> tuple[Float64Array, bool, float]:
    """Return the list's vectors (N, 3), whether they are positions, and the size of a pixel, mm."""
    listed = session.manifest.extra.get("light_list")
    if not isinstance(listed, dict):
        raise InputsError(
            f"{session.path}: got no light list, expected a session of images under listed lights; "
            "import the images with their list by `skinrig import olat`"
        )
    vectors = np.array(
        [session.rig.light(str(r.index["light"])).position_mm for r in stack.records], np.float64
    )
    return vectors, bool(listed.get("near", False)), float(listed.get("mm_per_px") or 1.0)


def _diagnose(stack: LightStack, vectors: Float64Array, *, near: bool) -> Diagnosis:
    return diagnose_stack(
        stack.gray,
        unit_vectors(vectors),
        usable=stack.usable,
        inside=stack.inside,
        near=near,
        rng=np.random.default_rng(0),
    )


def diagnose_images(session: Session) -> DiagnosedImages:
    """Diagnose the images of a session with a light list.

    Raises
    ------
    InputsError
        If the session has no light list, or fewer than three images.
    PhotometricStereoError
        If its images cannot be judged: too few, or without light.
    """
    assumed: list[str] = []
    stack = _stack(session, assumed)
    vectors, near, _ = _listed_lights(session, stack)
    found = _diagnose(stack, vectors, near=near)
    names = tuple(str(number + 1) for number in range(len(stack.gray)))
    return DiagnosedImages(
        found.findings, names, stack.gray, found, unit_vectors(vectors), tuple(assumed)
    )


def _points_mm(shape: tuple[int, int], mm_per_px: float) -> Float64Array:
    """Return the positions of pixels on the plane through the object's middle, (H, W, 3)."""
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float64)
    x, y = x - (shape[1] - 1) / 2, (shape[0] - 1) / 2 - y
    return np.stack([mm_per_px * x, mm_per_px * y, np.zeros(shape)], axis=-1)


def _estimate(stack: LightStack, lights: StackLights, *, robust: bool) -> NormalMaps:
    alive = slice(None) if lights.alive.all() else lights.alive
    vectors = lights.vectors[alive]
    near: dict[str, Any] = {}
    if lights.near:
        points_mm = _points_mm(stack.inside.shape, lights.mm_per_px)
        near = {"light_positions_mm": vectors, "points_mm": points_mm}
    usable = (stack.usable & stack.inside)[alive]
    return estimate_normals(stack.gray[alive], vectors, valid=usable, robust=robust, **near)


def _roughness_of_field(found: NormalMaps, both: BoolArray) -> float:
    """Measure how far the normals are from a surface's: the median curl of their slopes.

    A height z(x, y) has slopes p = dz/dx, q = dz/dy with dp/dy = dq/dx, hence curl 0.
    """
    z = np.maximum(found.normals[..., 2], 0.1)
    p, q = -found.normals[..., 0] / z, -found.normals[..., 1] / z
    curl = np.abs(np.diff(p, axis=0)[:, :-1] + np.diff(q, axis=1)[:-1])
    inner = both[:-1, :-1] & both[1:, :-1] & both[:-1, 1:]
    return float(np.median(curl[inner])) if inner.any() else float("inf")


def _normals(inputs: Inputs, stack: LightStack, lights: StackLights) -> Mapping[str, Any]:
    """Estimate normals robustly and by least squares; keep the field with the smaller curl."""
    found = {robust: _estimate(stack, lights, robust=robust) for robust in (True, False)}
    both = found[True].valid & found[False].valid
    curl = {robust: _roughness_of_field(maps, both) for robust, maps in found.items()}
    robust = curl[True] <= curl[False]
    inputs.noted["normals"] = {
        "estimator": "robust" if robust else "least squares weighted by intensity",
        "median_curl": {"robust": curl[True], "weighted": curl[False]},
    }
    best = found[robust]
    valid = best.valid
    n = np.where(valid[..., None], best.normals, 0.0)
    # the angle's error is isotropic across the normal: half its variance per tangential axis
    stderr_rad = np.hypot(best.stderr_rad, lights.stderr_rad)
    each = stderr_rad[..., None] / np.sqrt(2.0) * np.sqrt(np.maximum(1.0 - n**2, 0.0))
    relative = best.residual / np.where(valid, best.albedo, 1.0)
    frame = "image frame: x right, y up, z towards the camera"
    misfit = "root mean square misfit over albedo"
    return {
        "normals": masked_map(n, each, valid, MAP_UNITS["normals"], frame),
        "residual": masked_map(relative, None, valid, MAP_UNITS["residual"], misfit),
        "gray_albedo": best,
    }


def _albedo(
    session: Session,
    stack: LightStack,
    lights: StackLights,
    normals: SkinMap,
    gray_albedo: NormalMaps,
) -> SkinMap:
    """Fit each channel's albedo to the samples that are inliers of the gray fit."""
    n, gray = normals.values, gray_albedo
    above, below = np.zeros((), np.float64), np.zeros(stack.inside.shape)
    spread = OUTLIER_SIGMAS * gray.residual + 1e-6 * gray.albedo
    points = _points_mm(stack.inside.shape, lights.mm_per_px) if lights.near else None
    level = 1.0
    if points is not None:
        level = float(np.median(np.linalg.norm(lights.vectors, axis=1))) ** 2
    for number in np.flatnonzero(lights.alive):
        vector = lights.vectors[number]
        if points is None:
            shading = n @ (vector / np.linalg.norm(vector)).astype(np.float32)
        else:
            towards = vector - points
            distance = np.linalg.norm(towards, axis=-1)
            shading = level * np.sum(towards * n, axis=-1) / distance**3
        agrees = np.abs(stack.gray[number] - gray.albedo * shading) <= spread
        good = stack.usable[number] & agrees & (shading > 0.05) & gray.valid
        weight = np.where(good, shading, 0.0)
        values, _ = read_linear(session.read(stack.records[number]))
        above = above + weight[..., None] * values * stack.gain[number, : values.shape[2]]
        below += weight * shading
    valid = gray.valid & (below > 0)
    albedo = above / np.where(valid, below, 1.0)[..., None]
    channels = albedo.shape[2]
    error = np.minimum(gray.stderr_albedo, gray.albedo) * np.sqrt(channels)
    errors = np.broadcast_to(error[..., None], albedo.shape)
    if channels == 1:
        albedo, errors = albedo[..., 0], errors[..., 0]
    what = "over what the lights give a white surface, up to one factor"
    return masked_map(albedo, errors, valid, "1", what)
