"""Render the fiber probe: light from the source fiber through tissue to the fibers' far ends.

The unit of light is fixed by the rig alone: fibers of nominal transmission on tissue of R_f = 2
per mm^2 give 0.8 of full scale in the center of a uniform spot, in the strongest channel, in the
shortest of the usual exposures at full level. The channels' ratio is that of a white under the
source's LED.

The ground truth for estimators of the fiber probe: profiles, optics, and the actual probe.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from capture.rig import Rig
from model import spectra
from model.skin import SkinAppearance
from rigsim.arrays import Float32Array, Float64Array, UInt16Array
from rigsim.as_built.probe import ActualProbe, build_probe
from rigsim.boxes.contact_probe.source_shutter import SourceLight
from rigsim.fiber.homogeneous_fit import fit_homogeneous_medium
from rigsim.fiber.probe_profile import BandProfile, ProfileCache, probe_fibers
from rigsim.fiber.probe_tissue import HomogeneousTissue, ProbedTissue, TissueError
from rigsim.mitsuba.variant import Renderer, choose_variant
from rigsim.needs.effects import AUTOMATIC_EFFECTS, PixelNoise, SceneEffects
from rigsim.needs.probe import (
    CROSSTALK_EFFECT,
    DARK_CURRENT_EFFECT,
    WINGS_EFFECT,
    select_probe_effects,
)
from rigsim.needs.tissue import select_probed_tissue
from rigsim.scenes.exposing import RigScene, SceneError, full_power_duration_s
from rigsim.scenes.probe.detector import render_fiber_images
from rigsim.sensor import Sensor, expose_sensor, make_sensor
from rigsim.world.suction import HeadState

PROBE_METER_RATE_PER_S: Final = 0.8 / 2.0 / (30.0 * 2.0 ** (-44.0 / 3.0))
"""Full scales per second in a spot's center per R_f in 1/mm^2."""

DARK_CURRENT_E_PER_S: Final = 0.3
"""Dark current at `DARK_CURRENT_REFERENCE_C`, electrons per second and pixel."""
DARK_CURRENT_REFERENCE_C: Final = 5.0
DARK_CURRENT_DOUBLING_K: Final = 6.5
"""Temperature rise that doubles the dark current, kelvin; typical of silicon near 20 C."""

HOT_SHARE, HOT_E_PER_S = 1e-3, 10.0
"""Fraction of hot pixels, and the mean of their added dark current at the reference."""

ROOM_LIGHT_R_F_PER_MM2: Final = 1e-3
"""Reflectance at full level that is equivalent to the room's light on a head in the air."""

MAX_USUAL_EXPOSURE_S: Final = 30.0
"""The longest of the usual exposures, s."""

DARK_CAP_SITE: Final = "cap"
"""Site at which the head's fibers are capped."""

LENS_VIGNETTING: Final = 0.1
PHOTONS_PER_ANGLE: Final = 200_000
"""Photons per site and angle."""


class ProbeScene(RigScene):
    """One subject, or a phantom, under the probe.

    Parameters
    ----------
    rig
        The nominal rig.
    tissue
        The tissue below the probe.
    build
        The actual probe; None: drawn by the camera's serial number and `seed` 0, so that
        sessions of one probe share it.
    sensor
        The camera's sensor at `DARK_CURRENT_REFERENCE_C`; None takes the rig's.
    seed
        Seeds the photons, and without `noise_seed` the variation between exposures.
    noise_seed
        Seeds the variation between exposures of one session; None: `seed`.
    photons
        Photons per site and angle.
    effects
        Requested effects; by default those that change readings.
    """

    renderer: Renderer = "mitsuba"
    """Renderer of the detector's image, with any variant."""

    def __init__(
        self,
        rig: Rig,
        tissue: ProbedTissue,
        *,
        build: ActualProbe | None = None,
        sensor: Sensor | None = None,
        seed: int = 0,
        noise_seed: int | None = None,
        photons: int = PHOTONS_PER_ANGLE,
        effects: SceneEffects = AUTOMATIC_EFFECTS,
    ) -> None:
        if rig.probe is None or len(rig.views) != 1:
            raise SceneError(f"rig {rig.name!r}: expected a contact probe and one view")
        self.rig, self.tissue = rig, tissue
        self.seed = seed if noise_seed is None else noise_seed
        self.build = build_probe(rig, seed=0) if build is None else build
        if len(self.build.gain) != len(rig.probe.fibers):
            raise SceneError(
                f"build: got {len(self.build.gain)} fibers, expected {len(rig.probe.fibers)}"
            )
        self._view = rig.views[0]
        self.variant = choose_variant("rgb")
        """Variant that renders the fibers' ends, with the reason."""
        dark = {"dark_e_per_s": DARK_CURRENT_E_PER_S, "vignetting": LENS_VIGNETTING}
        self._sensor = make_sensor(self._view, **dark) if sensor is None else sensor
        self.white = spectra.camera_white(self._view.spectral_sensitivity, rig.lights[0].illuminant)
        images = render_fiber_images(self.build, self._view)
        self.hot_e_per_s = _hot_pixels(self._sensor, images.shape[1:])
        """Added dark current of hot pixels at `DARK_CURRENT_REFERENCE_C`, electrons/s,
        shape (H, W)."""
        full_e = self._sensor.gain_e_per_dn * (self._sensor.white - self._sensor.black)
        self.needs = select_probe_effects(
            rig,
            tissue,
            self.build,
            noise=PixelNoise.of(self._sensor),
            hot=float(self.hot_e_per_s.max()) * MAX_USUAL_EXPOSURE_S / full_e,
            unit_rgb=PROBE_METER_RATE_PER_S * MAX_USUAL_EXPOSURE_S * self.white,
            spots=images,
            effects=effects,
        )
        """Effects with their verdicts and reasons."""
        if not self.needs.builds(CROSSTALK_EFFECT):
            self.build = dataclasses.replace(self.build, crosstalk=np.eye(len(self.build.gain)))
        if not self.needs.builds(WINGS_EFFECT):
            self.build = dataclasses.replace(self.build, wings=0.0)
            images = render_fiber_images(self.build, self._view)
        if not self.needs.builds(DARK_CURRENT_EFFECT):
            self.hot_e_per_s = np.zeros_like(self.hot_e_per_s)
            self._sensor = dataclasses.replace(self._sensor, dark_e_per_s=0.0)
        self._images = np.ascontiguousarray(images.reshape(len(images), -1).T)
        built = select_probed_tissue(tissue, self.needs)
        self.profiles = ProfileCache(rig, built, photons=photons, seed=seed)

    def sensor(
        self, view_name: str | None = None, *, camera_c: float = DARK_CURRENT_REFERENCE_C
    ) -> Sensor:
        """Return the camera's sensor at a temperature in degrees Celsius."""
        self._check_view(view_name)
        dark = self._sensor.dark_e_per_s * _relative_dark_current(camera_c)
        return dataclasses.replace(self._sensor, dark_e_per_s=dark)

    # light --------------------------------------------------------------------------------------

    def profile(self, head: HeadState) -> BandProfile | None:
        """Return the fibers' signal at full level; None without contact.

        Raises
        ------
        SceneError
            The tissue has no such site.
        """
        if not head.placed or head.site in ("", DARK_CAP_SITE):
            return None
        try:
            return self.profiles.profile(head.site, head.angle_deg, head.suction_mbar)
        except TissueError as error:
            raise SceneError(str(error)) from error

    def fiber_radiance(self, head: HeadState, *, fiber: int | None = None) -> Float64Array:
        """Return `transmit_through_fibers` of the contacted skin; zeros in the air."""
        profile = self.profile(head)
        if profile is None:
            return np.zeros((len(self.build.gain), 3))
        return self.transmit_through_fibers(profile.reflectance_per_mm2, fiber=fiber)

    def transmit_through_fibers(
        self, reflectance_per_mm2: Float64Array, *, fiber: int | None = None
    ) -> Float64Array:
        """Return the light at the fibers' far ends, in full scales per second at level 1.

        Parameters
        ----------
        reflectance_per_mm2
            R_f in 1/mm^2, shape (F, 3).
        fiber
            The only detection fiber that is not covered; None: none is covered.

        Returns
        -------
        ndarray
            Shape (F, 3), camera RGB in the center of a uniform nominal spot, with gains and
            crosstalk.

        Raises
        ------
        SceneError
            Unknown fiber.
        """
        count = len(self.build.gain)
        open_share = np.ones(count)
        if fiber is not None:
            if not 0 <= fiber < count:
                raise SceneError(f"fiber: got {fiber}, expected 0 to {count - 1}")
            open_share[:] = self.build.cover_leak
            open_share[fiber] = 1.0
        taken = (open_share * self.build.gain)[:, None] * reflectance_per_mm2
        return np.asarray(PROBE_METER_RATE_PER_S * (self.build.crosstalk @ taken) * self.white)

    def image(self, fiber_radiance: Float64Array) -> Float32Array:
        """Return the light on the sensor, shape (H, W, 3), from the light at the fibers' ends."""
        height, width = self._view.height_px, self._view.width_px
        light = self._images @ np.asarray(fiber_radiance, np.float32)
        return np.asarray(light.reshape(height, width, 3))

    def exposure(
        self,
        view_name: str,
        *,
        pops: Sequence[SourceLight],
        exposure_s: float,
        seed: int,
        head: HeadState,
    ) -> UInt16Array:
        """Simulate one exposure of the camera.

        Parameters
        ----------
        view_name
            Name of the camera.
        pops
            The source's light, clipped to the exposure; none yields a dark frame.
        exposure_s
            Exposure time, s.
        seed
            Seed of this exposure's noise.
        head
            State of the head at its beginning.

        Returns
        -------
        ndarray of uint16
            Raw DN, shape (H, W).

        Raises
        ------
        SceneError
            Unknown view, site or fiber; light with a wrong level or end.
        """
        self._check_view(view_name)
        rng = np.random.default_rng([self.seed, seed])
        total = np.zeros((len(self.build.gain), 3))
        for pop in pops:
            energy = full_power_duration_s(pop, "the source")
            energy *= 1.0 + self.build.ripple * float(rng.standard_normal())
            total += max(energy, 0.0) * self.fiber_radiance(head, fiber=pop.fiber)
        if (not head.placed and head.site != DARK_CAP_SITE) or not head.site:
            room = np.full((len(self.build.gain), 3), ROOM_LIGHT_R_F_PER_MM2)
            total += exposure_s * self.transmit_through_fibers(room)
        light = self.image(total)
        sensor = self.sensor(camera_c=head.camera_c)
        full_e = sensor.gain_e_per_dn * (sensor.white - sensor.black)
        hot = self.hot_e_per_s * np.float32(
            exposure_s * _relative_dark_current(head.camera_c) / full_e
        )
        light += hot[..., None]
        return expose_sensor(light, sensor=sensor, rng=rng, exposure_s=exposure_s)

    # inside -------------------------------------------------------------------------------------

    def _check_view(self, name: str | None) -> None:
        if name is not None and name != self._view.name:
            raise SceneError(f"view: got {name!r}, expected {self._view.name!r}")


def _relative_dark_current(camera_c: float) -> float:
    """Return the dark current relative to that at `DARK_CURRENT_REFERENCE_C`."""
    return math.pow(2.0, (camera_c - DARK_CURRENT_REFERENCE_C) / DARK_CURRENT_DOUBLING_K)


def _hot_pixels(sensor: Sensor, shape: tuple[int, ...]) -> Float32Array:
    """Return hot pixels' added dark current at `DARK_CURRENT_REFERENCE_C`, electrons/s."""
    rng = np.random.default_rng([0x686F74, *sensor.serial.encode()])
    hot = rng.random(shape) < HOT_SHARE
    return np.where(hot, rng.exponential(HOT_E_PER_S, shape), 0.0).astype(np.float32)


@dataclass(frozen=True, slots=True)
class ProbePlacement:
    """One placement of the head on the skin, during one series of exposures."""

    site: str
    """Name of the site."""
    repeat: int
    """Number of the placement there, from 0."""
    angle_deg: float
    """Rotation of the head about its own axis, degrees."""
    suction_mbar: float
    """Mean suction while it was lit, mbar below ambient pressure, >= 0."""


def probe_truth(scene: ProbeScene, placements: Sequence[ProbePlacement]) -> SkinAppearance:
    """Return the ground truth of some placements of the head.

    Parameters
    ----------
    scene
        Scene of the head.
    placements
        The placements.

    Returns
    -------
    SkinAppearance
        No maps. ``parameters``: ``profiles``, one per placement with ``site``, ``repeat``,
        ``angle_deg``, ``suction_mbar``, ``radius_mm``, ``reflectance_per_mm2`` and ``stderr``
        (fibers x 3, of the Monte Carlo), ``sigma_a_per_mm``, ``sigma_s_prime_per_mm``,
        ``sigma_tr_per_mm`` (3 each) and ``kind``; for tissue that is not homogeneous and gray the
        nearest medium by `rigsim.fiber.homogeneous_fit`, with ``fit_residual``, ``fit_factor`` and
        ``fit_fibers``; ``spots_px``, ``gain``, ``crosstalk`` of the actual probe.
    """
    profiles = [_profile(scene, probing) for probing in placements]
    build = scene.build
    parameters: dict[str, object] = {
        "profiles": profiles,
        "spots_px": build.spot_px.tolist(),
        "gain": build.gain.tolist(),
        "crosstalk": build.crosstalk.tolist(),
    }
    return SkinAppearance(
        {}, "simulated", parameters=parameters, left_out=tuple(scene.omitted), seed=scene.seed
    )


def _profile(scene: ProbeScene, probing: ProbePlacement) -> dict[str, object]:
    made = scene.profiles.profile(probing.site, probing.angle_deg, probing.suction_mbar)
    tissue = scene.tissue
    out: dict[str, object] = {
        "site": probing.site,
        "repeat": probing.repeat,
        "angle_deg": probing.angle_deg,
        "suction_mbar": probing.suction_mbar,
        "radius_mm": list(scene.profiles.probe.radius_mm),
        "reflectance_per_mm2": made.reflectance_per_mm2.tolist(),
        "stderr": made.stderr.tolist(),
        "kind": tissue.kind,
    }
    if isinstance(tissue, HomogeneousTissue) and not tissue.wavelength_nm:
        sigma_a = float(np.squeeze(tissue.sigma_a_per_mm))
        scattering = float(np.squeeze(tissue.sigma_s_prime_per_mm))
        sigma_tr = math.sqrt(3.0 * sigma_a * (sigma_a + scattering))
        media = [(sigma_a, scattering, sigma_tr)] * 3
    else:
        kind = probe_fibers(scene.profiles.probe)
        dimmed = tissue.kind != "anisotropic"  # has no top layer
        fits = [
            fit_homogeneous_medium(band, kind, dimmed=dimmed) for band in made.reflectance_per_mm2.T
        ]
        media = [(f.sigma_a_per_mm, f.sigma_s_prime_per_mm, f.sigma_tr_per_mm) for f in fits]
        out["fit_residual"] = [fit.residual for fit in fits]
        out["fit_factor"] = [fit.factor for fit in fits]
        out["fit_fibers"] = [fit.fibers for fit in fits]
    for name, values in zip(
        ("sigma_a_per_mm", "sigma_s_prime_per_mm", "sigma_tr_per_mm"),
        zip(*media, strict=True),
        strict=True,
    ):
        out[name] = list(values)
    return out
