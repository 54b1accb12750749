"""From photographs of a ball of black glass to the lights and the films of a polarized sphere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from capture.arrays import BoolArray, Float64Array
from capture.calibration.fiber.spot_photometry import (
    RING_RADII,
    RateImage,
    Shot,
    measure_flux,
    measure_middles,
    rate_image,
    share_within,
)
from capture.calibration.geometry import CameraPose
from capture.calibration.led_sphere.glass_ball import (
    Ball,
    BallError,
    BallFit,
    Mirrored,
    find_spots,
    light_directions,
    locate_ball,
    mirror_lights,
)
from capture.calibration.led_sphere.lights import SphereFilms, SphereLightTable
from capture.calibration.led_sphere.polarization import FilmFit, fit_films, leakage
from capture.calibration.polarization.polarized_reflection import Reflection
from capture.rig import Rig, View

__all__ = ["GlassBall", "SphereSurvey", "survey_sphere"]


SPOT_MARGIN_MM = 0.06  # around a spot as geometry draws it, for what the lens and the pixels blur
WAVELENGTH_MM = 5.5e-4
# of a spot's middle, whatever its light: the pixels' own responses, the polish
MIN_CENTER_STDERR_PX = 0.03
TYPICAL_CENTER_STDERR_PX = 0.1  # about how well middles are known, those of dim spots among them
EXPOSURE_REPEATABILITY = 1e-3  # how well an exposure's light repeats
PIXEL_RESPONSE_STDERR = 1e-3  # how well pixels' responses are known over a spot
MAX_DEAD_INTENSITY = 0.05  # of the mean: a light dimmer than this is dead
MAX_INTENSITY_STDERR = 0.3  # relative error above which an intensity is not called measured
MAX_ANALYZER_OFFSET_DEG = 2.0
MAX_POLARIZER_TURN_DEG = 3.0
MAX_LIGHT_OFFSET_SIGMAS = 5.0
MAX_LIGHT_OFFSET_DEG = 0.5
# of a usual spot's peak: fainter ones are reflections of spots, or their rings
STRAY_PEAK_RATIO = 0.2
STRAY_MM = 0.4
SKIN_ETA = 1.4


@dataclass(frozen=True, slots=True)
class GlassBall:
    """The target: a polished ball of black glass."""

    center_mm: tuple[float, float, float] = (0.0, 0.0, -3.0)
    """About where its middle stands, mm, rig frame: half a radius behind the origin, where the
    camera is focused, spots near the axis are sharp."""
    radius_mm: float = 6.0
    radius_stderr_mm: float = 0.02
    eta: float = 1.52
    """Refractive index, > 1."""
    eta_stderr: float = 0.002
    depth_stderr_mm: float = 1.0
    """How well it stands there along the camera's axis, mm."""

    def __post_init__(self) -> None:
        """Check ranges."""
        for name in ("radius_mm", "radius_stderr_mm", "depth_stderr_mm", "eta_stderr"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"GlassBall.{name}: got {getattr(self, name)}, expected > 0")
        if not 1 < self.eta < 4:
            raise ValueError(f"GlassBall.eta: got {self.eta}, expected 1 < eta < 4")


@dataclass(frozen=True, slots=True, eq=False)
class SphereSurvey:
    """What photographs of the ball said.

    Attributes
    ----------
    lights : SphereLightTable
    films : SphereFilms
    ball : Ball
        As found.
    light_scatter_mm : float
        Of the lights about their nominal places, along an axis.
    turn_scatter_rad : float
        Of the lights' polarizers about their nominal axes.
    readings_deg : tuple of float
        Of the analyser.
    findings : tuple of str
        What is wrong with the rig.
    """

    lights: SphereLightTable
    films: SphereFilms
    ball: Ball
    light_scatter_mm: float
    turn_scatter_rad: float
    readings_deg: tuple[float, ...]
    findings: tuple[str, ...]


def survey_sphere(
    shots: Sequence[Shot],
    rig: Rig,
    *,
    view: str = "cam",
    target: GlassBall | None = None,
    eta: float = SKIN_ETA,
) -> SphereSurvey:
    """Find directions, intensities and films of a sphere's lights.

    Parameters
    ----------
    shots : sequence of Shot
        Of the ball with all lights on, at two or more readings of the analyser, 0 and 90 among
        them; several exposures of each keep bright and dim spots within the sensor's range.
    rig : Rig
        Nominal, with polarizers before lights and camera.
    view : str
        The camera.
    target : GlassBall, optional
        The ball; None: 12 mm, index 1.52.
    eta : float
        Refractive index of the surface whose leakage is wanted; skin's by default.

    Returns
    -------
    SphereSurvey

    Raises
    ------
    BallError
        If the photographs show no spots, too few, or not those of this rig.
    PolarizationError
        If the readings do not tell the films.
    """
    what = target or GlassBall()
    camera = CameraPose.nominal(rig.view(view))
    size = camera.image_size[::-1]
    for shot in shots:
        if shot.signal.shape != size:
            raise BallError(
                f"frames: got {shot.signal.shape} pixels, expected {size} of view {view!r}; is it"
                " a session of this rig?"
            )
    pixel_mm = float(np.linalg.norm(camera.center_mm)) / float(camera.matrix[0, 0])
    place = np.array([light.position_mm for light in rig.lights], np.float64)
    distance = np.linalg.norm(place, axis=1)
    about = mirror_lights(camera, np.array(what.center_mm), what.radius_mm, place)
    spot_mm = _spot_radius(about, camera, what, rig, view)
    aperture_px = np.maximum(spot_mm / pixel_mm, 2.5)
    total = _both_states(shots)
    spots = find_spots(total.rate, pixel_mm=pixel_mm)
    fit = _locate(spots, camera, place, what)
    start = np.where((fit.spot >= 0)[:, None], spots[fit.spot], np.nan)
    middle, noise_px, clipped = measure_middles(total, start, aperture_px=aperture_px)
    measured = np.asarray(np.isfinite(middle).all(axis=1), bool)
    fit = _again(fit, spots, middle, measured, camera, place, what)
    errors = np.hypot(
        np.where(measured, noise_px, 0.0), np.where(clipped, 0.5, MIN_CENTER_STDERR_PX)
    )
    found = light_directions(camera, fit.ball, middle, errors, distance)
    direction = np.where(measured[:, None], found.direction, place / distance[:, None])
    stderr = np.where(measured[:, None], found.stderr, fit.light_scatter_mm / distance[:, None])
    shown = mirror_lights(
        camera, fit.ball.center_mm, fit.ball.radius_mm, direction * distance[:, None]
    )
    at = np.where(measured[:, None], middle, shown.pixels)

    glass = _reflection(rig, camera, view, what.eta, shown.to_light, shown.to_camera, direction)
    readings = np.array([shot.reading_deg for shot in shots])
    airy_px = WAVELENGTH_MM * float(camera.matrix[0, 0]) / _pupil_mm(rig.view(view))
    within = share_within(aperture_px, airy_px)
    rates, variance, good, saturated = _fluxes(shots, at, aperture_px, within)
    films = fit_films(np.radians(readings), rates, variance, good, glass)
    films = _with_geometry(films, glass, what, np.linalg.norm(stderr, axis=1) / np.sqrt(2))
    intensity, intensity_stderr = _intensities(rig, camera, fit.ball, films, shown, direction)
    fluxed = _two_readings(readings, good)
    lit = fluxed & measured & (intensity > MAX_DEAD_INTENSITY)
    if not lit.any():
        raise BallError("ball: no light's spot could be measured; check exposures and focus")
    scale = float(intensity[lit].mean())
    intensity, intensity_stderr = intensity / scale, intensity_stderr / scale
    certain = intensity_stderr < MAX_INTENSITY_STDERR * np.maximum(intensity, MAX_DEAD_INTENSITY)
    dead = fluxed & (intensity + 2 * intensity_stderr < MAX_DEAD_INTENSITY)
    valid = dead | (fluxed & measured & certain)
    lights = SphereLightTable(
        tuple(light.name for light in rig.lights),
        direction,
        stderr,
        np.where(valid, intensity, 1.0),
        np.where(valid, intensity_stderr, np.std(intensity[lit])),
        measured,
        valid,
        dead,
    )
    toward = np.tile(_to(camera), (len(place), 1))
    skin = _reflection(rig, camera, view, eta, direction, toward, direction)
    result = SphereSurvey(
        lights,
        _film_table(lights, films, skin, rates, variance, good & fluxed, readings, eta),
        fit.ball,
        fit.light_scatter_mm,
        films.turn_scatter_rad,
        tuple(sorted(set(readings.tolist()))),
        (),
    )
    fit = replace(fit, in_field=fit.in_field & (good.any(axis=0) | saturated))
    told = _findings(result, fit, place, saturated, films, spots, total, middle, pixel_mm)
    return SphereSurvey(
        lights,
        result.films,
        fit.ball,
        fit.light_scatter_mm,
        films.turn_scatter_rad,
        result.readings_deg,
        told,
    )


def _locate(
    spots: Float64Array,
    camera: CameraPose,
    place: Float64Array,
    what: GlassBall,
    lit: BoolArray | None = None,
    noise_px: float = 0.5,
) -> BallFit:
    return locate_ball(
        spots,
        camera,
        place,
        center_mm=what.center_mm,
        radius_mm=what.radius_mm,
        radius_stderr_mm=what.radius_stderr_mm,
        depth_stderr_mm=what.depth_stderr_mm,
        margin_mm=RING_RADII[1] * SPOT_MARGIN_MM,
        noise_px=noise_px,
        lit=lit,
    )


def _pupil_mm(view: View) -> float:
    """Return the diameter of the lens's pupil, mm."""
    magnification = view.focal_mm / view.distance_mm
    return view.focal_mm / (view.f_number * (1.0 + magnification))


def _spot_radius(
    shown: Mirrored, camera: CameraPose, what: GlassBall, rig: Rig, view: str
) -> Float64Array:
    """Return the radius of a disc that holds each spot, mm at the plane in focus, shape (L,).

    A ball shows a distant light where its rays seem to cross, R cos / 2 behind its surface in the
    plane of incidence and R / (2 cos) across it: far from the axis both lie out of focus, one
    far.
    """
    cosine = np.sum(shown.normal * shown.to_light, axis=1)
    back = np.asarray(rig.view(view).axes[2])
    surface = float(np.dot(what.center_mm, back)) + what.radius_mm * (shown.normal @ back)
    cone = _pupil_mm(rig.view(view)) / rig.view(view).distance_mm
    defocus = [np.abs(surface - what.radius_mm * f) for f in (0.5 * cosine, 0.5 / cosine)]
    lamps = np.array([2 * light.radius_mm for light in rig.lights])
    lamp_px = lamps * np.linalg.norm(shown.px_per_mm, ord=2, axis=(1, 2))
    pixel_mm = rig.view(view).distance_mm / float(camera.matrix[0, 0])
    wide = lamp_px * pixel_mm + cone * np.maximum(*defocus)
    return np.asarray(0.5 * wide + SPOT_MARGIN_MM)


def _again(
    fit: BallFit,
    spots: Float64Array,
    middle: Float64Array,
    measured: BoolArray,
    camera: CameraPose,
    place: Float64Array,
    what: GlassBall,
) -> BallFit:
    """Return the ball by the spots' middles instead of their brightest pixels."""
    if not measured.any():
        raise BallError("ball: no spot lies whole within the image; centre the ball")
    sharp = _locate(middle[measured], camera, place, what, measured, TYPICAL_CENTER_STDERR_PX)
    return BallFit(sharp.ball, fit.spot, fit.in_field, fit.stray, sharp.light_scatter_mm)


def _both_states(shots: Sequence[Shot]) -> RateImage:
    """Return what comes parallel and crossed together, the light of each spot."""
    by_reading: dict[float, list[Shot]] = {}
    for shot in shots:
        by_reading.setdefault(shot.reading_deg, []).append(shot)
    if not by_reading:
        raise BallError("ball: got no frames with the lights on")
    parallel = rate_image(by_reading[min(by_reading, key=lambda r: abs(r))])
    across = min(by_reading, key=lambda r: abs(r - 90.0))
    if len(by_reading) == 1:
        return parallel
    crossed = rate_image(by_reading[across])
    return RateImage(
        parallel.rate + crossed.rate,
        parallel.variance + crossed.variance,
        parallel.valid & crossed.valid,
    )


def _reflection(
    rig: Rig,
    camera: CameraPose,
    view: str,
    eta: float,
    to_light: Float64Array,
    to_camera: Float64Array,
    facing: Float64Array,
) -> Reflection:
    axis = rig.view(view).analyser_axis_deg
    if axis is None:
        raise BallError(f"view {view!r}: has no analyser; this rig's films cannot be calibrated")
    return Reflection.of(
        rig.lights, camera, axis, eta, to_light=to_light, to_camera=to_camera, facing=facing
    )


def _to(camera: CameraPose) -> Float64Array:
    center = camera.center_mm
    return np.asarray(center / np.linalg.norm(center))


def _fluxes(
    shots: Sequence[Shot], at: Float64Array, aperture_px: Float64Array, within: Float64Array
) -> tuple[Float64Array, Float64Array, BoolArray, BoolArray]:
    """Return rates, variances, whether they may be used, (E, L), and always saturated, (L,)."""
    rows = []
    saturated = np.ones(len(at), bool)
    for shot in shots:
        flux = measure_flux(shot, at, aperture_px=aperture_px)
        scale = 1.0 / (within * shot.amount_s)
        rate = flux.value * scale
        variance = flux.variance * scale**2 + (EXPOSURE_REPEATABILITY * rate) ** 2
        rows.append((rate, variance, flux.whole & ~flux.saturated))
        saturated &= flux.saturated
    rates, variances, good = (np.array(part) for part in zip(*rows, strict=True))
    return rates, variances, good, saturated


def _two_readings(readings: Float64Array, good: BoolArray) -> BoolArray:
    return np.array([len(set(readings[ok] % 180.0)) >= 2 for ok in good.T])


def _with_geometry(
    films: FilmFit, glass: Reflection, what: GlassBall, angle_rad: Float64Array
) -> FilmFit:
    """Return the films with what errors of directions and of the glass's index add to theirs.

    What is measured is how the reflected light is polarized and how much it is. Near Brewster's
    angle glass turns the polarization of light fast with the angle, and reflects little.
    """

    def seen(turn: Float64Array, reflection: Reflection) -> tuple[Float64Array, Float64Array]:
        field = reflection.fields(turn)[:, 0]
        doubled = (field[:, 0] + 1j * field[:, 1]) ** 2
        return doubled, np.log(np.abs(doubled))

    h = 1e-4
    turn = films.turn_rad

    def change(
        high: tuple[Float64Array, Float64Array], low: tuple[Float64Array, Float64Array]
    ) -> Any:
        return 0.5 * np.angle(high[0] / low[0]), high[1] - low[1]

    by_turn = [v / (2 * h) for v in change(seen(turn + h, glass), seen(turn - h, glass))]
    slope = np.where(np.abs(by_turn[0]) > 1e-3, by_turn[0], 1e-3)
    first = np.cross(glass.to_light, glass.to_camera)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    turn2 = np.zeros_like(turn)
    share2 = np.zeros_like(turn)
    shifts = [
        (h * first, 0.0, angle_rad / h),
        (h * np.cross(first, glass.to_light), 0.0, angle_rad / h),
        (0.0 * first, 0.5 * what.eta_stderr, 2.0),
    ]
    for move, index, scale in shifts:
        ends = [
            seen(turn, glass.moved(glass.to_light + sign * move, glass.eta + sign * index))
            for sign in (0.5, -0.5)
        ]
        angle, share = (v * scale for v in change(*ends))
        turned = -angle / slope
        turn2 += turned**2
        share = share + by_turn[1] * turned
        # what the index changes for all is no difference between lights
        share2 += (share - np.median(share) if index else share) ** 2
    covariance = films.covariance.copy()
    covariance[:, 0, 0] += turn2
    return replace(
        films,
        covariance=covariance,
        turn_stderr_rad=np.sqrt(covariance[:, 0, 0]),
        strength_stderr=np.hypot(films.strength_stderr, np.sqrt(share2) * np.abs(films.strength)),
    )


def _intensities(
    rig: Rig,
    camera: CameraPose,
    ball: Ball,
    films: FilmFit,
    shown: Mirrored,
    direction: Float64Array,
) -> tuple[Float64Array, Float64Array]:
    """Return the light that each light sends to the origin, any common unit, with errors."""
    place = direction * np.linalg.norm([light.position_mm for light in rig.lights], axis=1)[:, None]
    distance2 = np.sum(place**2, axis=1)
    # lights point at the origin, the ball mirrors them a little beside it
    off = np.arccos(np.clip(np.sum(shown.to_light * direction, axis=1), -1.0, 1.0))
    lobe = np.array([led.intensity(float(a)) for led, a in zip(rig.lights, off, strict=True)])
    per_strength = 1.0 / (shown.magnification_px2 * lobe * distance2)
    value = films.strength * per_strength
    # what the ball's own numbers change, beyond a factor that all lights have in common
    shares = []
    root = np.linalg.cholesky(ball.covariance_mm2 + 1e-18 * np.eye(4))
    for column in root.T:
        other = mirror_lights(
            camera, ball.center_mm + column[:3], ball.radius_mm + column[3], place
        )
        shares.append(np.log(other.magnification_px2 / shown.magnification_px2))
    known = np.array(shares)
    known -= known.mean(axis=1, keepdims=True)
    common2 = np.sum(known**2, axis=0) + PIXEL_RESPONSE_STDERR**2
    return value, np.sqrt((films.strength_stderr * per_strength) ** 2 + common2 * value**2)


def _film_table(
    lights: SphereLightTable,
    films: FilmFit,
    skin: Reflection,
    rates: Float64Array,
    variance: Float64Array,
    good: BoolArray,
    readings: Float64Array,
    eta: float,
) -> SphereFilms:
    leaked, leaked_stderr = leakage(films, skin)
    weight = np.where(good, 1.0 / np.where(variance > 0, variance, 1.0), 0.0)
    states = []
    for state in (0.0, 90.0):
        rows = np.isclose(readings % 180.0, state, atol=0.01)
        whole = weight[rows].sum(axis=0)
        mean = (weight * rates)[rows].sum(axis=0) / np.where(whole > 0, whole, 1.0)
        states.append((mean, 1.0 / np.where(whole > 0, whole, np.inf), whole > 0))
    (parallel, p_var, p_seen), (crossed, c_var, c_seen) = states
    seen = p_seen & c_seen & (parallel > 3 * np.sqrt(p_var)) & ~lights.dead
    safe = np.where(seen, parallel, 1.0)
    ratio = np.where(seen, crossed / safe, 0.0)
    ratio_stderr = np.where(seen, np.sqrt(c_var + ratio**2 * p_var) / safe, 0.0)
    light_error, analyser_error = films.leak_stderr
    # axes are measured from the horizontal, which turns fast with the direction near the poles
    upward = lights.directions[:, 1]
    horizon = np.linalg.norm(lights.directions_stderr, axis=1) / np.sqrt(2)
    horizon = horizon * np.abs(upward) / np.sqrt(np.maximum(1.0 - upward**2, 1e-6))
    return SphereFilms(
        lights.names,
        leaked,
        leaked_stderr,
        ratio,
        ratio_stderr,
        films.turn_rad,
        np.hypot(films.turn_stderr_rad, horizon),
        seen,
        films.zero_rad,
        films.zero_stderr_rad,
        films.light_leak,
        light_error,
        films.analyser_leak,
        analyser_error,
        eta,
    )


def _findings(
    survey: SphereSurvey,
    fit: BallFit,
    place: Float64Array,
    saturated: BoolArray,
    films: FilmFit,
    spots: Float64Array,
    total: RateImage,
    middle: Float64Array,
    pixel_mm: float,
) -> tuple[str, ...]:
    lights, table = survey.lights, survey.films
    names = np.array(lights.names)
    told = []

    def listed(chosen: BoolArray) -> str:
        return ", ".join(names[chosen])

    if lights.dead.any():
        told.append(f"dead, or hidden from the ball: {listed(lights.dead)}")
    outside = ~fit.in_field
    if outside.any():
        told.append(f"mirrored outside the image, left nominal: {listed(outside)}")
    if saturated.any():
        told.append(f"saturated in every exposure, no intensity: {listed(saturated)}")
    dim = ~lights.valid & ~outside & ~saturated
    if dim.any():
        told.append(f"too dim in the ball to be measured: {listed(dim)}")
    nominal = place / np.linalg.norm(place, axis=1, keepdims=True)
    off = np.linalg.norm(lights.directions - nominal, axis=1)
    usual = np.sqrt(2) * survey.light_scatter_mm / np.linalg.norm(place, axis=1)
    far = lights.seen & (
        off > np.maximum(MAX_LIGHT_OFFSET_SIGMAS * usual, np.radians(MAX_LIGHT_OFFSET_DEG))
    )
    for k in np.flatnonzero(far):
        told.append(f"light {names[k]} stands {np.degrees(off[k]):.2f} degrees from its place")
    zero, error = np.degrees([films.zero_rad, films.zero_stderr_rad])
    if abs(zero) > MAX_ANALYZER_OFFSET_DEG:
        told.append(
            f"the analyser stands {zero:+.2f} ± {error:.2f} degrees off its reading: crossed leaks"
            f" {100 * np.median(table.leakage):.1f} % of reflections; turn it back"
        )
    turn = np.degrees(table.axis_error_rad)
    turned = table.valid & (
        np.abs(turn) > MAX_POLARIZER_TURN_DEG + 3 * np.degrees(table.axis_error_stderr_rad)
    )
    for k in np.flatnonzero(turned):
        told.append(f"the polarizer of light {names[k]} is turned by {turn[k]:+.1f} degrees")
    if not any(1.0 < abs(r % 180.0 - 90.0) < 89.0 for r in survey.readings_deg):
        told.append(
            "only parallel and crossed were photographed: which way single lights' polarizers are"
            " turned stays open, and errors are larger; add readings 80 and 100"
        )
    if len(fit.stray):
        peak = total.rate[spots[:, 1].astype(int), spots[:, 0].astype(int)]
        usual_peak = float(np.median(peak[fit.spot[fit.spot >= 0]]))
        own = middle[np.isfinite(middle).all(axis=1)]
        bright = [
            k
            for k in fit.stray
            if peak[k] > STRAY_PEAK_RATIO * usual_peak
            and np.linalg.norm(own - spots[k], axis=1).min() > STRAY_MM / pixel_mm
        ]
        if bright:
            told.append(f"{len(bright)} bright spots are no light's; keep other light away")
    return tuple(told)
