"""Sensor `rigcamera`: a camera with square pixels and a lens with Brown's distortion.

.. code-block:: python

    "type": "rigcamera",
    "to_world": look_at(...),       # local +x left, +y up, +z forward, as of `perspective`
    "focal_px": 1200.0,
    "k1": 0.0, "k2": 0.0, "k3": 0.0, "p1": 0.0, "p2": 0.0,
    "film": {"type": "hdrfilm", "width": 1300, "height": 1030}

The optical axis passes the middle of the film. Slopes x (right) and y (down) of a ray appear at
the distorted slopes (1 + k1 r^2 + k2 r^4 + k3 r^6) (x, y) + tangential terms.

References
----------
Brown 1966, Decentering distortion of lenses.
"""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from capture.rig import View
from rigsim.mitsuba.plugin_class import define_plugin

UNDISTORT_STEPS: Final = 12
"""Fixed-point steps of the inverse; each gains a digit or more for lenses of a rig."""

DISTORTION_NAMES: Final = ("k1", "k2", "p1", "p2", "k3")
"""Coefficients of the distortion, in the order of `rigsim.as_built.dome`."""


def describe_camera(view: View, distortion: ArrayLike | None = None) -> dict[str, Any]:
    """Return the description of a rig's camera as a `rigcamera`, with its film.

    Parameters
    ----------
    view
        The camera.
    distortion
        k1, k2, p1, p2, k3; None for a pinhole.
    """
    right, up, back = (np.array(axis, np.float64) for axis in view.axes)
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([-right, up, -back, np.asarray(view.position_mm, np.float64)])
    values = np.zeros(len(DISTORTION_NAMES)) if distortion is None else np.asarray(distortion)
    return {
        "type": "rigcamera",
        "to_world": matrix,
        "focal_px": float(view.focal_px),
        **{name: float(v) for name, v in zip(DISTORTION_NAMES, values, strict=True)},
        "film": {
            "type": "hdrfilm",
            "width": view.width_px,
            "height": view.height_px,
            "rfilter": {"type": "box"},
        },
    }


class _RigCamera:
    """Camera; see the module."""

    mi: Any
    dr: Any
    film: Any
    sample_wavelengths: Any

    def __init__(self, properties: Any) -> None:
        mi, dr = self.mi, self.dr
        self.mi.Sensor.__init__(self, properties)
        self.focal_px = float(properties["focal_px"])
        if not 0.0 < self.focal_px < np.inf:
            raise ValueError(f"rigcamera, focal_px: got {self.focal_px:g}, expected above 0")
        self.distortion: Mapping[str, float] = {
            name: float(properties.get(name, 0.0)) for name in DISTORTION_NAMES
        }
        matrix = np.array(properties["to_world"].matrix, np.float64)
        # Opaque numbers: one kernel serves all cameras. Dr.Jit 1.5 resizes a literal 0 in place
        # when it is multiplied by an array; the next image with fewer rays then fails.
        left, up, forward, place = (
            mi.Vector3f(*(dr.opaque(mi.Float, float(v)) for v in column)) for column in matrix[:3].T
        )
        self._axes, self._place = (left, up, forward), mi.Point3f(place)

    def sample_ray(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[Any, Any]:
        mi, dr = self.mi, self.dr
        size = self.film().crop_size()
        x = (sample2.x - 0.5) * (size[0] / self.focal_px)
        y = (sample2.y - 0.5) * (size[1] / self.focal_px)
        if any(self.distortion.values()):
            x, y = self._undistort(x, y)
        left, up, forward = self._axes
        ray = dr.zeros(mi.Ray3f, dr.width(sample2))
        ray.o = self._place
        ray.d = dr.normalize(forward - x * left - y * up)
        ray.time, ray.maxt = time, dr.largest(mi.Float)
        ray.wavelengths, weight = self.sample_wavelengths(
            dr.zeros(mi.SurfaceInteraction3f), sample1, active
        )
        return ray, weight

    def sample_ray_differential(
        self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
    ) -> tuple[Any, Any]:
        mi = self.mi
        ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
        return mi.RayDifferential3f(ray), weight

    def _undistort(self, seen_x: Any, seen_y: Any) -> tuple[Any, Any]:
        k1, k2, p1, p2, k3 = (self.distortion[name] for name in DISTORTION_NAMES)
        x, y = seen_x, seen_y
        for _ in range(UNDISTORT_STEPS):
            square = x * x + y * y
            radial = 1.0 + square * (k1 + square * (k2 + square * k3))
            aside = 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
            below = 2.0 * p2 * x * y + p1 * (square + 2.0 * y * y)
            x, y = (seen_x - aside) / radial, (seen_y - below) / radial
        return x, y

    def bbox(self) -> Any:
        mi = self.mi
        place = np.array(self._place, np.float64).ravel().tolist()
        return mi.ScalarBoundingBox3f(place, place)

    def to_string(self) -> str:
        return f"RigCamera[focal_px = {self.focal_px:g}]"


def define_rig_camera(mi: Any) -> Any:
    """Return the class of the sensor for Mitsuba's active variant.

    Parameters
    ----------
    mi
        The module ``mitsuba`` with a variant.
    """
    return define_plugin(mi, mi.Sensor, _RigCamera)
