"""Draw the lumitexels of two points of a face: figure 5 of Weyrich et al. 2006.

A lumitexel has the BRDF samples of one point, one per camera and light. The figure shows those of
the camera that faces the point most, over the hemisphere of light directions above it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from capture.session import Session
from model import store
from model.skin import SkinAppearance
from model.skin_reflectance import NORMAL_MAPS
from reconstruction.lumitexels import SampledSurface
from reconstruction.lumitexels.ray_casting import RayCaster
from reconstruction.lumitexels.samples import MIN_VISIBLE_COSINE, compute_visibility
from reconstruction.lumitexels.store import LumitexelStore
from reconstruction.pipeline.dome.calibrated import CalibratedDome, load_dome
from reconstruction.pipeline.dome.images import DomeImages
from reconstruction.pipeline.inputs import Inputs
from skinrig import consent
from skinrig.analysing.brdf_space_figures import encode_figure, new_figure
from skinrig.arrays import BoolArray, Float64Array
from skinrig.atomic_file import write_atomically
from skinrig.errors import UnusableError
from skinrig.rendering.geometry import read_own_mesh

N_CANDIDATES: Final = 400
"""Texels among which points are chosen."""
MIN_FRONT_COSINE: Final = 0.6
"""Minimum cosine between the normal of a chosen point and +z."""
MAX_POINT_DISTANCE_MM: Final = 5.0
"""Maximum distance of a requested point from the surface."""
MIN_LIGHTS: Final = 4
"""Lights of a triangulated hemisphere."""
OUTPUT_FILES: Final = ("figure-5.png", "lumitexels.json")


@dataclass(frozen=True, slots=True, eq=False)
class DrawnLumitexel:
    """Samples of one point for one camera, in the frame of the point: z is the normal.

    Attributes
    ----------
    position_mm, normal
        Point and unit normal, rig frame, (3,).
    view_name
        Camera.
    light_dir
        Unit vectors to the lights, (L, 3).
    value
        pi times the mean BRDF of the channels: 1 for a perfect white, (L,); NaN if not valid.
    occluded
        Lights above the horizon that the point does not see, (L,).
    view_dir, mirror_dir
        Unit vectors to the camera, and its reflection about the normal, (3,).
    samples
        Valid samples of all cameras.
    """

    position_mm: Float64Array
    normal: Float64Array
    view_name: str
    light_dir: Float64Array
    value: Float64Array
    occluded: BoolArray
    view_dir: Float64Array
    mirror_dir: Float64Array
    samples: int

    def document(self) -> dict[str, Any]:
        """Return the lumitexel as JSON values."""
        valid = np.isfinite(self.value)
        return {
            "position_mm": self.position_mm.round(3).tolist(),
            "normal": self.normal.round(4).tolist(),
            "view": self.view_name,
            "samples_of_all_views": self.samples,
            "samples_of_the_view": int(valid.sum()),
            "occluded_lights": int(self.occluded.sum()),
            "view_dir": self.view_dir.round(4).tolist(),
            "mirror_dir": self.mirror_dir.round(4).tolist(),
            "light_dir": self.light_dir[valid].round(4).tolist(),
            "value": self.value[valid].round(5).tolist(),
        }


def analyze_lumitexels(
    out: Path,
    appearance: Path,
    session: Path,
    *,
    calibration: Path | None = None,
    points_mm: tuple[tuple[float, float, float], ...] = (),
    seed: int = 0,
) -> dict[str, Any]:
    """Draw lumitexels of points and write ``figure-5.png`` and ``lumitexels.json``.

    Parameters
    ----------
    out
        Folder to write.
    appearance
        APPEARANCE/ folder of the session, with mesh, positions and normals.
    session
        SESSION/ folder of the dome.
    calibration
        CALIBRATION/ folder; None: nominal poses of cameras and lights.
    points_mm
        Points near the surface, rig frame; none: one with many visible lights and one with many
        occluded ones.
    seed
        Seed of the candidates among which points are chosen.

    Raises
    ------
    UnusableError
        For another session, missing maps, or a point that is not on the surface.
    """
    read, opened = store.read(appearance), Session.open(session)
    if read.inputs.get("session") != opened.content_hash:
        raise UnusableError(
            f"{session}: got a session that {appearance} was not made of, expected its own; name it"
        )
    dome = load_dome(
        Inputs.of(opened, calibration, state="neutral", on_date=None), DomeImages(opened)
    )
    positions, normals = _surface_points(read)
    caster = _caster(read)
    chosen = (
        np.array([_find_point(positions, point) for point in points_mm])
        if points_mm
        else _choose_points(dome, caster, positions, normals, seed)
    )
    drawn = [_sample(dome, caster, positions[index], normals[index]) for index in chosen.tolist()]
    out.mkdir(parents=True, exist_ok=True)
    document = {
        "schema": "skinrig.lumitexels/1",
        "appearance": str(appearance),
        "session": opened.content_hash,
        "unit": "pi times the BRDF, mean of the channels: 1 for a perfect white",
        "frame": "x, y, z of the point: x to the right in the rig, z along the normal",
        consent.CONSENT_KEY: consent.merge_consent(read),
        "lumitexels": [one.document() for one in drawn],
    }
    write_atomically(out / OUTPUT_FILES[0], draw_lumitexels(drawn))
    text = json.dumps(document, indent=1, default=list) + "\n"
    write_atomically(out / OUTPUT_FILES[1], text)
    return document


def _surface_points(appearance: SkinAppearance) -> tuple[Float64Array, Float64Array]:
    """Return the valid texels' positions and normals, (P, 3)."""
    names = ["position", next((n for n in NORMAL_MAPS if n in appearance.maps), NORMAL_MAPS[-1])]
    for name in names:
        if name not in appearance.maps:
            raise UnusableError(
                f"appearance: got no map {name!r}, expected it; reconstruct with --maps normals"
            )
    place, facing = (appearance.maps[name] for name in names)
    good = place.mask & facing.mask
    normals = facing.values[good].astype(np.float64)
    return place.values[good].astype(np.float64), normals / np.linalg.norm(
        normals, axis=1, keepdims=True
    )


def _caster(appearance: SkinAppearance) -> RayCaster:
    mesh = read_own_mesh(appearance)
    return RayCaster(mesh.vertices_mm.astype(np.float64), mesh.faces)


def _find_point(positions: Float64Array, point: tuple[float, float, float]) -> int:
    """Return the texel nearest to a point."""
    distance = np.linalg.norm(positions - np.asarray(point), axis=1)
    nearest = int(np.argmin(distance))
    if distance[nearest] > MAX_POINT_DISTANCE_MM:
        x, y, z = positions[nearest].round(1).tolist()
        raise UnusableError(
            f"--at: got {point}, {distance[nearest]:.1f} mm from the measured skin, expected at "
            f"most {MAX_POINT_DISTANCE_MM:g} mm; the nearest point is {x:g},{y:g},{z:g}"
        )
    return nearest


def _choose_points(
    dome: CalibratedDome,
    caster: RayCaster,
    positions: Float64Array,
    normals: Float64Array,
    seed: int,
) -> Any:
    """Return a texel with many visible lights, and one with many occluded lights."""
    front = np.flatnonzero(normals[:, 2] >= MIN_FRONT_COSINE)
    if not len(front):
        raise UnusableError("appearance: got no texel that faces +z, expected a face; use --at")
    rng = np.random.default_rng(seed)
    some = np.sort(rng.permutation(front)[:N_CANDIDATES])
    surface = SampledSurface(positions[some].astype(np.float32), normals[some].astype(np.float32))
    seen = compute_visibility(
        surface,
        caster,
        cameras_mm=np.array([camera.center_mm for camera in dome.cameras]),
        lights_mm=dome.table.position_mm,
    ).light
    above = _above(dome.table.position_mm, positions[some], normals[some])
    return some[[int(np.argmax(seen.sum(axis=0))), int(np.argmax((above & ~seen).sum(axis=0)))]]


def _above(lights_mm: Float64Array, points: Float64Array, normals: Float64Array) -> BoolArray:
    """Return which lights are above the horizon of points, (L, P)."""
    way = lights_mm[:, None] - points[None]
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    return np.asarray(np.einsum("lpk,pk->lp", way, normals) > MIN_VISIBLE_COSINE)


def _sample(
    dome: CalibratedDome, caster: RayCaster, position: Float64Array, normal: Float64Array
) -> DrawnLumitexel:
    """Sample the photographs at one point, and keep the camera that faces it most."""
    surface = SampledSurface(position[None].astype(np.float32), normal[None].astype(np.float32))
    samples = LumitexelStore(
        surface,
        cameras=dome.cameras,
        lights=dome.lights,
        caster=caster,
        binning=2,
        dtype=np.float32,
    )
    for view in range(len(dome.cameras)):
        for capture in np.flatnonzero(dome.lights.valid).tolist():
            image = dome.image(view, capture)
            samples.add(view, capture, image.rgb, image.variance, image.valid)
    found = samples.chunk(0, 1)
    valid = found.valid[0]
    if not valid.any():
        x, y, z = position.round(1).tolist()
        raise UnusableError(f"--at {x:g},{y:g},{z:g}: no camera sees the point under a light")
    best = int(found.view[np.argmax(np.where(valid, found.cos_view[0], -1.0))])
    own = found.view == best
    frame = _point_frame(normal)
    view_dir = frame @ found.view_dir[0, own][0].astype(np.float64)
    lights = found.light_dir[0, own].astype(np.float64) @ frame.T
    value = np.where(valid[own], np.pi * found.f[0, own].mean(axis=-1), np.nan)
    return DrawnLumitexel(
        position,
        normal,
        dome.images.views[best],
        lights,
        value.astype(np.float64),
        (lights[:, 2] > MIN_VISIBLE_COSINE) & ~valid[own],
        view_dir,
        view_dir * [-1.0, -1.0, 1.0],
        int(valid.sum()),
    )


def _point_frame(normal: Float64Array) -> Float64Array:
    """Return the axes x, y, z of a point as rows: z is the normal, x to the right in the rig."""
    up = np.array([0.0, 1.0, 0.0]) if abs(normal[1]) < 0.95 else np.array([0.0, 0.0, -1.0])
    right = np.cross(up, normal)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(normal, right), normal])


def draw_lumitexels(drawn: list[DrawnLumitexel]) -> bytes:
    """Draw lumitexels side by side at one scale, as the bytes of a PNG.

    Parameters
    ----------
    drawn
        Lumitexels, at least one.
    """
    from matplotlib.tri import Triangulation

    figure, axes = new_figure(4.6 * len(drawn) + 0.6, 4.9, 1, len(drawn))
    highest = max(float(np.nanmax(one.value)) for one in drawn)
    shaded = None
    for axis, one in zip(axes[0], drawn, strict=True):
        turn = np.linspace(0.0, 2.0 * np.pi, 181)
        for angle in (30.0, 60.0, 90.0):
            radius = np.sin(np.radians(angle))
            axis.plot(radius * np.cos(turn), radius * np.sin(turn), color="0.8", lw=0.7, zorder=0)
            axis.annotate(f"{angle:g}°", (0.0, -radius), color="0.5", fontsize=7, va="top")
        good = np.isfinite(one.value)
        x, y = one.light_dir[:, 0], one.light_dir[:, 1]
        if np.count_nonzero(good) >= MIN_LIGHTS:
            mesh = Triangulation(x[good], y[good])
            shaded = axis.tripcolor(
                mesh, one.value[good], shading="gouraud", cmap="gray", vmin=0.0, vmax=highest
            )
        axis.plot(x[good], y[good], ".", color="#2a78b8", ms=5, label="light")
        if one.occluded.any():
            hidden = one.occluded
            axis.plot(x[hidden], y[hidden], "x", color="0.55", ms=5, label="light not seen")
        for way, color, label in (
            (one.view_dir, "#c8362c", "direction to the camera"),
            (one.mirror_dir, "#3f8f4f", "its reflection"),
        ):
            axis.plot(*way[:2], "o", color=color, ms=8, mec="white", label=label)
        place = ", ".join(f"{v:.0f}" for v in one.position_mm)
        axis.set_title(
            f"point at {place} mm, camera {one.view_name}\n"
            f"{np.count_nonzero(good)} of {one.samples} samples of all cameras",
            fontsize=9,
        )
        axis.set_xlabel("x of the direction to the light (right in the rig)", fontsize=8)
        axis.set_ylabel("y of the direction to the light (up)", fontsize=8)
        axis.set_xlim(-1.05, 1.05)
        axis.set_ylim(-1.1, 1.05)
        axis.set_aspect("equal")
        axis.tick_params(labelsize=7)
    marks = {
        label: mark
        for axis in axes[0]
        for mark, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    names, drawings = list(marks), list(marks.values())
    figure.legend(drawings, names, fontsize=8, loc="outside lower center", ncols=len(names))
    if shaded is not None:
        bar = figure.colorbar(shaded, ax=list(axes[0]), shrink=0.8)
        bar.set_label("pi x BRDF, mean of the channels (1: perfect white)", fontsize=8)
        bar.ax.tick_params(labelsize=7)
    return encode_figure(figure)
