"""Calibrate sensor, lights and polarization of a gradient sphere from sessions of its targets."""

from collections import defaultdict
from collections.abc import Iterator, Sequence

import numpy as np

from capture.calibration.fiber.spot_photometry import SpotImage, make_spot_image
from capture.calibration.led_sphere.glass_ball import GlassBall
from capture.calibration.led_sphere.survey import SphereSurvey, survey_sphere
from capture.calibration.record import Quantity
from capture.raw import RawFrame
from capture.session import FrameRecord, Session
from skinrig.arrays import Float32Array, Float64Array
from skinrig.calibrating.outcome import (
    CalibratingError,
    CalibrationResult,
    TargetSessions,
    number_findings,
    photon_transfer,
)

GRADIENT_CALIBRATION_KINDS = ("sensor", "lights", "polarization")
GradientSurveys = dict[tuple[str, ...], tuple[SphereSurvey, tuple[str, ...]]]
"""Surveys and their notes by the content hashes of the ball's sessions."""
ANALYZER_READING_DEG = {"parallel": 0.0, "crossed": 90.0}
"""Reading of the analyzer, degrees, in each of its named settings."""


def has_gradient_session(sessions: Sequence[Session]) -> bool:
    """Return whether any session was captured in a gradient sphere."""
    return any("gradient_sphere" in session.rig.boxes for session in sessions)


def calibrate_gradient(
    kind: str, sessions: TargetSessions, surveys: GradientSurveys | None = None
) -> CalibrationResult:
    """Estimate the calibration "sensor", "lights" or "polarization" of a gradient sphere.

    Parameters
    ----------
    kind
        One of :data:`GRADIENT_CALIBRATION_KINDS`.
    sessions
        For "sensor", sessions of the flat field; otherwise one session of the black glass ball.
        Light intensities are corrected by the flat field of the folder's sensor calibration.
    surveys
        Surveys of earlier calls with the same sensor calibration; a new one is added. "lights" and
        "polarization" are results of one survey.

    Raises
    ------
    CalibratingError
        When required frames are missing, or are of several rigs or cameras.
    BallError, PolarizationError
        When the frames of the ball do not determine the result.
    """
    rigs = {session.rig.name for session in sessions.sessions}
    if len(rigs) != 1 or len(sessions.serials) != 1:
        raise CalibratingError(
            f"sessions: got rigs {sorted(rigs)} with cameras {sorted(sessions.serials)}, expected"
            " one rig with one camera; calibrate each separately"
        )
    if kind not in GRADIENT_CALIBRATION_KINDS:
        known = ", ".join(GRADIENT_CALIBRATION_KINDS)
        raise CalibratingError(f"kind: got {kind!r}, expected {known} for rig {rigs.pop()!r}")
    if kind == "sensor":
        return _sensor(sessions)
    surveys = {} if surveys is None else surveys
    contents = tuple(session.content_hash for session in sessions.sessions)
    if contents not in surveys:
        surveys[contents] = _survey(sessions)
    survey, notes = surveys[contents]
    findings = (*survey.findings, *notes)
    about = {"notes": number_findings(findings), **sessions.provenance()}
    if kind == "lights":
        made = survey.lights.to_calibration(ball=_ball_quantities(survey), **about)
        return CalibrationResult(made, _lights_summary(survey), findings)
    made = survey.polarizers.to_calibration(serial=sessions.rig.views[0].serial, **about)
    return CalibrationResult(made, _polarizer_summary(survey), findings)


def _survey(sessions: TargetSessions) -> tuple[SphereSurvey, tuple[str, ...]]:
    with_ball = {session.id for _, session in sessions.require_frames("gradient", "ball")}
    if len(with_ball) > 1:
        raise CalibratingError(
            f"sessions: got {len(with_ball)} of the ball, expected one, because the ball moves"
            " between sessions; name one of them"
        )
    flat, notes = _flat_field(sessions)
    shots = tuple(_shots(sessions, flat))
    if not shots:
        raise CalibratingError(
            "sessions: got no frames of the ball under pattern 'full' at a level above 0; capture"
            " the whole plan of `--target ball`"
        )
    view = sessions.rig.views[0].name
    return survey_sphere(shots, sessions.rig, view=view, target=GlassBall()), notes


def _shots(sessions: TargetSessions, flat: Float64Array | float) -> Iterator[SpotImage]:
    """Yield the exposures of the lit ball, minus the mean dark frame of the same exposure time."""
    darks: dict[float, list[Float32Array]] = defaultdict(list)
    lit: list[tuple[FrameRecord, Session]] = []
    for record, session in sessions.require_frames("gradient", "ball"):
        if record.settings.get("pattern") == "dark":
            darks[float(record.settings["exposure_s"])].append(_above_black(session.read(record)))
        elif record.settings.get("pattern") == "full" and float(record.settings["level"]) > 0:
            lit.append((record, session))
    means: dict[float, Float32Array] = {
        time: np.mean(stack, axis=0, dtype=np.float32) for time, stack in darks.items()
    }
    for record, session in lit:
        frame = session.read(record)
        exposure_s = float(record.settings["exposure_s"])
        dark = means.get(exposure_s)
        count = len(darks[exposure_s])
        # noise profile: variance = scale * signal + offset; the mean of n darks has offset / n
        offset = 0.0 if frame.noise_profile is None else frame.noise_profile[1]
        yield make_spot_image(
            frame,
            amount_s=_light_s(record),
            reading_deg=_reading_deg(record),
            dark=0.0 if dark is None else dark,
            dark_variance=offset / count if count else 0.0,
            flat=flat,
        )


def _above_black(frame: RawFrame) -> Float32Array:
    black = np.float32(frame.black[0])
    return (frame.cfa.astype(np.float32) - black) / (np.float32(frame.white) - black)


def _light_s(record: FrameRecord) -> float:
    """Return the exposure, s, at full level that gives the same light as the frame's."""
    return float(record.settings["level"]) * float(record.settings["exposure_s"])


def _reading_deg(record: FrameRecord) -> float:
    reading = record.settings.get("analyzer_deg")
    if reading is not None:
        return float(reading)
    return ANALYZER_READING_DEG[str(record.settings["polarizer"])]


def _flat_field(sessions: TargetSessions) -> tuple[Float64Array | float, tuple[str, ...]]:
    """Return the camera's flat field from the folder's sensor calibration, or 1 and a note."""
    known = sessions.sensor()
    if known is None:
        return 1.0, (
            "the folder has no sensor calibration: intensities include the lens's shading;"
            " calibrate sensor first",
        )
    view = sessions.rig.views[0]
    return known.flat_mosaic(view.height_px, view.width_px), ()


def _sensor(sessions: TargetSessions) -> CalibrationResult:
    flats = [
        (_light_s(record), of.read(record))
        for record, of in sessions.require_frames("gradient", "flat")
    ]
    darks = [
        (float(record.settings["exposure_s"]), of.read(record))
        for record, of in sessions.require_frames("gradient", "dark")
    ]
    result = photon_transfer(flats, darks)
    made = result.to_calibration(serial=sessions.rig.views[0].serial, **sessions.provenance())
    rows = []
    for name, quantity, scale, unit in (
        ("gain", result.gain_e_per_dn, 1.0, "e/DN"),
        ("read noise", result.read_noise_e, 1.0, "e"),
        ("full well", result.full_well_e, 1.0, "e"),
        ("spread of the pixels' responses", result.prnu, 100.0, "%"),
    ):
        error = 0.0 if quantity.stderr is None else scale * float(quantity.stderr[0])
        rows.append((name, f"{scale * float(quantity.value[0]):.4g} ± {error:.2g} {unit}"))
    return CalibrationResult(made, tuple(rows))


def _ball_quantities(survey: SphereSurvey) -> dict[str, Quantity]:
    error = np.sqrt(np.diag(survey.ball.covariance_mm2))
    return {
        "center_mm": Quantity(survey.ball.center_mm, error[:3]),
        "radius_mm": Quantity(np.array(survey.ball.radius_mm), np.array(error[3])),
    }


def _lights_summary(survey: SphereSurvey) -> tuple[tuple[str, str], ...]:
    table, ball = survey.lights, survey.ball
    error = np.sqrt(np.diag(ball.covariance_mm2))
    center = ", ".join(f"{c:+.3f} ± {e:.3f}" for c, e in zip(ball.center_mm, error, strict=False))
    angle = np.degrees(np.linalg.norm(table.directions_stderr, axis=1))[table.seen]
    shining = table.valid & ~table.dead
    relative = 100 * (table.intensities_stderr / np.maximum(table.intensities, 1e-9))[shining]
    return (
        ("ball's middle", f"{center} mm"),
        ("ball's radius", f"{ball.radius_mm:.3f} ± {error[3]:.3f} mm"),
        ("lights seen", f"{int(table.seen.sum())} of {len(table.names)}"),
        ("lights off their places", f"{survey.light_scatter_mm:.2f} mm"),
        (
            "standard error of a direction",
            f"median {np.median(angle):.3f}°, worst {angle.max():.3f}°",
        ),
        (
            "intensities measured",
            f"{int(shining.sum())}, standard deviation"
            f" {100 * np.std(table.intensities[shining]):.1f} %",
        ),
        (
            "standard error of an intensity",
            f"median {np.median(relative):.2f} %, worst {relative.max():.1f} %",
        ),
    )


def _polarizer_summary(survey: SphereSurvey) -> tuple[tuple[str, str], ...]:
    fit = survey.polarizers
    zero, error = np.degrees([fit.misalignment_rad, fit.misalignment_stderr_rad])
    leaked, glass = fit.leakage, fit.glass_leakage[fit.valid]
    low = f"9 of 10 lights below {100 * np.quantile(leaked, 0.9):.2f} %"
    rows = {
        "analyzer's misalignment": f"{zero:+.3f}° ± {error:.3f}°",
        "extinction of the lights' films": _extinction(fit.light_leak, fit.light_leak_stderr),
        "extinction of the analyzer": _extinction(fit.analyzer_leak, fit.analyzer_leak_stderr),
        "lights' polarizers off their axes": f"{np.degrees(survey.turn_scatter_rad):.2f}°",
        "glass leaks crossed": f"median {100 * np.median(glass):.2f} %,"
        f" highest {100 * glass.max():.1f} % of parallel",
        f"skin (eta {fit.eta:g}) will leak": f"median {100 * np.median(leaked):.3f} %, {low}",
        "readings of the analyzer": ", ".join(f"{r:g}" for r in survey.readings_deg),
    }
    return tuple(rows.items())


def _extinction(leak: float, stderr: float) -> str:
    return f"{1 / leak:.0f} : 1 (leak {leak:.2e} ± {stderr:.0e})"
