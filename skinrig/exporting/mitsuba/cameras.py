"""Write a rig's cameras for Mitsuba: as `perspective`, and as the plugin `rigcamera`."""

from typing import Any, Final
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import ArrayLike

from capture.rig import View
from rigsim.mitsuba.rig_camera import describe_camera
from rigsim.mitsuba.scene_radiance import perspective
from skinrig.exporting.mitsuba.elements import build_plugin, build_pose, build_property

NESTED_ENTRIES: Final = ("to_world", "film", "type")
"""Entries of a camera's description that are not numbers."""


def describe_view(view: View) -> Element:
    """Return a pinhole camera with square pixels, its principal point in the image's center."""
    about = perspective(view, "rgb")
    names = ("fov", "fov_axis", "near_clip", "far_clip")
    return build_plugin(
        "sensor",
        about["type"],
        *(build_property(name, about[name]) for name in names),
        build_pose(view.position_mm, view.target_mm, view.up),
        *_describe_film(view),
        id=view.name,
    )


def describe_rig_camera(view: View, distortion: ArrayLike | None = None) -> Element:
    """Return the camera as the plugin `rigcamera`.

    Parameters
    ----------
    view
        The camera.
    distortion
        k1, k2, p1, p2, k3 of its lens; None for a pinhole.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> camera = describe_rig_camera(load_rig("flash").views[0], [-0.1, 0.0, 0.0, 0.0, 0.0])
    >>> camera.get("type"), [n.get("value") for n in camera if n.get("name") == "k1"]
    ('rigcamera', ['-0.1'])
    """
    about = describe_camera(view, distortion)
    return build_plugin(
        "sensor",
        about["type"],
        *(build_property(k, v) for k, v in about.items() if k not in NESTED_ENTRIES),
        build_pose(view.position_mm, view.target_mm, view.up),
        *_describe_film(view),
        id=view.name,
    )


def _describe_film(view: View) -> tuple[Element, Element]:
    """Return the sampler and the film with a box filter."""
    film = perspective(view, "rgb")["film"]
    sampler = build_plugin("sampler", "independent")
    sampler.append(Element("integer", {"name": "sample_count", "value": "$samples"}))
    names = ("width", "height", "pixel_format")
    rfilter = build_plugin("rfilter", film["rfilter"]["type"])
    properties = (build_property(name, film[name]) for name in names)
    return sampler, build_plugin("film", film["type"], *properties, rfilter)


def record_view(view: View, gain: float, distortion: ArrayLike | None = None) -> dict[str, Any]:
    """Return a camera as JSON values."""
    return {
        "name": view.name,
        "position_mm": list(view.position_mm),
        "target_mm": list(view.target_mm),
        "up": list(view.up),
        "focal_px": view.focal_px,
        "distortion": (np.zeros(5) if distortion is None else np.asarray(distortion)).tolist(),
        "size_px": [view.width_px, view.height_px],
        "gain": gain,
    }
