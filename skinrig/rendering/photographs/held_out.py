"""Read the photographs of a dome session that were held out of a fit, with camera and light."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from capture.session import Session
from model.skin import SkinAppearance
from reconstruction.pipeline.dome.calibrated import CalibratedDome, load_dome, transform_dome
from reconstruction.pipeline.dome.images import DomeImages
from reconstruction.pipeline.dome.registration import register_mesh
from reconstruction.pipeline.hold_out import HoldOut
from reconstruction.pipeline.inputs import Inputs
from reconstruction.scan.repair import TriangleMesh
from reconstruction.surface.estimates import MIN_LIGHTS
from skinrig.rendering.camera import Camera, RenderingError, bin_pixels
from skinrig.rendering.geometry import read_own_mesh
from skinrig.rendering.lights import Light
from skinrig.rendering.photographs.errors import Photograph


@dataclass(frozen=True, slots=True)
class HeldOutShot:
    """Names of a photograph, with the reason for which it was held out."""

    view: str
    light: str
    held_out: str
    """ "light", "view", "light and view", or "session"."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutPhotographs:
    """Held-out photographs with which a fitted model is evaluated.

    Attributes
    ----------
    shots
        All photographs, sorted by view.
    assumed
        Assumptions, one line each.
    """

    shots: tuple[HeldOutShot, ...]
    assumed: tuple[str, ...]
    _dome: CalibratedDome
    """The dome in the frame of the maps."""
    _session: Session
    _white_mm: tuple[float, ...]
    """Reference distance of white for each light of the dome."""

    @staticmethod
    def of(
        session: str | Path, appearance: SkinAppearance, *, calibration: str | Path | None = None
    ) -> HeldOutPhotographs:
        """Find the frames of a session that an appearance was not fitted to.

        Parameters
        ----------
        session
            SESSION/ folder of the dome: the fitted session with held-out lights or views, or
            another session of the same face.
        appearance
            The fitted appearance.
        calibration
            CALIBRATION/ folder; None: nominal poses of cameras and lights.

        Raises
        ------
        RenderingError
            If all photographs were used in the fit, or the session is not of the dome.
        InputsError, CalibrationError
            If frames are missing, or a calibration is damaged or of another rig.
        """
        opened = Session.open(session)
        if not any(step.kind == "olat" for step in opened.plan.steps):
            raise RenderingError(
                f"{opened.path}: got no photographs of one light each; give a dome session of a "
                "face"
            )
        inputs = Inputs.of(opened, calibration, state="neutral", on_date=None)
        dome = load_dome(inputs, DomeImages(opened))
        same = appearance.inputs.get("session") == opened.content_hash
        held = _held_out(appearance) if same else HoldOut()
        if same and not held:
            raise RenderingError(
                f"{opened.path}: all photographs were used in the fit, expected held-out ones; fit "
                "again with `skinrig reconstruct --hold-out lights=NAMES,views=NAMES`, or compare "
                "with another session of the same face"
            )
        good = {n for n, v in zip(dome.lights.names, dome.lights.valid, strict=True) if v}
        shots = [
            HeldOutShot(view, light, _explain_held_out(held, light, view) if same else "session")
            for view in dome.images.views
            for light in dome.images.lights
            if light in good and (not same or held.is_held_out(light, view))
        ]
        if not shots:
            raise RenderingError(
                f"{opened.path}: got no calibrated light, expected some; calibrate the lights"
            )
        assumed = list(inputs.assumed)
        away = tuple(float(r) for r in np.linalg.norm(dome.table.position_mm, axis=1))
        if not same:
            dome, assumption = _fitted_head_frame(dome, appearance)
            assumed.append(assumption)
        motion = appearance.parameters.get("motion", {})
        if isinstance(motion, dict) and motion.get("still") is False:
            moved = float(motion.get("displacement_mm_max", 0.0))
            assumed.append(f"the head was static; it moved by up to {moved:.1f} mm")
        return HeldOutPhotographs(tuple(shots), tuple(assumed), dome, opened, away)

    @property
    def subject(self) -> str:
        """Pseudonym of the face."""
        return self._session.subject.pseudonym

    def photograph(self, shot: HeldOutShot) -> Photograph:
        """Return a photograph in the unit of `skinrig.rendering.photographs.errors`."""
        images = self._dome.images
        capture = images.captures.index((shot.light, -1))
        image = self._dome.image(images.views.index(shot.view), capture)
        white = self._white(shot.light)
        return Photograph(
            image.rgb.astype(np.float64) / white,
            image.variance.astype(np.float64) / white**2,
            image.valid,
        )

    def camera(self, shot: HeldOutShot) -> Camera:
        """Return the calibrated camera of a photograph, on its pixels."""
        pose = self._dome.cameras[self._dome.images.views.index(shot.view)]
        return dataclasses.replace(bin_pixels(pose, 2), serial=shot.view)

    def light(self, shot: HeldOutShot) -> Light:
        """Return the calibrated light of a photograph, of intensity 1 in all channels."""
        radius = self._session.rig.light(shot.light).radius_mm
        lamp = Light.from_table(self._dome.table, shot.light, radius_mm=radius)
        row = self._dome.table.names.index(shot.light)
        return dataclasses.replace(
            lamp, intensity=(1.0, 1.0, 1.0), reference_mm=self._white_mm[row]
        )

    def select_shots(self, count: int | None) -> tuple[HeldOutShot, ...]:
        """Select a number of shots at equal steps over views and lights; None: all."""
        return _select_evenly(self.shots, count)

    def _white(self, light: str) -> np.ndarray:
        """Return the value of white at the rig's origin in the images' unit, shape (3,)."""
        row = self._dome.table.names.index(light)
        return np.asarray(self._dome.table.intensity[row] / self._white_mm[row] ** 2, np.float64)


def _fitted_head_frame(
    dome: CalibratedDome, appearance: SkinAppearance
) -> tuple[CalibratedDome, str]:
    """Return the dome in the frame of the fitted head, and the assumption in words.

    Only the head's pose is estimated from the photographs, from their shading; not its skin.
    """
    mesh = read_own_mesh(appearance)
    welded, index = np.unique(mesh.vertices_mm.round(4), axis=0, return_inverse=True)
    lights = int(np.count_nonzero(dome.lights.valid))
    if lights < MIN_LIGHTS:
        return dome, (
            "the head has the pose of the fitted session: "
            f"{lights} lights are too few to estimate it, {MIN_LIGHTS} would suffice"
        )
    fit = register_mesh(
        dome, TriangleMesh(welded.astype(np.float64), index.reshape(-1)[mesh.faces])
    )
    turn_deg = np.degrees(np.arccos(np.clip((np.trace(fit.rotation) - 1) / 2, -1, 1)))
    before = (fit.center_mm - fit.translation_mm) @ fit.rotation
    moved_mm = np.linalg.norm(fit.center_mm - before)
    off_mm, off_deg = np.linalg.norm(fit.stderr[3:]), np.degrees(np.linalg.norm(fit.stderr[:3]))
    return transform_dome(dome, fit.rotation, fit.translation_mm), (
        f"the head is moved by {moved_mm:.2f} +- {off_mm:.2f} mm and rotated by {turn_deg:.2f} +- "
        f"{off_deg:.2f} degrees from the fitted session, estimated from the shading of these "
        "photographs"
    )


def _held_out(appearance: SkinAppearance) -> HoldOut:
    record = appearance.parameters.get("held_out", {})
    if not isinstance(record, dict):
        return HoldOut()
    return HoldOut(*(tuple(str(n) for n in record.get(name, ())) for name in ("lights", "views")))


def _explain_held_out(hold_out: HoldOut, light: str, view: str) -> str:
    kinds = [
        kind
        for kind, out in (("light", light in hold_out.lights), ("view", view in hold_out.views))
        if out
    ]
    return " and ".join(kinds)


def _select_evenly(shots: Sequence[HeldOutShot], count: int | None) -> tuple[HeldOutShot, ...]:
    if count is None or count >= len(shots):
        return tuple(shots)
    if count < 1:
        raise RenderingError(f"--photographs: got {count}, expected 1 or more; enter another")
    places = np.floor((np.arange(count) + 0.5) * len(shots) / count).astype(int)
    return tuple(shots[k] for k in places)
