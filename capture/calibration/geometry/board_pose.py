"""Poses of a flat target, and residuals of its corners."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from capture.arrays import Float64Array
from capture.calibration.geometry.board import Board, CornerObservation
from capture.calibration.geometry.intrinsics import CameraPose


class FlatTarget(Protocol):
    """A flat target with known points."""

    @property
    def points_mm(self) -> Float64Array:
        """Points in the target's own axes, shape (N, 3), z = 0."""


@dataclass(frozen=True, slots=True, eq=False)
class BoardPose:
    """Pose of a board: ``x_rig = rotation x_board + translation_mm``."""

    rotation: Float64Array
    translation_mm: Float64Array

    def to_rig(self, points_mm: Float64Array) -> Float64Array:
        """Return points of the board in the rig frame."""
        return points_mm @ self.rotation.T + self.translation_mm

    @classmethod
    def to_jig_pose(cls, board: Board) -> BoardPose:
        """Return the jig's pose: the board's center in the rig's origin, its front towards +z."""
        width, height = board.size_mm
        rotation = np.diag([1.0, -1.0, -1.0])
        return cls(rotation, -rotation @ np.array([width / 2, height / 2, 0.0]))


def corner_residuals_px(
    camera: CameraPose, pose: BoardPose, board: FlatTarget, sighting: CornerObservation
) -> Float64Array:
    """Return the distance of corners from their projections, px, shape (n,)."""
    found = camera.project(pose.to_rig(board.points_mm[sighting.ids]))
    return np.asarray(np.linalg.norm(found - sighting.pixels, axis=-1))


def relative_motion(a: BoardPose, b: BoardPose) -> tuple[Float64Array, Float64Array]:
    """Return the rigid motion from pose a to pose b."""
    rotation = b.rotation @ a.rotation.T
    return rotation, b.translation_mm - rotation @ a.translation_mm


def move_pose(pose: BoardPose, rotation: Float64Array, shift: Float64Array) -> BoardPose:
    """Return a pose after a rotation, (3, 3), and a translation, mm, of its frame."""
    return BoardPose(rotation @ pose.rotation, rotation @ pose.translation_mm + shift)
