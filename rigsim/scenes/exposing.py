"""Base classes of scenes: views, sensors, exposures, and caches of their light."""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, Protocol, TypeVar

import numpy as np

from capture.rig import Rig, RigError, View
from rigsim.arrays import Float32Array, UInt16Array
from rigsim.light.interreflection import DEFAULT_MIN_BOUNCE_FRACTION, Interreflection
from rigsim.light.observed_skin import ObservedSkin, observe_skin
from rigsim.light.relief_shadow import ReliefShadow
from rigsim.needs.effect_sizes import exchange_unless_flat
from rigsim.needs.effects import EffectSelection, PixelNoise, SceneEffects
from rigsim.needs.face import FURTHER_BOUNCES_EFFECT, ViewingConditions
from rigsim.render import Caster
from rigsim.sensor import Sensor, expose_sensor, make_sensor
from rigsim.subject import SimulatedSubject
from rigsim.targets import Target
from rigsim.world.light_record import SwitchedLight

PopT = TypeVar("PopT")


class SceneError(ValueError):
    """A request that a scene cannot fulfill."""


def full_power_duration_s(light: SwitchedLight, name: str) -> float:
    """Return the time for which full power would emit the light of an interval, s.

    Parameters
    ----------
    light
        Interval of light.
    name
        Name of the light, for the error.

    Returns
    -------
    float
        Level times duration, s.

    Raises
    ------
    SceneError
        The level is not from 0 to 1, or the light ends before it begins.

    Examples
    --------
    >>> from rigsim.boxes.led_table import LedPulse
    >>> full_power_duration_s(LedPulse(led=3, level=0.5, t_on_s=1.0, t_off_s=1.5), "LED 3")
    0.25
    """
    if not 0.0 <= light.level <= 1.0:
        raise SceneError(f"level of {name}: got {light.level}, expected 0 to 1")
    if not light.t_off_s >= light.t_on_s:
        raise SceneError(
            f"light of {name}: got {light.t_on_s} to {light.t_off_s} s, "
            "expected an end after its beginning"
        )
    return light.level * (light.t_off_s - light.t_on_s)


class StripeExposures(Protocol):
    """Exposures of a scanner's cameras."""

    @property
    def view_names(self) -> frozenset[str]:
        """Names of the cameras."""

    def trace(self) -> None:
        """Trace what the cameras see, before the first exposure."""

    def forget(self) -> None:
        """Note that the subject has moved."""

    def exposure(
        self, view_name: str, *, pops: Sequence[Any], exposure_s: float, seed: int
    ) -> UInt16Array:
        """Return the raw DN of a camera, shape (H, W)."""


class RigScene:
    """Base class of the scenes of all rigs."""

    rig: Rig
    seed: int
    """Seeds the variation between exposures."""
    channels: tuple[int, ...] = (3,)
    """Shape of the light on a pixel: camera RGB, or () for that behind its filter."""
    needs: EffectSelection
    """Effects with their verdicts and reasons."""
    stripes: StripeExposures | None = None
    """The scanner's cameras with their exposures; None without a scanner."""

    @property
    def omitted(self) -> list[tuple[str, str]]:
        """Effects that the scene omits, with the reasons."""
        return self.needs.omitted

    def _camera(self, name: str | None) -> View:
        """Return a camera by its name; None takes the first."""
        if name is None:
            return self.rig.views[0]
        try:
            return self.rig.view(name)
        except RigError as error:
            raise SceneError(str(error)) from error

    def sensor(self, view_name: str | None = None) -> Sensor:
        """Return the sensor of a view; None takes the first."""
        raise NotImplementedError

    def _expose(
        self,
        view: View,
        pops: Sequence[PopT],
        energy_of: Callable[[PopT], float],
        image_of: Callable[[PopT], Float32Array],
        *,
        deviation: float,
        exposure_s: float,
        seed: int,
    ) -> UInt16Array:
        """Return the DN, (H, W), of a camera under several lights, each with an energy deviation.

        Parameters
        ----------
        view, pops
            The camera and the lights.
        energy_of
            Energy of a light relative to that of its image.
        image_of
            Light from one source on the camera, shape (H, W, *channels).
        deviation
            Relative standard deviation of the energy.
        exposure_s, seed
            Exposure time in s, and seed of its noise.
        """
        rng = np.random.default_rng([self.seed, seed])
        light = np.zeros((view.height_px, view.width_px, *self.channels), np.float32)
        for pop in pops:
            energy = energy_of(pop) * (1.0 + deviation * rng.standard_normal())
            if energy > 0.0:
                light += np.float32(energy) * image_of(pop)
        return expose_sensor(light, sensor=self.sensor(view.name), rng=rng, exposure_s=exposure_s)


class FaceGeometry:
    """Traced geometry of one face or target.

    Parameters
    ----------
    caster
        Caster of the mesh.
    """

    def __init__(self, caster: Caster) -> None:
        self.caster = caster
        self._relief: ReliefShadow | None = None

    @cached_property
    def exchange(self) -> Interreflection | None:
        """`rigsim.needs.effect_sizes.exchange_unless_flat` of the mesh."""
        return exchange_unless_flat(self.caster)

    def relief(self, subject: SimulatedSubject) -> ReliefShadow:
        """Return the shadows of a face's relief."""
        if self._relief is None:
            self._relief = ReliefShadow(subject)
        return self._relief


class FaceScene(RigScene):
    """A face or a target under lights of one spectrum, in front of cameras."""

    def __init__(
        self,
        rig: Rig,
        subject: SimulatedSubject | Target,
        state: str,
        movement: bool,
        sensor: Sensor | None,
        seed: int,
        subpixels: int,
    ) -> None:
        spectra_names = {light.illuminant for light in rig.lights}
        if len(spectra_names) > 1:
            raise SceneError(
                f"lights: got the spectra {', '.join(sorted(spectra_names))}, expected one"
            )
        if subpixels < 1:
            raise SceneError(f"subpixels: got {subpixels}, expected at least 1")
        if movement and isinstance(subject, SimulatedSubject) and subject.pose is None:
            subject = subject.with_expression(state)
        self.rig, self.subject, self.state, self.movement = rig, subject, state, movement
        self.seed, self.subpixels = seed, subpixels
        self._illuminant = rig.lights[0].illuminant
        self._sensors = {
            view.name: make_sensor(view) if sensor is None else sensor for view in rig.views
        }

    def sensor(self, view_name: str | None = None) -> Sensor:
        """Return the sensor of a view; None takes the first."""
        return self._sensors[self._camera(view_name).name]

    def _face(self, quantity: str = "truth") -> SimulatedSubject:
        """Return the face; raise `SceneError` with the requested quantity for a target."""
        if not isinstance(self.subject, SimulatedSubject):
            raise SceneError(f"{quantity}: got the target {self.subject.name!r}, expected a face")
        return self.subject

    def _observe(self) -> list[ObservedSkin]:
        """Return the skin of a face for each camera; holding it shares it with other callers."""
        if not isinstance(self.subject, SimulatedSubject):
            return []
        cameras = {view.spectral_sensitivity for view in self.rig.views}
        light = self._illuminant
        return [observe_skin(self.subject, self.state, camera, light) for camera in cameras]

    def _scenery(
        self, view: View, geometry: FaceGeometry, noise: PixelNoise, effects: SceneEffects
    ) -> ViewingConditions:
        """Return the viewing conditions of a camera."""
        exchange, relief, caster = None, None, geometry.caster
        if isinstance(self.subject, Target) or effects.interreflections is not False:
            exchange = geometry.exchange
        if isinstance(self.subject, SimulatedSubject) and effects.relief_shadows is not False:
            relief = geometry.relief(self.subject)
        return ViewingConditions(
            view, self._illuminant, caster, exchange, relief, noise, effects, self.subpixels
        )

    def _last_bounce(self, effects: SceneEffects) -> float:
        """Return the fraction of the first bounce below which further bounces are omitted."""
        if effects.last_bounce is not None:
            return effects.last_bounce
        return self.needs[FURTHER_BOUNCES_EFFECT].choice or DEFAULT_MIN_BOUNCE_FRACTION
