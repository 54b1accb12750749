"""Stages of the flash rig: parallel and crossed frames to chromophores and displayed images."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capture.calibration.color import ColorMatrix
from capture.calibration.color.matrix import EXPOSURE_NOTE, EXPOSURE_UNKNOWN, describe_exposure
from capture.calibration.color.matrix import from_calibration as color_matrix_from
from capture.calibration.color.white import WhiteReference
from capture.calibration.polarization import PolarizationCalibration
from capture.calibration.sensor import SensorCalibration
from capture.calibration.store import Calibration
from capture.session import FrameRecord, Session
from model import color_table
from model.color_table import ColorTable, with_exact_optics
from model.skin import MAP_UNITS, SkinMap
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction import polarization, tsumura
from reconstruction.arrays import BoolArray, Float32Array, Float64Array
from reconstruction.chromophores import dark_spots, model_error, shading_prior
from reconstruction.chromophores import posterior as chromophore_posterior
from reconstruction.chromophores.face import estimate_face
from reconstruction.chromophores.pixel_checks import is_detectable
from reconstruction.chromophores.shading_prior import ShadingPrior
from reconstruction.face_light import FaceLight, estimate_face_light
from reconstruction.pipeline import graph as stages
from reconstruction.pipeline.diagnosed_images import collect_images
from reconstruction.pipeline.flash import oxygenation
from reconstruction.pipeline.flash.mean_frames import FlashImage, make_image_reader
from reconstruction.pipeline.flash.pair_diagnosis import diagnose_pair
from reconstruction.pipeline.flash.skin_stage import find_imported_face, skin_stage
from reconstruction.pipeline.inputs import Inputs, InputsError
from reconstruction.pipeline.masked_map import masked_map
from reconstruction.pipeline.skin_tone import maps as tone
from reconstruction.pipeline.skin_tone.maps import SkinReflectance

STAGE_REVISION = 14
"""Grows when the code of a stage changes its result, so that older maps are recomputed."""

MAP_NAMES = (
    *"melanin melanin_optical_depth hemoglobin shading residual gamut_distance "
    "diffuse specular image specular_image "
    "tsumura_melanin tsumura_hemoglobin melanin_noise_stderr hemoglobin_noise_stderr".split(),
    *tone.MAP_NAMES,
    "oxygenation",
    "oxygenation_noise_stderr",
)
"""Maps of a flash session."""


@dataclass(frozen=True, slots=True)
class FlashRig:
    """Session, calibrations and assumed values that the stages read."""

    inputs: Inputs
    sensor: SensorCalibration | None
    white: WhiteReference | None
    polarization: PolarizationCalibration | None
    color: ColorMatrix | None
    neutral: Float64Array | None
    """Camera RGB of a white surface that the color matrix was fitted with."""
    chart_white: Float64Array | None
    """Camera RGB of white in the light and exposure of photographs, by a photograph of a chart."""
    camera: str
    """Name of the spectral sensitivities of the color table."""
    illuminant: str

    @property
    def session(self) -> Session:
        """The session."""
        return self.inputs.session

    @property
    def imported(self) -> bool:
        """Whether the frames are imported photographs."""
        return "photographs" in self.session.manifest.extra

    @property
    def has_white(self) -> bool:
        """Whether a white reference, or a chart in its place, fixes the brightness."""
        return self.white is not None or self.chart_white is not None


def graph(inputs: Inputs) -> list[stages.PipelineStage]:
    """Return the stages of a flash session; see `graph.run_stages`."""
    rig = load_flash_rig(inputs)
    stage = inputs.stage_maker(STAGE_REVISION)
    table = {"camera": rig.camera, "illuminant": rig.illuminant}
    by_color = table | model_error.data_hash()
    which = {"state": inputs.state, "repeat": inputs.repeat}
    of_skin = "melanin melanin_optical_depth hemoglobin shading residual gamut_distance"
    of_skin += " melanin_noise_stderr hemoglobin_noise_stderr face_light"
    shown, face = "image specular_image", find_imported_face(inputs)
    light = "light" if face else "diffuse"
    return [
        stage("frames", "", "parallel crossed", partial(_frames, rig), **which),
        stage(
            "separation", "parallel crossed", f"{light} specular", partial(_separate, rig, light)
        ),
        *([skin_stage(stage, inputs, face)] if face else []),
        stage("chromophores", "diffuse", of_skin, partial(_chromophores, rig), **by_color),
        stage("tsumura", "diffuse", "tsumura_melanin tsumura_hemoglobin", _tsumura),
        stage("pictures", f"{light} specular", shown, partial(_pictures, rig), **table),
        stage(
            "skin reflectance", "diffuse face_light", tone.REFLECTANCE_PRODUCT, _skin_reflectance
        ),
        stage("erythema", "diffuse", "erythema_index", _erythema),
        *tone.tone_stages(
            stage, (rig.color, rig.neutral), refused="" if rig.has_white else NEEDS_WHITE, **table
        ),
        oxygenation.oxygenation_stage(
            stage,
            rig.session,
            partial(make_image_reader, rig.session, rig.sensor),
            rig.white,
            which=which,
            **table,
        ),
    ]


def load_flash_rig(inputs: Inputs) -> FlashRig:
    """Load the inputs of a flash session's stages, and record the assumptions."""
    session = inputs.session
    shots = session.frames("subject", state=inputs.state)
    view = session.rig.view(shots[0].camera) if shots else session.rig.views[0]

    def load(kind: str, otherwise: str) -> Calibration | None:
        return inputs.load(kind, [view.serial], otherwise)

    sensor = load("sensor", "the frames' noise is that of their own noise profiles")
    malus = load("polarization", "the polarizers are perfect")
    matrix = load("color", "images show balanced camera RGB as if it were linear sRGB")
    neutral = matrix.quantity(view.serial, "white_rgb").value if matrix else None
    by_chart = None
    balance = "a white reference would fill 80 % of the range"
    if "photographs" in session.manifest.extra:
        balance = "white is the white balance recorded in the file"
        if matrix is not None and neutral is not None and EXPOSURE_NOTE in matrix.notes:
            by_chart = neutral * _exposure_over_chart(shots, matrix.notes[EXPOSURE_NOTE])
            balance = "white is that of the chart, photographed in the face's place and light"
            balance += " with the same aperture"
    white = load("white", f"the light is even and {balance}")
    illuminant = session.rig.lights[0].illuminant
    inputs.noted["color_table"] = {"camera": view.spectral_sensitivity, "illuminant": illuminant}
    return FlashRig(
        inputs,
        SensorCalibration.from_calibration(sensor, view.serial) if sensor else None,
        WhiteReference.from_calibration(white, view.serial) if white else None,
        PolarizationCalibration.from_calibration(malus, view.serial) if malus else None,
        color_matrix_from(matrix, view.serial) if matrix else None,
        neutral,
        by_chart if white is None else None,
        view.spectral_sensitivity,
        illuminant,
    )


def _exposure_over_chart(shots: Sequence[FrameRecord], of_chart: str) -> float:
    """Return the exposure of photographs over that of the chart; 1 where one is not recorded."""
    own = describe_exposure(shots[0].settings) if shots else EXPOSURE_UNKNOWN
    known = EXPOSURE_UNKNOWN not in (own, of_chart)
    return float(own) / float(of_chart) if known else 1.0


def load_skin_colors(
    camera: str, illuminant: str, *, has_white: bool
) -> tuple[ColorTable, ShadingPrior]:
    """Load the model of skin colors: the color table, and the prior of pixel brightness.

    The table's covariance states what colors differ by where thickness, oxygenation and scattering
    are not those of the model (`model.tissue_optics.uncertainty`).

    Parameters
    ----------
    camera, illuminant
        Names of spectra.
    has_white
        Whether a white reference fixes the exposure.
    """
    table = color_table.build(camera, illuminant, anisotropy=ANISOTROPY_SKIN)
    prior = shading_prior.face_prior()
    return table, prior if has_white else prior.broaden(EXPOSURE_LOG_SD)


def _frames(rig: FlashRig) -> Mapping[str, Any]:
    """Average the repeats of each polarizer state and subtract the dark frames."""
    session, state, repeat = rig.session, rig.inputs.state, rig.inputs.repeat
    mean_image = make_image_reader(rig.session, rig.sensor)
    images: dict[str, FlashImage | None] = {}
    for polarizer in ("parallel", "crossed"):
        which: dict[str, str | int | float] = {"state": state, "polarizer": polarizer}
        if repeat is not None:
            which["repeat"] = repeat
        shots = session.frames("subject", **which)
        images[polarizer] = mean_image(shots) if shots else None
    if images["crossed"] is None:
        crossed = session.frames("subject", polarizer="crossed")
        states = sorted({str(record.index.get("state")) for record in crossed})
        # photographs were imported without a choice of polarizers
        what = "photograph" if rig.imported else "crossed frame"
        there = "none at all: finish it first"
        if states:
            there = f"those of {', '.join(states)}: choose one of them (--state {states[0]})"
        raise InputsError(
            f"{session.path}: has no {what} of state {state!r}; it has {there} [SR-REC-001]"
        )
    _diagnose(rig, images["parallel"], images["crossed"])
    return images


def _diagnose(rig: FlashRig, parallel: FlashImage | None, crossed: FlashImage) -> None:
    """Record faults of a pair of images of one size."""
    groups = []
    if parallel is not None and parallel.rgb.shape == crossed.rgb.shape:
        usable = parallel.valid & crossed.valid
        names = [f"{rig.inputs.state} {polarizer}" for polarizer in ("parallel", "crossed")]
        groups.append(diagnose_pair(parallel.rgb, crossed.rgb, usable, parallel.neutral, names))
    collect_images(groups).record_in(rig.inputs)


def separate_each(rig: FlashRig, records: Sequence[FrameRecord]) -> Iterator[SkinMap]:
    """Yield the diffuse reflectance of each crossed frame alone."""
    mean_image = make_image_reader(rig.session, rig.sensor)
    for record in records:
        yield _separate(rig, "diffuse", None, mean_image([record]))["diffuse"]


def _separate(
    rig: FlashRig, light: str, parallel: FlashImage | None, crossed: FlashImage
) -> Mapping[str, SkinMap]:
    """Separate diffuse and specular reflection, relative to a white reference at the same pixel."""
    white = rig.white
    # diffuse light is unpolarized: the crossed analyzer transmits half of it and, ideally, no
    # specular reflection
    diffuse = FlashImage(2 * crossed.rgb, 4 * crossed.variance, crossed.valid)
    specular = specular_error = np.zeros_like(crossed.rgb)
    specular_valid = np.zeros(crossed.valid.shape, bool)
    if parallel is not None:
        leak = rig.polarization.crossed_leak() if rig.polarization is not None else None
        separated = polarization.separate(
            np.where(parallel.valid[..., None], parallel.rgb, np.nan),
            np.where(crossed.valid[..., None], crossed.rgb, np.nan),
            extinction=None if leak is None else 1.0 / np.maximum(leak, 1e-9),
            variance=(parallel.variance, crossed.variance),
        )
        if separated.stderr is None or separated.stderr_specular is None:
            got = "got an estimate without standard errors"
            raise InputsError(f"separation: {got}, expected some; give it variances")
        specular = separated.specular.astype(np.float32)
        specular_error = separated.stderr_specular.astype(np.float32)
        specular_valid = np.asarray(separated.valid)
        # a highlight that saturates the parallel image leaves the crossed one valid
        alone = (crossed.valid & ~specular_valid)[..., None]
        rgb = np.where(alone, diffuse.rgb, separated.diffuse)
        variance = np.where(alone, diffuse.variance, np.square(separated.stderr))
        diffuse = FlashImage(rgb, variance, crossed.valid)
    if white is not None:
        reflectance, variance, valid = white.balance(diffuse.rgb, variance=diffuse.variance)
        level = white.signal
    else:
        level = np.full_like(diffuse.rgb, _assumed_white(rig))
        reflectance, variance = diffuse.rgb / level, diffuse.variance / level**2
        valid = np.ones(diffuse.valid.shape, bool)
    dim = (reflectance < MIN_SIGNAL_SIGMAS * np.sqrt(variance)).any(axis=-1)
    valid = valid & diffuse.valid & ~dim
    over, shines = "specular light over that of a white reference", specular_valid & valid
    return {
        light: _map3(reflectance, np.sqrt(variance), valid, "white reference in place = 1"),
        "specular": _map3(specular / level, specular_error / level, shines, over),
    }


NEEDS_WHITE = (
    "lab, ita, monk: got a session without a white reference, whose brightness is unknown; "
    "expected a white calibration, or photographs with a color calibration; make one with "
    "`skinrig calibrate white` or `skinrig calibrate color`, then give --calibration"
)
"""Reason for a refusal."""
MIN_SIGNAL_SIGMAS = 5.0
"""Signal-to-noise ratio below which a pixel is background, not skin."""
ASSUMED_WHITE_LEVEL = 0.8
"""Fraction of the range that a white reference is assumed to fill without a calibration."""


def _assumed_white(rig: FlashRig) -> Float32Array:
    if rig.chart_white is not None:  # as the diffuse light, twice that of one polarization
        return np.asarray(2.0 * rig.chart_white, np.float32)
    record = rig.session.frames("subject", state=rig.inputs.state)[0]
    neutral = rig.session.read(record).neutral
    level = np.full(3, ASSUMED_WHITE_LEVEL)
    if neutral is not None:
        level = ASSUMED_WHITE_LEVEL * np.asarray(neutral, float) / max(neutral)
    return level.astype(np.float32)


def _map3(values: NDArray[Any], stderr: NDArray[Any], valid: BoolArray, what: str) -> SkinMap:
    good = valid & np.isfinite(values).all(axis=-1) & np.isfinite(stderr).all(axis=-1)
    return masked_map(values, stderr, good, "1", f"camera RGB, {what}")


def map_stderr(skin_map: SkinMap) -> Float32Array:
    """Return a map's standard error; 0 where it has none."""
    return np.zeros_like(skin_map.values) if skin_map.stderr is None else skin_map.stderr


def _skin_reflectance(diffuse: SkinMap, face_light: FaceLight) -> SkinReflectance:
    """Divide the diffuse light by the light on each pixel."""
    light = face_light.log_light, face_light.log_variance, face_light.valid
    return SkinReflectance.of_map(diffuse).in_light(*light)


def _erythema(diffuse: SkinMap) -> SkinMap:
    return tone.erythema_map(SkinReflectance.of_map(diffuse))


def _chromophores(rig: FlashRig, diffuse: SkinMap) -> Mapping[str, SkinMap | FaceLight]:
    has_white = rig.has_white
    table, prior = load_skin_colors(rig.camera, rig.illuminant, has_white=has_white)
    rgb = np.where(diffuse.mask[..., None], diffuse.values, np.nan)
    variance = np.square(map_stderr(diffuse))
    errors = model_error.image_covariance(diffuse.values, variance, diffuse.mask)
    part = rig.inputs.compute_part
    given: dict[str, Any] = {"prior": prior, "variance": variance, "model_error": errors}
    whole = estimate_face(rgb, table, **given, has_white=has_white, compute_part=part)
    found, by_face = whole.found, whole.by_face
    plain = np.exp(-whole.log_color)
    by_noise = partial(
        chromophore_posterior.estimate,
        rgb * plain,
        with_exact_optics(table),
        prior=prior,
        variance=variance * plain**2,
    )
    noise_alone = part("errors by noise", lambda: by_noise(face=whole.face))
    # the face's prior does not apply to moles, lips and eyelids, which can be other skin
    if whole.face is not None:
        of_spots = part("errors by noise in spots", lambda: by_noise(valid=whole.spots))
        noise_alone = dark_spots.average_hypotheses(noise_alone, of_spots, whole.spots)
    usable = found.valid

    def chromophore(name: str) -> dict[str, SkinMap]:
        error, unit = f"stderr_{name}", MAP_UNITS[name]
        noise = getattr(noise_alone, error)
        # spots have wide intervals by design, so they must not enter their neighborhood's average
        usual, usual_error = getattr(by_face, name), getattr(by_face, error)
        good = is_detectable(usual, usual_error, usable & np.isfinite(noise))
        values, stderr = getattr(found, name), getattr(found, error)
        why = "invalid where noise and model error leave it unknown"
        if name == "melanin":
            why += f"; for an epidermis of {table.constants.epidermis_mm} mm"
        alone = "standard error by noise alone, without model error"
        return {
            name: masked_map(values, stderr, good, unit, why),
            name + NOISE_STDERR_SUFFIX: masked_map(noise, None, good, unit, alone),
        }

    what = "relative distance of the color from the model's gamut"
    of_melanin = chromophore("melanin")
    factor = np.float32(table.constants.melanin_depth_factor)
    presumed = of_melanin["melanin"]
    return {
        "face_light": estimate_face_light(whole, rgb),
        **of_melanin,
        "melanin_optical_depth": masked_map(
            factor * presumed.values,
            factor * map_stderr(presumed),
            presumed.mask,
            MAP_UNITS["melanin_optical_depth"],
            "at 550 nm: volume fraction times thickness times absorption, whatever the thickness",
        ),
        **chromophore("hemoglobin"),
        "shading": masked_map(found.shading, None, usable),
        "residual": masked_map(found.residual, None, usable),
        "gamut_distance": SkinMap(np.nan_to_num(found.gamut_distance), "1", description=what),
    }


NOISE_STDERR_SUFFIX = "_noise_stderr"
"""Suffix of the maps of standard errors by noise alone."""
EXPOSURE_LOG_SD = 1.0
"""Standard deviation of log exposure without a white reference."""


def _tsumura(diffuse: SkinMap) -> Mapping[str, SkinMap]:
    valid = diffuse.mask & (diffuse.values > 0).all(axis=-1)
    found = tsumura.tsumura_ica(diffuse.values, valid)
    note = "independent component of optical density, no absolute scale"
    return {
        f"tsumura_{name}": masked_map(getattr(found, name), None, found.valid, "1", note)
        for name in ("melanin", "hemoglobin")
    }


def _pictures(rig: FlashRig, specular: SkinMap, **diffuse: SkinMap) -> Mapping[str, SkinMap]:
    """Convert diffuse and specular light to linear sRGB."""
    (light,) = diffuse.values()
    picture = light.values.astype(np.float64)
    if rig.color is not None and rig.neutral is not None:
        picture = rig.color.to_linear_srgb(picture * rig.neutral)
    return {
        "image": SkinMap(picture.astype(np.float32), "1", valid=light.valid),
        "specular_image": SkinMap(specular.values, "1", valid=specular.valid),
    }
