"""Estimate calibrations from sessions of targets and save them in CALIBRATION/."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

import numpy as np

from capture import raw
from capture.calibration import polarization, store
from capture.calibration.color import chart, colorimetry, white
from capture.calibration.color import matrix as color
from capture.calibration.fiber.phantom import read_certificate
from capture.session import FrameRecord, Session
from skinrig.arrays import Float32Array
from skinrig.calibrating import dome, gradient, probe, white_reference
from skinrig.calibrating.outcome import (
    CalibratingError,
    CalibrationResult,
    TargetSessions,
    photon_transfer,
)
from skinrig.console import select_attributes
from skinrig.errors import require_choice

CALIBRATION_KINDS = (
    "sensor",
    "color",
    "polarization",
    "white",
    *dome.DOME_CALIBRATION_KINDS,
    probe.FIBER_CALIBRATION_KIND,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SavedCalibration(CalibrationResult):
    """A saved calibration and its drift from the one that it replaced."""

    path: Path
    drift: tuple[store.CalibrationDrift, ...]


def calibrate(
    kind: str,
    sessions: Sequence[str | Path],
    out: str | Path,
    *,
    created: date | None = None,
    targets: dome.DomeTargets | None = None,
    phantom: str | Path | None = None,
    surveys: gradient.GradientSurveys | None = None,
) -> SavedCalibration:
    """Estimate one kind of calibration from target sessions and save it.

    Parameters
    ----------
    kind
        One of :data:`CALIBRATION_KINDS`.
    sessions
        Folders; frames of all of them are pooled. They must come from one camera, those of a
        dome's "geometry" and "lights" from one rig.
    out
        The CALIBRATION/ folder. An older calibration of the kind is replaced, and the drift
        between the two is reported.
    created
        Date of the calibration; None: that of the latest session.
    targets
        Sizes of the targets in the dome.
    phantom
        Certificate of the phantom that a probe's "fiber" was measured on; None: that of the
        simulated phantom, for simulated sessions only.
    surveys
        Of a gradient sphere: see `skinrig.calibrating.gradient.calibrate_gradient`.

    Raises
    ------
    CalibratingError
        When a needed kind of frame is missing, or the sessions come from several cameras.
    NoWhiteReferenceError
        When the frames for "white" do not show a white reference.
    """
    require_choice("kind", kind, CALIBRATION_KINDS, CalibratingError)
    opened = [Session.open(path) for path in sessions]
    if not opened:
        raise CalibratingError(
            "sessions: got none, expected at least one folder; name it [SR-CAL-009]"
        )
    made_on = created or max(s.manifest.created_at.date() for s in opened)
    given = TargetSessions(opened, Path(out), made_on)
    if kind == probe.FIBER_CALIBRATION_KIND:
        paper = None if phantom is None else read_certificate(phantom)
        made = probe.calibrate_probe(given, certificate=paper)
    elif gradient.has_gradient_session(opened):
        made = gradient.calibrate_gradient(kind, given, surveys)
    elif kind in dome.DOME_CALIBRATION_KINDS:
        made = dome.calibrate_dome(kind, given, targets=targets)
    else:
        frames = _Frames(given)
        calibration = _CALIBRATION_MAKERS[kind](frames)
        made = CalibrationResult(calibration, tuple(_summary(calibration)), tuple(frames.findings))
    drift: tuple[store.CalibrationDrift, ...] = ()
    try:
        drift = store.measure_drift(store.load(out, kind), made.calibration)
    except store.CalibrationMissing:
        pass
    Path(out).mkdir(parents=True, exist_ok=True)
    path = store.save(made.calibration, out)
    return SavedCalibration(
        **select_attributes(made, "calibration", "summary", "findings"), path=path, drift=drift
    )


Shots = list[tuple[FrameRecord, raw.RawFrame]]


class _Frames:
    """The frames of one camera in several sessions."""

    def __init__(self, targets: TargetSessions) -> None:
        self._targets = targets
        self.rig = targets.rig
        self.imported = targets.imported
        self.developed = any(s.manifest.has_developed_images for s in targets.sessions)
        serials = sorted(targets.serials)
        if len(serials) != 1:
            some = ", ".join(serials[:3]) + (", ..." if len(serials) > 3 else "")
            raise CalibratingError(
                f"cameras: got {len(serials)} ({some}), expected one: give sessions of one camera; "
                "a dome needs `calibrate geometry` and `calibrate lights` only [SR-CAL-004]"
            )
        self.about = {"serial": serials[0], **targets.provenance()}
        self.findings: list[str] = []

    def require_frames(self, kind: str, **index: str | int | float) -> Shots:
        """Return records with their raw frames; raise if there are none."""
        found = self._targets.require_frames("flash", kind, **index)
        return [(record, session.read(record)) for record, session in found]

    def led_names(self) -> list[str]:
        """Return the names of the narrow-band LEDs that subjects or targets were lit with."""
        found = self._targets.frames("subject")
        return sorted({str(r.index["light"]) for r, _ in found if "light" in r.index})

    def read_setting(self, record: FrameRecord, name: str) -> float:
        """Return a numeric setting that a frame was captured with."""
        try:
            return float(record.settings[name])
        except KeyError:
            raise CalibratingError(
                f"sessions: frame {record.step_id} of rig {self.rig.name!r} lacks its {name};"
                " imported photographs have none: capture the target with the rig"
                " (`skinrig capture flash --target ...`)"
            ) from None

    def dark_level(self) -> Float32Array | float:
        """Return the mean dark signal above the black level, (h, w, 3); 0 without dark frames."""
        found = self._targets.frames("dark")
        darks = [
            image.rgb
            for image in _linear(
                [(r, session.read(r)) for r, session in found], developed=self.developed
            )
        ]
        return np.mean(darks, axis=0, dtype=np.float32) if darks else 0.0


def _linear(shots: Shots, *, developed: bool = False) -> list[raw.LinearImage]:
    """Return linear camera RGB of frames at half the sensor's resolution."""
    # a developed image has one cell per pixel
    demosaic: raw.Demosaic = "superpixel" if developed else "centered"
    return [raw.linear_rgb(frame, demosaic=demosaic) for _, frame in shots]


def _sensor(frames: _Frames) -> store.Calibration:
    flats = [
        (frames.read_setting(record, "power"), frame)
        for record, frame in frames.require_frames("flat")
    ]
    darks = [
        (frames.read_setting(record, "exposure_s"), frame)
        for record, frame in frames.require_frames("dark")
    ]
    result = photon_transfer(flats, darks)
    return result.to_calibration(**frames.about)


def _white(frames: _Frames) -> store.Calibration:
    dark = frames.dark_level()
    shots = frames.require_frames("subject", polarizer="crossed")
    powers = _powers(frames, shots)
    linear = _linear(shots)
    for (record, _), image in zip(shots, linear, strict=True):
        what = f"frame {record.step_id} of state {record.index.get('state')!r}"
        frames.findings += white_reference.check_white_reference(
            image.rgb - dark, image.valid, what
        )
    leds = {}
    for led in frames.led_names():
        under = frames.require_frames("subject", light=led)
        gray = [_sum_channels(image, dark) for image in _linear(under)]
        leds[led] = _reference(_powers(frames, under), gray)
    balanced = [replace(image, rgb=image.rgb - dark) for image in linear]
    reference = replace(_reference(powers, balanced), leds=leds)
    return reference.to_calibration(**frames.about)


def _sum_channels(image: raw.LinearImage, dark: Float32Array | float) -> raw.LinearImage:
    """Return the sum of the channels without the dark signal, (H, W, 1)."""
    total = (image.rgb - dark).sum(axis=-1, keepdims=True)
    return replace(image, rgb=total, variance=image.variance.sum(axis=-1, keepdims=True))


def _powers(frames: _Frames, shots: Shots) -> list[float]:
    return [frames.read_setting(record, "power") for record, _ in shots]


def _reference(powers: list[float], images: Sequence[raw.LinearImage]) -> white.WhiteReference:
    """Return the white reference of crossed images without their dark signal."""
    # The reference depolarizes: its diffuse light D splits evenly over both polarizations, so the
    # crossed image is D / 2. Hence D = 2 I_crossed, and var(D) = 4 var(I_crossed).
    return white.white_reference(
        [2.0 * image.rgb for image in images],
        variances=[4.0 * image.variance for image in images],
        valid=[image.valid for image in images],
        lights=powers,
        reflectance=WHITE_REFERENCE_REFLECTANCE,
        # no smooth fit: the gain of each pixel (PRNU) must cancel in the ratio to the reference
        degree=None,
    )


WHITE_REFERENCE_REFLECTANCE = 0.99
"""Reflectance of the white reference (pressed PTFE or similar) from 400 to 700 nm."""


def _color(frames: _Frames) -> store.Calibration:
    dark = frames.dark_level()
    shots = frames.require_frames("chart", polarizer="crossed")
    linear = _linear(shots, developed=frames.developed)
    image = np.mean([each.rgb - dark for each in linear], axis=0)
    valid = np.logical_and.reduce([each.valid for each in linear])
    centers = chart.find_chart(image)
    patches = chart.measure_patches(image, centers, valid=valid)
    neutral = color.neutral_white(patches.rgb, valid=patches.valid)
    illuminant = frames.rig.lights[0].illuminant
    fit = color.fit_matrix(
        patches.rgb,
        colorimetry.chart_reference(illuminant),
        illuminant=illuminant,
        white=neutral.value,
        valid=patches.valid,
    )
    exposure = None
    if frames.imported:
        of_shots = {color.describe_exposure(record.settings) for record, _ in shots}
        if len(of_shots) > 1:
            raise CalibratingError(
                f"chart photographs: got exposures {', '.join(sorted(of_shots))} s ISO, expected "
                "one; import those of one exposure"
            )
        exposure = of_shots.pop()
    return color.to_calibration(fit, neutral, exposure=exposure, **frames.about)


def _polarization(frames: _Frames) -> store.Calibration:
    dark = frames.dark_level()
    shots = frames.require_frames("malus")
    angles = np.deg2rad([frames.read_setting(record, "analyzer_deg") for record, _ in shots])
    linear = _linear(shots)
    images = [each.rgb - dark for each in linear]
    valid = np.logical_and.reduce([each.valid for each in linear])
    chosen = polarization.find_modulated_pixels(angles, images, valid=valid)
    count = int(np.count_nonzero(chosen))
    if not count:
        raise CalibratingError(
            "malus frames: no pixel follows the analyzer; capture bare rough metal [SR-CAL-003]"
        )
    # mean over n independent pixels: its variance is sum(var) / n^2
    mean = np.array([image[chosen].mean(axis=0) for image in images])
    variance = np.array([p.variance[chosen].sum(axis=0) for p in linear]) / count**2
    fit = polarization.fit_malus(angles, mean, variance=variance)
    result = polarization.PolarizationCalibration.from_fit(fit, ("R", "G", "B"))
    return result.to_calibration(**frames.about)


_CALIBRATION_MAKERS: dict[str, Callable[[_Frames], store.Calibration]] = {
    "sensor": _sensor,
    "color": _color,
    "polarization": _polarization,
    "white": _white,
}


def _summary(calibration: store.Calibration) -> list[tuple[str, str]]:
    rows = []
    for serial, quantities in calibration.values.items():
        for name, quantity in quantities.items():
            if quantity.value.size > 9:
                continue
            value = ", ".join(f"{v:.5g}" for v in quantity.value.ravel())
            if quantity.stderr is not None:
                value += "  ± " + ", ".join(f"{v:.2g}" for v in quantity.stderr.ravel())
            rows.append((f"{serial} {name}", value))
    return rows
