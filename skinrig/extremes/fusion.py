"""Extremes of the fusion: rigs without overlap, contradictions, noise, sizes of the texture."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from model.tissue_optics.constants import SKIN_CONSTANTS
from reconstruction.fusion.consistency import check_rigs, name_faulty_rig
from reconstruction.fusion.patch_normals import check_patch
from reconstruction.fusion.regions import summarize_regions
from reconstruction.fusion.signals import FusionError, RigBands
from reconstruction.fusion.texels import RigColors, TexelSkin, estimate_texels
from skinrig.arrays import BoolArray, Float64Array
from skinrig.benchmarks.fusion.people import RIGS, DrawnFace, draw_face, draw_patch
from skinrig.benchmarks.resident_memory import track_peak
from skinrig.extremes.expectations import (
    ExpectationError,
    expect_error,
    expect_finite,
    expect_near,
    expect_valid_fraction,
    expect_within,
)
from skinrig.extremes.inputs import InputPrecision
from skinrig.fusing.maps import estimate_maps
from skinrig.fusing.measurements import Measurements
from skinrig.fusing.texel_colors import Texels

_DEPTH_FACTOR = SKIN_CONSTANTS.melanin_depth_factor
PERSON_SEED = 400
FACE_TEXELS = 800


@cache
def _face(texels: int = FACE_TEXELS) -> DrawnFace:
    return draw_face("III", PERSON_SEED, texels=texels)


def _colors(real: InputPrecision, face: DrawnFace) -> list[RigColors]:
    """Return the colors of both rigs, rounded to a precision."""
    return [replace(c, log_rgb=np.asarray(real(c.log_rgb), np.float64)) for c in face.colors]


def _estimate(face: DrawnFace, colors: Sequence[RigColors]) -> TexelSkin:
    labels = np.zeros(len(face.log_skin), np.intp)
    regions, _ = summarize_regions(colors, labels, face.errors)
    person = face.estimate_person(regions)
    ((_, found),) = estimate_texels(person, colors, face.errors)
    return found


def _expect_covered(face: DrawnFace, found: TexelSkin, chosen: BoolArray) -> str:
    """Check the mean error of log melanin optical depth of texels, in standard errors."""
    # the fraction follows from the optical depth by the kind of melanin: its error is contained
    off = found.log_skin[chosen, 0] - face.log_skin[chosen, 0]
    off = off - np.log(_DEPTH_FACTOR)
    sd = np.sqrt(found.log_melanin_variance[chosen])
    return expect_within(off.mean() / sd.mean(), -3.0, 3.0, label="standard errors of melanin")


def _no_overlap(real: InputPrecision) -> str:
    face = _face()
    left = np.arange(FACE_TEXELS) < FACE_TEXELS // 2
    none = np.arange(FACE_TEXELS) % 10 == 0
    dome, flash = _colors(real, face)
    colors = [replace(dome, valid=left & ~none), replace(flash, valid=~left & ~none)]
    found = _estimate(face, colors)
    expect_near(found.valid[none].any(), False)
    expect_valid_fraction(found.valid[~none], fraction_range=(0.99, 1.0))
    _expect_covered(face, found, left & ~none)
    return _expect_covered(face, found, ~left & ~none)


def _contradiction(real: InputPrecision) -> str:
    face = _face()
    dome, flash = _colors(real, face)
    balance = np.array([0.3, 0.0, -0.3])
    colors = [
        replace(dome, log_rgb=dome.log_rgb + balance),
        replace(flash, log_rgb=flash.log_rgb - balance),
    ]
    regions, _ = summarize_regions(colors, np.zeros(FACE_TEXELS, np.intp), face.errors)
    person = face.estimate_person(regions)
    named = name_faulty_rig(check_rigs(RIGS, regions, face.errors, person))
    if named is None or named.rig not in ("dome", "flash"):
        raise ExpectationError(f"got {named}, expected dome or flash")
    return f"{named.rig} is named"


def _single_frame(real: InputPrecision) -> str:
    face = _face()
    dome, flash = _colors(real, face)
    rng = np.random.default_rng(PERSON_SEED)
    noisy = dome.log_rgb + 0.9 * rng.standard_normal(dome.log_rgb.shape)
    wide = dome.covariance + 0.9**2 * np.eye(3)
    alone = _estimate(face, [flash])
    both = _estimate(face, [replace(dome, log_rgb=noisy, covariance=wide), flash])
    sd = np.sqrt(alone.log_melanin_variance)
    change = np.median(np.abs(both.log_skin - alone.log_skin)[:, 0] / sd)
    return expect_within(change, 0.0, 1.0 / 3.0, label="standard errors of change")


@dataclass(frozen=True, slots=True, eq=False)
class _TextureColors:
    """Colors of a texture that has them at its first texels."""

    bands: RigBands
    calibration: Float64Array
    valid: BoolArray
    face_colors: RigColors

    def colors(self, rig: int, texels: Texels) -> RigColors:
        """Return the colors of some texels."""
        numbers = np.arange(len(self.valid), dtype=np.int64)[texels]
        inside = np.minimum(numbers, len(self.face_colors.valid) - 1)
        one = self.face_colors
        known = numbers < len(one.valid)
        return RigColors(
            rig, one.log_rgb[inside], one.covariance[inside], known, one.brightness_variance
        )


def _texture(real: InputPrecision, face: DrawnFace, side: int) -> Measurements:
    valid = np.zeros(side * side, bool)
    valid[: len(face.log_skin)] = True
    colors = []
    for k, (bands, one) in enumerate(zip(RIGS[:2], _colors(real, face), strict=True)):
        at = slice(3 * k, 3 * k + 3)
        colors.append(_TextureColors(bands, face.errors.calibration[at, at], valid, one))
    return Measurements(tuple(colors), (side, side))


def _small_texture(real: InputPrecision) -> str:
    face = _face(64 * 64)
    measured = _texture(real, face, 64)
    person, errors = measured.estimate_person()
    maps, _ = estimate_maps(measured, person, errors)
    melanin = maps["melanin"]
    expect_valid_fraction(melanin.mask, fraction_range=(0.99, 1.0))
    true = np.median(np.exp(face.log_skin[:, 0]))
    off = (np.median(melanin.values) - true) / np.median(np.asarray(melanin.stderr))
    return expect_within(off, -3.0, 3.0, label="standard errors of melanin")


def _large_texture(real: InputPrecision) -> str:
    face, side = _face(4096), 8192
    with track_peak() as peak:
        measured = _texture(real, face, side)
        person, errors = measured.estimate_person()
        maps, _ = estimate_maps(measured, person, errors)
        good = maps["r_d"].mask
    expect_near(int(good.sum()), 4096)
    expect_finite(maps["r_d"].values[good], np.ones((4096, 3), bool), label="R_d")
    return "not measured" if peak.mb is None else expect_within(peak.mb, 0.0, 1000.0, label="MB")


def _no_color(real: InputPrecision) -> str:
    face = _face()
    colors = [replace(c, valid=np.zeros(FACE_TEXELS, bool)) for c in _colors(real, face)]
    return expect_error(lambda: _estimate(face, colors), FusionError, "region")


def _turned_normals(real: InputPrecision) -> str:
    patch = draw_patch(np.random.default_rng(PERSON_SEED), rotation_deg=90.0)
    check = check_patch(replace(patch, normals=real(patch.normals)))
    expect_within(check.probability, 0.9, 1.0, label="probability")
    return expect_within(abs(np.degrees(check.rotation_rad)), 85.0, 90.0, label="degrees")
