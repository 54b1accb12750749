"""Assemble the gradient rig's ground truth: maps of each state on the camera's pixels."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from rigsim import shading
from rigsim.arrays import Float32Array, Float64Array
from rigsim.as_built.sphere import ActualSphere
from rigsim.light.lobe_moments import MicrofacetSurface, led_moments
from rigsim.render.lens_blur import blur_images
from rigsim.scenes.gradient.patch import SHADOW_MARGIN_PX, PatchSurface
from rigsim.world.taped_skin import GripState

if TYPE_CHECKING:
    from rigsim.scenes.gradient.scene import GradientScene


MAX_SURFACE_PX: Final = 512
"""Pixels across the surface of `scene_surface`, without margins: 12 MB before compression."""


def format_state_name(angle_deg: float, step: int) -> str:
    """Format the name of a strain step of the caliper.

    Examples
    --------
    >>> format_state_name(45.0, -2), format_state_name(0.0, 0), format_state_name(135.0, 3)
    ('a045_m2', 'a000_n0', 'a135_p3')
    """
    sign = "n" if step == 0 else "m" if step < 0 else "p"
    return f"a{round(angle_deg):03d}_{sign}{abs(step)}"


def gradient_truth(scene: GradientScene, grips: Sequence[GripState]) -> SkinAppearance:
    """Return the ground truth of some states.

    Parameters
    ----------
    scene
        A patch of skin.
    grips
        The states; the first with step 0 is the neutral reference of the others.

    Returns
    -------
    SkinAppearance
        Maps of each state at pixel centers, without drift: ``height_<state>``, the relief alone in
        um; ``bulged_height_<state>`` with bulge and fold below it; ``normals_<state>``, of
        both; ``normals_seen_<state>``, their slopes averaged as lens and pixels average light;
        ``albedo_<state>``. The neutral state's are also ``height`` and ``normals``. Valid on skin.
        ``parameters``: ``states``, ``led_truth``, ``lens``.

    Raises
    ------
    ValueError
        None of the states is neutral.
    """
    neutral = next((grip for grip in grips if grip.step == 0), None)
    if neutral is None:
        raise ValueError("grips: got no state with step 0, expected the neutral one")
    maps: dict[str, SkinMap] = {}
    states = []
    names = set()
    first = _placement(scene, neutral)
    for grip in grips:
        name = format_state_name(grip.angle_deg, grip.step)
        if name in names:
            continue
        names.add(name)
        patch = scene.surface(grip)
        for kind, skin_map in _maps(scene, patch).items():
            maps[f"{kind}_{name}"] = skin_map
            if grip is neutral and kind in ("height", "normals"):
                maps[kind] = skin_map
        relief, pose = scene.relief(grip), scene.pose(grip)
        states.append(
            {
                "name": name,
                "angle_deg": grip.angle_deg,
                "step": grip.step,
                "aperture_mm": grip.aperture_mm,
                "stretch_s": relief.stretch_s,
                "stretch_t": relief.stretch_t,
                "gradient": (_placement(scene, grip) @ np.linalg.inv(first)).tolist(),
                "shift_mm": [pose.x_mm, pose.y_mm],
                "rotation_rad": pose.rotation_rad,
                "membrane_strain": relief.membrane_strain,
                "attached": grip.attached,
                "buckled": grip.buckled,
            }
        )
    lens = scene.lens
    skin = scene.skin
    rough = float(np.median(skin.alpha))
    parameters: dict[str, object] = {
        "states": states,
        "site": skin.site,
        "melanin": skin.skin.c_m,
        "blood": skin.skin.c_hd,
        "subject_seed": skin.seed,
        "alpha": rough,
        "lights": led_truth(scene.sphere, scene.optical_surface(rough)),
        "lens": {
            "working_f_number": lens.working_f_number,
            "pixel_um": lens.pixel_on_subject_um,
            "cutoff_period_um": lens.cutoff_period_um,
            "mean_wavelength_nm": lens.mean_wavelength_nm,
        },
        "analyzer_zero_deg": scene.films.analyzer_zero_deg,
        "drift_um": 0.0 if scene.motion is None else scene.motion.drift_um,
    }
    return SkinAppearance(
        maps, "simulated", parameters=parameters, left_out=tuple(scene.omitted), seed=scene.seed
    )


def scene_surface(
    scene: GradientScene, grips: Sequence[GripState]
) -> dict[str, NDArray[np.generic]]:
    """Return the surface of the first neutral state for other renderers.

    Parameters
    ----------
    scene
        A patch of skin.
    grips
        The states; one has step 0.

    Returns
    -------
    dict
        The fields of `PatchSurface` at pixel centers, up to `MAX_SURFACE_PX` around the image's
        center and with `SHADOW_MARGIN_PX` more on all sides, without drift. ``unit``: full scales
        per second per unit of radiance of `rigsim.light.lobe_moments`.
    """
    neutral = next(grip for grip in grips if grip.step == 0)
    view = scene.rig.views[0]
    beyond = max(0, (max(view.width_px, view.height_px) - MAX_SURFACE_PX) // 2)
    wide = scene.surface(neutral, border_px=max(0, SHADOW_MARGIN_PX - beyond))
    patch = wide.crop(max(0, beyond - SHADOW_MARGIN_PX))
    arrays = {one.name: getattr(patch, one.name) for one in dataclasses.fields(patch)}
    return {**arrays, "unit": np.array(scene.unit)}


def _placement(scene: GradientScene, grip: GripState) -> Float64Array:
    """Return the gradient of the map from relaxed skin to the rig, rotation included, (2, 2)."""
    turn = scene.pose(grip).rotation_rad
    c, s = np.cos(turn), np.sin(turn)
    return np.asarray(np.array([[c, -s], [s, c]]) @ np.asarray(scene.relief(grip).gradient))


def _maps(scene: GradientScene, patch: PatchSurface) -> dict[str, SkinMap]:
    skin = patch.skin

    def one(values: Float32Array, unit: str, text: str) -> SkinMap:
        return SkinMap(values, unit, valid=skin, description=text)

    slopes = -patch.normals[..., :2] / patch.normals[..., 2:]
    seen = blur_images(np.moveaxis(slopes, -1, 0), scene.lens, depth_mm=patch.height_mm)
    normals = np.stack([-seen[0], -seen[1], np.ones_like(seen[0])], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return {
        "height": one(patch.relief_um, "um", "relief without bulge and fold, points"),
        "bulged_height": one(patch.relief_um + patch.bulge_um, "um", "with bulge and fold"),
        "normals": one(
            patch.normals, MAP_UNITS["normals"], "rig frame, with bulge and fold, points"
        ),
        "normals_seen": one(normals, "1", "slopes averaged as the lens and the pixels do"),
        "albedo": one(patch.albedo, "1", "diffuse reflectance in the camera's band"),
    }


def led_truth(sphere: ActualSphere, surface: MicrofacetSurface) -> list[dict[str, object]]:
    """Return the ground truth of the LEDs, for the evaluation of their calibration.

    Parameters
    ----------
    sphere
        The actual LEDs.
    surface
        The reflection; its roughness does not matter, since only facets that mirror the LED are
        used.

    Returns
    -------
    list of dict
        In the order of the rig: ``name``; ``direction``, unit, from the origin; ``intensity``, the
        irradiance at the origin over its mean over all LEDs; ``leakage``, the transmittance of an
        ideal analyzer at reading 90 over that at 0, of a mirroring facet, with the camera above;
        None instead of NaN where no facet mirrors the LED.
    """
    place = sphere.position_mm
    distance = np.linalg.norm(place, axis=1)
    power = sphere.intensity / distance**2
    power = power / power.mean()
    eye = np.array(surface.eye_mm) / np.linalg.norm(surface.eye_mm)
    out: list[dict[str, object]] = []
    for led, light in enumerate(sphere.nominal.lights):
        direction = place[led] / distance[led]
        facet = direction + eye
        leakage = None
        if np.linalg.norm(facet) > 1e-3 and sphere.intensity[led] > 0.0:
            facet /= np.linalg.norm(facet)
            stokes, _ = led_moments(facet[None], np.zeros((1, 3)), sphere, led, surface)
            through = _analyzer_transmittance(stokes, eye, surface)
            leakage = float(through[1] / through[0])
        out.append(
            {
                "name": light.name,
                "direction": direction.tolist(),
                "intensity": float(power[led]),
                "leakage": leakage,
            }
        )
    return out


def _analyzer_transmittance(
    stokes: Float32Array, eye: Float64Array, surface: MicrofacetSurface
) -> tuple[float, float]:
    right = np.array(surface.image_right)
    up = np.cross(eye, right)
    parallel, crossed = (
        float(
            shading.apply_analyzer(
                stokes, eye[None], passes_deg=angle, image_right=right, image_up=up
            )[0]
        )
        for angle in (90.0, 180.0)
    )
    return parallel, crossed
