"""Calibrate spots, gains and cross-talk of a fiber probe from a session on a phantom."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from capture.calibration.fiber.darks import CameraNoise, DarkModel, measure_darks
from capture.calibration.fiber.gains import calibrate_fibers
from capture.calibration.fiber.merge import MergedSeries, merge_series
from capture.calibration.fiber.phantom import PhantomCertificate
from capture.calibration.fiber.probe_calibration import FiberCalibration
from capture.calibration.fiber.readings import FiberReadings, sum_spots
from capture.calibration.fiber.spots import find_fiber_spots
from capture.session import FrameRecord, Session
from skinrig.calibrating.outcome import (
    CalibratingError,
    CalibrationResult,
    TargetSessions,
    number_findings,
)
from skinrig.calibrating.phantom_reflectance import expected_reflectance, packaged_certificate

FIBER_CALIBRATION_KIND: Final = "fiber"
MIN_HEALTHY_GAIN: Final = 0.5
"""Fraction of the median gain below which a fiber is reported."""


def calibrate_probe(
    sessions: TargetSessions, certificate: PhantomCertificate | None = None
) -> CalibrationResult:
    """Estimate the calibration "fiber" of a probe from a session of target "phantom".

    Parameters
    ----------
    sessions
        One session with frames of the kinds dark and phantom, and preferably mask. Gain and read
        noise are those of the folder's sensor calibration, or else nominal.
    certificate
        Certificate of the phantom; None: the simulated phantom's, for simulated sessions only.

    Raises
    ------
    CalibratingError
        When required frames are missing, or the phantom's optics are unknown.
    CalibrationError
        When the frames do not determine the calibration.
    """
    if len(sessions.sessions) != 1:
        raise CalibratingError(
            f"sessions: got {len(sessions.sessions)}, expected one, because the light may change"
            " between sessions; name one of them"
        )
    session = sessions.sessions[0]
    rig = session.rig
    if rig.probe is None:
        raise CalibratingError(
            f"kind 'fiber': got a session of rig {rig.name!r}, expected a fiber probe's; name one"
        )
    paper = certificate or _packaged_certificate(session)
    noise, notes = _noise(sessions)
    series = _Series(session, noise)
    phantoms = series.phantoms()
    level = series.level()
    masks = series.masks()
    nominal = np.array([fiber.spot_px for fiber in rig.probe.fibers])
    names = [fiber.name for fiber in rig.probe.fibers]
    spots = find_fiber_spots(phantoms[0], nominal, names=names, pattern=noise.pattern, masks=masks)
    readings = _mean([sum_spots(merged, spots, noise=noise) for merged in phantoms])
    fibers = calibrate_fibers(
        readings,
        {fiber: sum_spots(merged, spots, noise=noise) for fiber, merged in masks.items()},
        spots=spots,
        radius_mm=rig.probe.radius_mm,
        expected=expected_reflectance(paper, rig),
        level=level,
    )
    if not masks:
        notes = (
            *notes,
            "the session holds no frames with covered fibers: cross-talk and stray light are"
            " assumed zero, and the standard errors of the far fibers do not include them",
        )
    findings = (*spots.findings, *notes, *_report_worn_fibers(fibers))
    made = fibers.to_calibration(
        serial=rig.views[0].serial,
        notes={
            **number_findings(findings),
            "phantom": paper.name or "not named",
            "noise": noise.origin,
        },
        **sessions.provenance(),
    )
    return CalibrationResult(made, _summary(fibers, series, paper), findings)


class _Series:
    """The exposure series in a session of a phantom."""

    def __init__(self, session: Session, noise: CameraNoise) -> None:
        self._session, self._noise = session, noise
        darks = session.frames("dark")
        if not darks:
            raise CalibratingError(
                f"session {session.id}: got no frames of kind 'dark', so the dark signal is"
                " unknown; capture the phantom with dark frames"
            )
        self.darks: DarkModel = measure_darks(
            [session.read(record).cfa for record in darks],
            [_exposure_s(record) for record in darks],
            noise=noise,
            temperature_c=_temperature(darks),
        )
        self._phantom = session.frames("phantom")
        if not self._phantom:
            raise CalibratingError(
                f"session {session.id}: got no frames of kind 'phantom'; capture that target"
                " (`skinrig simulate probe --target phantom`, or `skinrig capture probe --target"
                " phantom`)"
            )

    def level(self) -> float:
        """Return the level of the source; raise if frames differ in it."""
        frames = [*self._phantom, *self._session.frames("mask")]
        levels = {float(record.settings.get("level", 1.0)) for record in frames}
        if len(levels) != 1:
            raise CalibratingError(
                f"session {self._session.id}: got levels {sorted(levels)} of the source, expected"
                " one; capture the phantom with one level"
            )
        return levels.pop()

    def phantoms(self) -> list[MergedSeries]:
        """Return the merged series with all fibers uncovered, one per placement."""
        groups = _grouped(self._phantom, "repeat")
        return [self._merge(records) for _, records in sorted(groups.items())]

    def masks(self) -> Mapping[int, MergedSeries]:
        """Return the series with one fiber uncovered, by its number, each merged on access."""
        return _MergedSeries(_grouped(self._session.frames("mask"), "fiber"), self._merge)

    @property
    def counts(self) -> tuple[int, int, int]:
        """Numbers of dark, phantom and mask frames."""
        session = self._session
        dark, phantom, mask = (len(session.frames(kind)) for kind in ("dark", "phantom", "mask"))
        return dark, phantom, mask

    def _merge(self, records: Sequence[FrameRecord]) -> MergedSeries:
        return merge_series(
            [self._session.read(record).cfa for record in records],
            [_exposure_s(record) for record in records],
            darks=self.darks.at(_temperature(records)),
            noise=self._noise,
            light_s=[_light_s(record) for record in records],
        )


class _MergedSeries(Mapping[int, MergedSeries]):
    """Merged series by number; only the one in use is in memory."""

    def __init__(
        self,
        groups: Mapping[int, Sequence[FrameRecord]],
        merge: Callable[[Sequence[FrameRecord]], MergedSeries],
    ) -> None:
        self._groups, self._merge = groups, merge

    def __getitem__(self, number: int) -> MergedSeries:
        return self._merge(self._groups[number])

    def __iter__(self) -> Iterator[int]:
        return iter(self._groups)

    def __len__(self) -> int:
        return len(self._groups)


def _grouped(records: Sequence[FrameRecord], key: str) -> dict[int, list[FrameRecord]]:
    groups: dict[int, list[FrameRecord]] = defaultdict(list)
    for record in records:
        groups[int(record.index.get(key, 0))].append(record)
    return groups


def _exposure_s(record: FrameRecord) -> float:
    return float(record.actual.get("exposure_s", record.settings["exposure_s"]))


def _light_s(record: FrameRecord) -> float:
    return float(record.actual.get("open_s", _exposure_s(record)))


def _temperature(records: Sequence[FrameRecord]) -> float | None:
    degrees = [float(r.actual["camera_c"]) for r in records if "camera_c" in r.actual]
    return float(np.mean(degrees)) if degrees else None


def _noise(sessions: TargetSessions) -> tuple[CameraNoise, tuple[str, ...]]:
    known = sessions.sensor()
    if known is None:
        return CameraNoise.from_view(sessions.rig.views[0]), (
            "the folder has no sensor calibration: gain and read noise are nominal; calibrate"
            " sensor first",
        )
    return CameraNoise.from_sensor(known), ()


def _packaged_certificate(session: Session) -> PhantomCertificate:
    if session.source != "simulated":
        raise CalibratingError(
            "phantom: its optics are not known; give its certificate with --phantom FILE.json"
            " (schema skinrig.phantom/1, see docs/how-to/calibrate-probe.md) [SR-CAL-016]"
        )
    return packaged_certificate()


def _mean(readings: Sequence[FiberReadings]) -> FiberReadings:
    """Average readings over placements.

    The variance of the mean is the propagated noise, or the scatter between placements where that
    is larger.
    """
    if len(readings) == 1:
        return readings[0]
    valid = np.logical_and.reduce([r.valid for r in readings])
    signal = np.where(valid, np.mean([r.signal for r in readings], axis=0), 0.0)
    count = len(readings)
    # variance of a mean of n: mean(var) / n by the noise model, s^2 / n by the scatter
    noise = np.mean([r.variance for r in readings], axis=0) / count
    scatter = np.var([r.signal for r in readings], axis=0, ddof=1) / count
    return FiberReadings(
        readings[0].names,
        signal,
        np.where(valid, np.maximum(noise, scatter), 0.0),
        valid,
        np.logical_or.reduce([r.saturated for r in readings]),
        np.asarray(np.mean([r.around for r in readings], axis=0)),
        readings[0].exposures_s,
        readings[0].noise_origin,
    )


def _report_worn_fibers(fibers: FiberCalibration) -> tuple[str, ...]:
    channels = zip(fibers.gain.T, fibers.valid.T, strict=True)
    median = np.array([np.median(gain[good]) if good.any() else 1.0 for gain, good in channels])
    found = []
    for i, name in enumerate(fibers.names):
        if fibers.dead[i]:
            found.append(f"{name} is dead: it gives no light; replace it")
        elif fibers.valid[i].any():
            relative = float(np.median((fibers.gain[i] / median)[fibers.valid[i]]))
            if relative < MIN_HEALTHY_GAIN:
                found.append(
                    f"{name} passes {100 * relative:.0f} % of what the others do: clean it"
                )
        elif fibers.spots.found[i]:
            found.append(f"{name}: too little light from the phantom to calibrate it")
    return tuple(found)


def _summary(
    fibers: FiberCalibration, series: _Series, paper: PhantomCertificate
) -> tuple[tuple[str, str], ...]:
    spots, mixed = fibers.spots, fibers.crosstalk
    darks, phantom, mask = series.counts
    across, down = spots.shift_px
    rows = {
        "spots found": f"{int(spots.found.sum())} of {len(fibers.names)}, {across:+.2f},"
        f" {down:+.2f} px from nominal, row rotated {np.degrees(spots.rotation_rad):+.2f}°",
        "standard error of a place": f"worst {spots.center_stderr_px[spots.found].max():.3f} px",
        "radius of spots, of apertures": f"{spots.radius_px[spots.found].mean():.2f},"
        f" {spots.aperture_px:.2f} px",
    }
    for c, color in enumerate(("red", "green", "blue")[: fibers.gain.shape[1]]):
        rows[f"gain {color}"] = _gain_text(fibers, c)
    if mixed.measured:
        first, second = (np.diagonal(mixed.matrix, k) for k in (1, 2))
        error = np.median(np.diagonal(mixed.stderr, 1))
        strays = np.abs(mixed.offset).max()
        strays_error = np.hypot(mixed.offset_stderr, mixed.offset_common).max()
        rows |= {
            "cross-talk": f"neighbors {np.median(first):.2e} ({first.min():.1e} to"
            f" {first.max():.1e}, standard error {error:.0e}), next {np.median(second):.1e}",
            "stray light": f"at most {strays:.1e} ± {strays_error:.0e} full scales per second",
            "covers let through": f"{mixed.cover_leak:.1e} ± {mixed.cover_leak_stderr:.0e}",
        }
    dark, relative = series.darks, paper.uncertainty
    rows |= {
        "dark current": f"{dark.mean_rate_dn_per_s:.3g} ± {dark.mean_rate_stderr:.1g} DN/s,"
        f" {int(dark.hot.sum())} hot pixels",
        "dead fibers": ", ".join(np.array(fibers.names)[fibers.dead]) or "none",
        "frames": f"{darks} dark, {phantom} phantom, {mask} mask",
        "phantom": f"{paper.name or 'not named'}: standard uncertainty"
        f" {100 * relative.sigma_a:g} % of sigma_a, {100 * relative.sigma_s_prime:g} % of sigma_s'",
    }
    return tuple(rows.items())


def _gain_text(fibers: FiberCalibration, c: int) -> str:
    """Describe the range and the standard errors of a channel's gains."""
    good = fibers.valid[:, c]
    if not good.any():
        return "no fiber calibrated"
    gain = fibers.gain[good, c]
    error = (fibers.gain_stderr / np.maximum(fibers.gain, 1e-300))[good, c]
    shape = np.hypot.reduce(np.abs(fibers.common[:, good, c]), axis=0).max(initial=0.0)
    worst = fibers.names[int(np.flatnonzero(good)[np.argmax(error)])]
    low, high = np.array([gain.min(), gain.max()]) / np.median(gain)
    return (
        f"{low:.2f} to {high:.2f} of the median, {int(good.sum())} fibers;"
        f" standard error median {100 * np.median(error):.2f} %, worst {100 * error.max():.2f} %"
        f" ({worst}); common to all up to {100 * shape:.1f} %"
    )
