"""Parse the arguments of `skinrig render`: views, lights and models."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from capture.calibration import geometry
from capture.calibration import store as calibration_store
from capture.calibration.lights import LightTable
from capture.rig import Rig, RigError, load_rig
from model import store
from model.skin import SkinAppearance
from model.skin_reflectance import SkinReflectance, assemble
from skinrig.errors import UnusableError, UsageError
from skinrig.rendering import camera as rendering_camera
from skinrig.rendering.camera import Camera
from skinrig.rendering.lights import (
    Light,
    LightError,
    Vector,
    read_environment,
    sample_environment_lights,
)

POSITION_PREFIX: Final = "at:"
LED_RADIUS_MM: Final = 10.0
"""Radius of a light's disc, mm at `LED_DISTANCE_MM`, by default that of the dome's LEDs."""
LED_DISTANCE_MM: Final = 700.0


@dataclasses.dataclass(frozen=True, slots=True)
class RenderRig:
    """A nominal or calibrated rig, whose views and lights are selected by name."""

    rig: Rig
    calibration: Path | None
    assumed: list[str]
    """Assumptions in place of missing calibrations; appended."""

    @staticmethod
    def of(rig: str, calibration: Path | None) -> RenderRig:
        """Load a rig by name or TOML file.

        Raises
        ------
        UnusableError
            If `calibration` is not a folder.
        """
        if calibration is not None and not calibration.is_dir():
            raise UnusableError(f"--calibration: got {calibration}, expected a folder")
        return RenderRig(load_rig(rig), calibration, [])

    def camera(
        self, text: str, *, size_px: int, target_mm: str = "0,0,0", fov_deg: float = 25.0
    ) -> Camera:
        """Parse a camera: ``C03``, a view of the rig, or ``0,0,700``, a position in mm.

        Parameters
        ----------
        text
            Name or position, mm.
        size_px
            Image width, px; for a position also the height.
        target_mm, fov_deg
            Target of the optical axis and field of view, for a position.

        Raises
        ------
        UsageError
            If numbers are missing or malformed.
        UnusableError
            If the rig has no view of that name.
        """
        place = parse_triple(text)
        if place is not None:
            target = parse_triple(target_mm)
            if target is None:
                raise UsageError(f"--look-at: got {target_mm!r}, expected three numbers, mm: 0,0,0")
            return rendering_camera.look_at(
                place, target_mm=target, fov_deg=fov_deg, size_px=(size_px, size_px), name=text
            )
        try:
            view = self.rig.view(text)
        except RigError as error:
            raise _unreadable_error(text)(
                f"--view: {error}; or give a position in mm, such as 0,0,700"
            ) from error
        camera = Camera.nominal(view)
        found = self._calibration("geometry", f"camera {text} is at its nominal pose")
        if found is not None:
            camera = geometry.cameras_from_calibration(found, self.rig.subset(views=[text]))[text]
        camera = dataclasses.replace(camera, serial=text)
        return rendering_camera.bin_pixels(camera, camera.image_size[0] / size_px)

    def light(self, text: str, *, radius_mm: float | None = None) -> Light:
        """Parse a light: ``L017``, ``1,1,2`` (direction) or ``at:300,200,600`` (position, mm).

        A factor after ``*`` is its intensity, one number or red, green, blue: ``L017*0.5``. The
        default is 1 on a white patch that faces the light, for near lights at the rig's origin.

        Parameters
        ----------
        text
            Text of the option.
        radius_mm
            Radius of its disc, mm; for a distant light at `LED_DISTANCE_MM`. None: the rig's own.

        Raises
        ------
        UsageError
            If numbers are missing or malformed.
        UnusableError
            If the rig has no light of that name.
        """
        what, _, factor = text.partition("*")
        strength = (1.0, 1.0, 1.0) if not factor else _color(text, factor)
        radius = LED_RADIUS_MM if radius_mm is None else radius_mm
        if what.startswith(POSITION_PREFIX):
            place = parse_triple(what.removeprefix(POSITION_PREFIX))
            if place is not None:
                return Light(name=text, position_mm=place, intensity=strength, radius=radius)
        direction = parse_triple(what)
        if direction is not None:
            far = radius / LED_DISTANCE_MM
            return Light(name=text, direction=direction, intensity=strength, radius=far)
        try:
            drawn = self.rig.light(what)
        except RigError as error:
            raise _unreadable_error(what)(
                f"--light: {error}; or give a direction, such as 1,1,2, or a position in mm, such "
                "as at:300,200,600"
            ) from error
        rig = self.rig.subset(lights=[what])
        table = LightTable.nominal(rig)
        found = self._calibration("lights", f"light {what} is at its nominal position")
        if found is not None:
            table = LightTable.from_calibration(found, rig)
        lamp = Light.from_table(
            table, what, radius_mm=drawn.radius_mm if radius_mm is None else radius_mm
        )
        return dataclasses.replace(lamp, name=text, intensity=strength)

    def _calibration(self, kind: str, otherwise: str) -> calibration_store.Calibration | None:
        if self.calibration is not None:
            try:
                return calibration_store.load(self.calibration, kind)
            except calibration_store.CalibrationMissing:
                pass
        if otherwise not in self.assumed:
            self.assumed.append(otherwise)
        return None


def parse_lights(
    rig: RenderRig,
    lights: Sequence[str],
    *,
    radius_mm: float | None,
    environment: Path | None,
    environment_count: int,
    seed: int,
) -> tuple[Light, ...]:
    """Parse all requested lights.

    Raises
    ------
    UsageError
        If there is none.
    """
    found = [rig.light(text, radius_mm=radius_mm) for text in lights]
    if environment is not None:
        rng = np.random.default_rng(seed)
        try:
            found += sample_environment_lights(
                read_environment(environment), environment_count, rng=rng
            )
        except LightError as error:
            raise LightError(f"{environment}: {error}") from error
    if not found:
        raise UsageError(
            "--light: got none, expected a light of the rig (L017), a direction (1,1,2) or a "
            "position (at:300,200,600); give one, or --environment MAP.exr"
        )
    return tuple(found)


def read_model(
    path: Path, *, translucency: str | None = None
) -> tuple[SkinAppearance, SkinReflectance]:
    """Read a fitted appearance and its model.

    Parameters
    ----------
    path
        APPEARANCE/ folder of the dome, with basis BRDFs and R_d.
    translucency
        Uniform sigma_tr of red, green and blue in 1/mm, such as 0.36,0.79,1.52; None: the model's.

    Raises
    ------
    UsageError
        If `translucency` is not three numbers above 0.
    model.skin_reflectance.SkinReflectanceError
        If a part of the model is missing; the message names it.
    """
    appearance = store.read(path)
    if translucency is None:
        return appearance, assemble(appearance)
    return appearance, assemble(
        appearance, translucency=1.0 / np.array(parse_sigma_tr(translucency))
    )


def parse_sigma_tr(text: str) -> Vector:
    """Parse sigma_tr of three channels, 1/mm.

    Raises
    ------
    UsageError
        If the text is not three numbers above 0.

    Examples
    --------
    >>> parse_sigma_tr("0.3558,0.7932,1.5173")
    (0.3558, 0.7932, 1.5173)
    """
    found = parse_triple(text)
    if found is None or min(found) <= 0.0:
        raise UsageError(
            f"--translucency: got {text!r}, expected sigma_tr of red, green and blue in 1/mm, "
            "above 0, such as 0.3558,0.7932,1.5173"
        )
    return found


def parse_subpixels(samples: int) -> int:
    """Return the rays along a pixel's side from those per pixel.

    Raises
    ------
    UnusableError
        If the number is not a square.

    Examples
    --------
    >>> parse_subpixels(4)
    2
    """
    side = round(samples**0.5) if samples > 0 else 0
    if side < 1 or side * side != samples or side > 16:
        raise UnusableError(f"--samples: got {samples}, expected 1, 4, 9, ... 256 rays per pixel")
    return side


def parse_triple(text: str) -> Vector | None:
    """Parse three finite numbers separated by commas; None for other texts."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        return None
    if len(values) != 3 or not np.isfinite(values).all():
        return None
    x, y, z = values
    return x, y, z


def _unreadable_error(text: str) -> type[UsageError] | type[UnusableError]:
    """Return the error of an unknown name: `UsageError` for numbers separated by commas."""
    return UsageError if "," in text else UnusableError


def _color(text: str, factor: str) -> Vector:
    found = parse_triple(factor) or parse_triple(",".join([factor] * 3))
    if found is None or min(found) < 0.0:
        raise UsageError(
            f"--light: got {text!r}, expected after * one number or three, at least 0, as "
            "L017*0.5 or 1,1,2*1,0.9,0.8"
        )
    return found
