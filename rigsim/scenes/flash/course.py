"""Render a face in the flash rig whose blood follows a course in time.

The light of an image is a smooth function of the blood level. It is rendered at three levels of
each pose and interpolated in between by the parabola through them. A sequence of any number of
images therefore costs three renders, six where the face moves.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from capture.rig import Rig
from rigsim.arrays import Float32Array, UInt16Array
from rigsim.boxes.flash import FlashPop
from rigsim.caching import cached_method
from rigsim.mitsuba.variant import VariantChoice
from rigsim.needs.effects import EffectSelection, omitted_effects
from rigsim.scenes.exposing import RigScene, SceneError
from rigsim.scenes.flash.scene import POP_ENERGY_DEVIATION, FlashScene, pop_energy
from rigsim.sensor import Sensor
from rigsim.subject import SimulatedSubject, landmarks
from rigsim.subject.perfusion_course import PerfusionCourse, fix_blood_level

BLOOD_LEVELS: Final = (0.0, 0.5, 1.0)
"""Rendered levels of the blood."""


@dataclass(frozen=True, slots=True)
class FlashEvent:
    """State of the face at a flash."""

    token: str
    """Name of the flash."""
    t_s: float
    """World time, s."""
    level: float
    """Blood level of the state, 0 to 1."""
    pose: str
    """State whose movement the face shows."""


class FlashCourseScene(RigScene):
    """A face in the flash rig; see `rigsim.scenes.flash.scene.FlashScene`.

    Parameters
    ----------
    rig
        The flash rig.
    subject
        The face at rest.
    course
        Course of its blood.
    seed
        Seeds the variation between pops.
    movement
        Whether the face moves with the expression, or only its blood changes.
    on_flash
        Called with each flash that a camera recorded.
    choice
        Mitsuba variant; ``None`` chooses.
    """

    def __init__(
        self,
        rig: Rig,
        subject: SimulatedSubject,
        course: PerfusionCourse,
        *,
        seed: int = 0,
        movement: bool = True,
        on_flash: Callable[[FlashEvent], None] | None = None,
        choice: VariantChoice | None = None,
    ) -> None:
        self.rig, self.subject, self.course = rig, subject, course
        self.seed, self.movement, self._on_flash = seed, movement, on_flash
        self._choice = choice

    def scene_at(self, pose: str, level: float) -> FlashScene:
        """Return the scene of a pose and one of `BLOOD_LEVELS`; those of a pose share rays."""
        return self._scene(pose if self.movement else "neutral", level)

    @cached_method
    def _scene(self, pose: str, level: float) -> FlashScene:
        subject = fix_blood_level(self.subject, self.course.state, level)
        return FlashScene(self.rig, subject, state=pose, seed=self.seed, choice=self._choice)

    @property
    def variant(self) -> VariantChoice:
        """Return the variant that renders the images, with the reason."""
        return self.scene_at("neutral", BLOOD_LEVELS[0]).variant

    @cached_property
    def needs(self) -> EffectSelection:  # type: ignore[override]
        """Effects with their verdicts and reasons."""
        whole = self.scene_at(self.course.state, 1.0).needs
        return EffectSelection((*whole, *omitted_effects("course")))

    def sensor(self, view_name: str | None = None) -> Sensor:
        """Return the sensor of a view; None takes the first."""
        return self.scene_at("neutral", BLOOD_LEVELS[0]).sensor(view_name)

    def radiance(
        self,
        pose: str,
        level: float,
        polarizer: str = "crossed",
        analyzer_deg: float | None = None,
        *,
        view_name: str | None = None,
    ) -> Float32Array:
        """Return the light on the sensor at power 1 with blood at any level, shape (H, W, 3)."""
        total = None
        for node, weight in zip(BLOOD_LEVELS, blood_level_weights(level), strict=True):
            if weight == 0.0:
                continue
            shown = pose if self.movement else "neutral"
            image = self._image(shown, node, polarizer, analyzer_deg, view_name)
            part = np.float32(weight) * image
            total = part if total is None else total + part
        if total is None:  # the weights sum to one
            raise SceneError(f"level: got {level}, expected 0 to 1")
        return np.maximum(total, 0.0)

    def exposure(
        self, view_name: str, *, pops: Sequence[FlashPop], exposure_s: float, seed: int
    ) -> UInt16Array:
        """Simulate one exposure of a camera, with the blood at each pop; see `FlashScene`."""

        def image(pop: FlashPop) -> Float32Array:
            level, pose = self.course.level(pop.t_s), self.course.pose(pop.t_s)
            if self._on_flash is not None:
                self._on_flash(FlashEvent(pop.token, pop.t_s, level, pose))
            return self.radiance(pose, level, pop.polarizer, pop.analyzer_deg, view_name=view_name)

        return self._expose(
            self._camera(view_name),
            pops,
            pop_energy,
            image,
            deviation=POP_ENERGY_DEVIATION,
            exposure_s=exposure_s,
            seed=seed,
        )

    @cached_method
    def _image(
        self, pose: str, level: float, polarizer: str, analyzer_deg: float | None, view: str | None
    ) -> Float32Array:
        return self.scene_at(pose, level).radiance(polarizer, analyzer_deg, view_name=view)

    def landmarks_px(self, pose: str = "neutral") -> dict[str, tuple[float, float]]:
        """Return the positions of named skin points in the first camera's image of a pose.

        Returns
        -------
        dict
            Name to (x, y), px of the sensor, including occluded points.
        """
        face = self.scene_at(pose, BLOOD_LEVELS[0]).subject
        if not isinstance(face, SimulatedSubject):
            raise SceneError(f"landmarks: got {face.name!r}, expected a face")
        points = face.surface_landmarks()
        pixels = landmarks.project_points(points.positions_on(face.mesh), self.rig.views[0])
        return {n: (float(x), float(y)) for n, (x, y) in zip(points.names, pixels, strict=True)}

    def hemoglobin(self, pose: str, levels: Sequence[float]) -> Float32Array:
        """Return the first camera's blood volume fraction, (len(levels), H, W), 0 to 0.32."""
        nodes = np.stack([self.scene_at(pose, node).truth()["hemoglobin"] for node in BLOOD_LEVELS])
        weights = np.array([blood_level_weights(level) for level in levels])
        return np.tensordot(weights, nodes, axes=1).astype(np.float32)

    def truth(self, pose: str, level: float) -> Mapping[str, NDArray[np.generic]]:
        """Return `FlashScene.truth` of a pose at one of `BLOOD_LEVELS`."""
        return self.scene_at(pose, level).truth()


def blood_level_weights(level: float) -> tuple[float, float, float]:
    """Return interpolation weights of `BLOOD_LEVELS` for a level from 0 to 1; they sum to 1.

    They are the Lagrange polynomials of the parabola through the three levels.

    Examples
    --------
    >>> blood_level_weights(0.25)
    (0.375, 0.75, -0.125)
    """
    a, b, c = BLOOD_LEVELS
    return (
        (level - b) * (level - c) / ((a - b) * (a - c)),
        (level - a) * (level - c) / ((b - a) * (b - c)),
        (level - a) * (level - b) / ((c - a) * (c - b)),
    )
