"""Calibrate the lights and polarizers of a sphere from photographs of a ball of black glass."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from capture.arrays import BoolArray, Float64Array
from capture.calibration.fiber.spot_photometry import (
    RING_RADII,
    RateImage,
    SpotImage,
    encircled_energy,
    measure_centroids,
    merge_spot_images,
)
from capture.calibration.geometry import CameraPose
from capture.calibration.led_sphere.glass_ball import (
    BallError,
    BallFit,
    BallPosition,
    GlassBall,
    find_spots,
    light_directions,
    locate_ball,
)
from capture.calibration.led_sphere.lights import SphereLightTable, SpherePolarizers
from capture.calibration.led_sphere.polarization import PolarizerFit, fit_polarizers
from capture.calibration.led_sphere.strengths import (
    add_geometry_errors,
    measure_intensities,
    measure_rates,
    polarizer_table,
)
from capture.calibration.lights.reflection import mirror_lights
from capture.calibration.polarization.polarized_reflection import FacetReflection
from capture.rig import Rig

MAX_ANALYZER_OFFSET_DEG = 2.0
MAX_POLARIZER_TURN_DEG = 3.0
MAX_LIGHT_OFFSET_SIGMAS = 5.0
MAX_LIGHT_OFFSET_DEG = 0.5
SPOT_MARGIN_MM = 0.06  # margin around a spot's geometric image, for the blur by lens and pixels
WAVELENGTH_MM = 5.5e-4
# error of a spot's centroid, independent of its light: the pixels' own responses, the polish
MIN_CENTER_STDERR_PX = 0.03
TYPICAL_CENTER_STDERR_PX = 0.1  # typical error of centroids, including those of dim spots
MAX_DEAD_INTENSITY = 0.05  # of the mean: a dimmer light is dead
MAX_INTENSITY_STDERR = 0.3  # relative error above which an intensity does not count as measured
# of a usual spot's peak: fainter ones are reflections of spots, or their rings
STRAY_PEAK_RATIO = 0.2
MIN_STRAY_DISTANCE_MM = 0.4
SKIN_ETA = 1.4


@dataclass(frozen=True, slots=True, eq=False)
class SphereSurvey:
    """Result of a survey from photographs of the ball.

    Attributes
    ----------
    lights : SphereLightTable
    polarizers : SphereFilms
    ball : Ball
        Ball, as located.
    light_scatter_mm : float
        Scatter of the lights about their nominal positions, along an axis.
    turn_scatter_rad : float
        Scatter of the lights' polarizers about their nominal axes.
    readings_deg : tuple of float
        Readings of the analyzer.
    findings : tuple of str
        Faults of the rig.
    """

    lights: SphereLightTable
    polarizers: SpherePolarizers
    ball: BallPosition
    light_scatter_mm: float
    turn_scatter_rad: float
    readings_deg: tuple[float, ...]
    findings: tuple[str, ...]


def describe_findings(
    survey: SphereSurvey,
    position_mm: Float64Array,
    in_field: BoolArray,
    saturated: BoolArray,
    polarizers: PolarizerFit,
    strays: int,
) -> tuple[str, ...]:
    """Return the faults of the rig, one sentence each.

    Parameters
    ----------
    survey : SphereSurvey
    position_mm : ndarray of float64, shape (L, 3)
        Nominal positions of the lights, mm.
    in_field, saturated : ndarray of bool, shape (L,)
        Lights mirrored inside the image, and saturated in every exposure.
    polarizers : FilmFit
    strays : int
        Number of bright spots that are not reflections of lights.
    """
    lights, table = survey.lights, survey.polarizers
    names = np.array(lights.names)
    findings = []

    def listed(chosen: BoolArray) -> str:
        return ", ".join(names[chosen])

    if lights.dead.any():
        findings.append(f"dead, or hidden from the ball: {listed(lights.dead)}")
    outside = ~in_field
    if outside.any():
        findings.append(f"mirrored outside the image, left nominal: {listed(outside)}")
    if saturated.any():
        findings.append(f"saturated in every exposure, no intensity: {listed(saturated)}")
    dim = ~lights.valid & ~outside & ~saturated
    if dim.any():
        findings.append(f"too dim in the ball to be measured: {listed(dim)}")
    nominal = position_mm / np.linalg.norm(position_mm, axis=1, keepdims=True)
    off = np.linalg.norm(lights.directions - nominal, axis=1)
    usual = np.sqrt(2) * survey.light_scatter_mm / np.linalg.norm(position_mm, axis=1)
    far = lights.seen & (
        off > np.maximum(MAX_LIGHT_OFFSET_SIGMAS * usual, np.radians(MAX_LIGHT_OFFSET_DEG))
    )
    for k in np.flatnonzero(far):
        findings.append(
            f"light {names[k]} is {np.degrees(off[k]):.2f} degrees off its nominal direction"
        )
    zero, error = np.degrees([polarizers.zero_rad, polarizers.zero_stderr_rad])
    if abs(zero) > MAX_ANALYZER_OFFSET_DEG:
        findings.append(
            f"the analyzer is {zero:+.2f} ± {error:.2f} degrees off its reading: crossed leaks"
            f" {100 * np.median(table.leakage):.1f} % of reflections; turn it back"
        )
    turn = np.degrees(table.axis_error_rad)
    turned = table.valid & (
        np.abs(turn) > MAX_POLARIZER_TURN_DEG + 3 * np.degrees(table.axis_error_stderr_rad)
    )
    for k in np.flatnonzero(turned):
        findings.append(f"the polarizer of light {names[k]} is turned by {turn[k]:+.1f} degrees")
    if not any(1.0 < abs(r % 180.0 - 90.0) < 89.0 for r in survey.readings_deg):
        findings.append(
            "only parallel and crossed were photographed: which way single lights' polarizers are"
            " turned is unknown, and their standard errors are larger; add readings 80 and 100"
        )
    if strays:
        findings.append(f"{strays} bright spots reflect none of the lights; keep other light away")
    return tuple(findings)


def survey_sphere(
    shots: Sequence[SpotImage],
    rig: Rig,
    *,
    view: str = "cam",
    target: GlassBall | None = None,
    eta: float = SKIN_ETA,
) -> SphereSurvey:
    """Find directions, intensities and polarizers of a sphere's lights.

    Parameters
    ----------
    shots : sequence of Shot
        Exposures of the ball with all lights on, at two or more readings of the analyzer, 0 and 90
        among them; several exposures of each keep bright and dim spots within the sensor's range.
    rig : Rig
        Nominal, with polarizers in front of lights and camera.
    view : str
        The camera.
    target : GlassBall, optional
        The ball; None: 12 mm, index 1.52.
    eta : float
        Refractive index of the surface of the leakage; skin's by default.

    Returns
    -------
    SphereSurvey

    Raises
    ------
    BallError
        If the photographs show no spots, too few, or not those of this rig.
    PolarizationError
        If the readings do not determine the polarizers.
    """
    scene = _Scene(rig, view, target or GlassBall())
    camera, place = scene.camera, scene.place
    size = camera.image_size[::-1]
    for shot in shots:
        if shot.signal.shape != size:
            raise BallError(
                f"frames: got {shot.signal.shape} pixels, expected {size} of view {view!r}; is "
                "it a session of this rig?"
            )
    aperture_px = np.maximum(scene.spot_radius_mm() / scene.pixel_mm, 2.5)
    seen = scene.find_lights(shots, aperture_px)
    fit, direction, measured = seen.fit, seen.direction, seen.measured
    lights_mm = direction * scene.distance[:, None]
    shown = mirror_lights(camera, fit.ball.center_mm, fit.ball.radius_mm, lights_mm)
    at = np.where(measured[:, None], seen.middle, shown.pixels)

    glass = scene.reflection(scene.target.eta, shown.to_light, shown.to_camera, direction)
    airy_px = WAVELENGTH_MM * float(camera.matrix[0, 0]) / scene.pupil_mm
    rates = measure_rates(shots, at, aperture_px, encircled_energy(aperture_px, airy_px))
    readings_rad = np.radians(rates.readings_deg)
    films = fit_polarizers(readings_rad, rates.rate, rates.variance, rates.good, glass)
    angle_rad = np.linalg.norm(seen.stderr, axis=1) / np.sqrt(2)
    films = add_geometry_errors(films, glass, scene.target.eta_stderr, angle_rad)
    strength = measure_intensities(rig, camera, fit.ball, films, shown, direction)
    lights = _light_table(rig, seen, rates.is_measured, strength)
    toward = np.tile(camera.center_mm / np.linalg.norm(camera.center_mm), (len(place), 1))
    skin = scene.reflection(eta, direction, toward, direction)
    table = polarizer_table(lights, films, skin, rates, eta)
    scatters = fit.light_scatter_mm, films.axis_scatter_rad
    readings = tuple(sorted(set(rates.readings_deg.tolist())))
    result = SphereSurvey(lights, table, fit.ball, *scatters, readings, ())
    in_field = fit.in_field & (rates.good.any(axis=0) | rates.saturated)
    stray = _bright_strays(seen, scene.pixel_mm)
    findings = describe_findings(result, place, in_field, rates.saturated, films, stray)
    return replace(result, findings=findings)


@dataclass(frozen=True, slots=True, eq=False)
class _ObservedLights:
    """The ball, its spots, and the lights' directions from them."""

    fit: BallFit
    spots: Float64Array
    total: RateImage
    middle: Float64Array
    measured: BoolArray
    direction: Float64Array
    stderr: Float64Array


class _Scene:
    """A ball in front of the camera of a rig with a sphere of lights."""

    def __init__(self, rig: Rig, view: str, target: GlassBall) -> None:
        self.rig, self.view, self.target = rig, rig.view(view), target
        self.camera = CameraPose.nominal(self.view)
        self.pixel_mm = float(np.linalg.norm(self.camera.center_mm) / self.camera.matrix[0, 0])
        self.place = np.array([light.position_mm for light in rig.lights], np.float64)
        self.distance = np.linalg.norm(self.place, axis=1)

    @property
    def pupil_mm(self) -> float:
        """Diameter of the lens's pupil, mm."""
        view = self.view
        return view.focal_mm / (view.f_number * (1.0 + view.focal_mm / view.distance_mm))

    def spot_radius_mm(self) -> Float64Array:
        """Return the radius of a disc around each spot, mm at the plane in focus, shape (L,).

        The ball's virtual image of a distant light is R cos / 2 behind its surface in the plane of
        incidence and R / (2 cos) across it: far from the axis both are out of focus, one of them
        strongly.
        """
        ball, view = self.target, self.view
        shown = mirror_lights(self.camera, np.array(ball.center_mm), ball.radius_mm, self.place)
        cosine = np.sum(shown.normal * shown.to_light, axis=1)
        back = np.asarray(view.axes[2])
        surface = float(np.dot(ball.center_mm, back)) + ball.radius_mm * (shown.normal @ back)
        cone = self.pupil_mm / view.distance_mm
        defocus = [np.abs(surface - ball.radius_mm * f) for f in (0.5 * cosine, 0.5 / cosine)]
        lamps = np.array([2 * light.radius_mm for light in self.rig.lights])
        lamp_px = lamps * np.linalg.norm(shown.px_per_mm, ord=2, axis=(1, 2))
        pixel_mm = view.distance_mm / float(self.camera.matrix[0, 0])
        wide = lamp_px * pixel_mm + cone * np.maximum(*defocus)
        return np.asarray(0.5 * wide + SPOT_MARGIN_MM)

    def find_lights(self, shots: Sequence[SpotImage], aperture_px: Float64Array) -> _ObservedLights:
        """Return the lights' directions from their spots; nominal ones without a spot."""
        total = _sum_polarization_states(shots)
        spots = find_spots(total.rate, pixel_mm=self.pixel_mm)
        margin_mm = RING_RADII[1] * SPOT_MARGIN_MM
        fit = locate_ball(spots, self.camera, self.place, self.target, margin_mm=margin_mm)
        start = np.where((fit.spot >= 0)[:, None], spots[fit.spot], np.nan)
        middle, noise_px, clipped = measure_centroids(total, start, aperture_px=aperture_px)
        measured = np.asarray(np.isfinite(middle).all(axis=1), bool)
        if not measured.any():
            raise BallError("ball: no whole spot inside the image; center the ball")
        # the ball again, by the spots' centroids instead of their maxima
        sharp = locate_ball(
            middle[measured],
            self.camera,
            self.place,
            self.target,
            margin_mm=margin_mm,
            noise_px=TYPICAL_CENTER_STDERR_PX,
            lit=measured,
        )
        fit = replace(fit, ball=sharp.ball, light_scatter_mm=sharp.light_scatter_mm)
        errors = np.hypot(
            np.where(measured, noise_px, 0.0), np.where(clipped, 0.5, MIN_CENTER_STDERR_PX)
        )
        distance = self.distance
        found = light_directions(self.camera, fit.ball, middle, errors, distance)
        direction = np.where(measured[:, None], found.direction, self.place / distance[:, None])
        stderr = np.where(measured[:, None], found.stderr, fit.light_scatter_mm / distance[:, None])
        return _ObservedLights(fit, spots, total, middle, measured, direction, stderr)

    def reflection(
        self, eta: float, to_light: Float64Array, to_camera: Float64Array, facing: Float64Array
    ) -> FacetReflection:
        """Return the lights with their mirror facets of a refractive index."""
        axis, name = self.view.analyzer_axis_deg, self.view.name
        if axis is None:
            text = f"view {name!r}: has no analyzer; this rig's polarizers cannot be calibrated"
            raise BallError(text)
        toward = {"to_light": to_light, "to_camera": to_camera, "facing": facing}
        return FacetReflection.of(self.rig.lights, self.camera, axis, eta, **toward)


def _light_table(
    rig: Rig, seen: _ObservedLights, fluxed: BoolArray, strength: tuple[Float64Array, Float64Array]
) -> SphereLightTable:
    """Return the lights with intensities over their mean, and the dead ones."""
    intensity, stderr = strength
    lit = fluxed & seen.measured & (intensity > MAX_DEAD_INTENSITY)
    if not lit.any():
        raise BallError("ball: no light's spot could be measured; check exposures and focus")
    scale = float(intensity[lit].mean())
    intensity, stderr = intensity / scale, stderr / scale
    certain = stderr < MAX_INTENSITY_STDERR * np.maximum(intensity, MAX_DEAD_INTENSITY)
    dead = fluxed & (intensity + 2 * stderr < MAX_DEAD_INTENSITY)
    valid = dead | (fluxed & seen.measured & certain)
    names = tuple(light.name for light in rig.lights)
    shown = np.where(valid, intensity, 1.0), np.where(valid, stderr, np.std(intensity[lit]))
    flags = seen.measured, valid, dead
    return SphereLightTable(names, seen.direction, seen.stderr, *shown, *flags)


def _bright_strays(seen: _ObservedLights, pixel_mm: float) -> int:
    """Return the number of bright spots that belong to no light and are away from its spots."""
    if not len(seen.fit.stray):
        return 0
    spots, fit = seen.spots, seen.fit
    peak = seen.total.rate[spots[:, 1].astype(int), spots[:, 0].astype(int)]
    usual_peak = float(np.median(peak[fit.spot[fit.spot >= 0]]))
    own = seen.middle[np.isfinite(seen.middle).all(axis=1)]
    return sum(
        peak[k] > STRAY_PEAK_RATIO * usual_peak
        and np.linalg.norm(own - spots[k], axis=1).min() > MIN_STRAY_DISTANCE_MM / pixel_mm
        for k in fit.stray
    )


def _sum_polarization_states(shots: Sequence[SpotImage]) -> RateImage:
    """Return the sum of parallel and crossed flux, the light of each spot."""
    by_reading: dict[float, list[SpotImage]] = {}
    for shot in shots:
        by_reading.setdefault(shot.reading_deg, []).append(shot)
    if not by_reading:
        raise BallError("ball: got no frames with the lights on")
    parallel = merge_spot_images(by_reading[min(by_reading, key=lambda r: abs(r))])
    across = min(by_reading, key=lambda r: abs(r - 90.0))
    if len(by_reading) == 1:
        return parallel
    crossed = merge_spot_images(by_reading[across])
    return RateImage(
        parallel.rate + crossed.rate,
        parallel.variance + crossed.variance,
        parallel.valid & crossed.valid,
    )
