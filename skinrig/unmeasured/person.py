"""Assemble a person for display: the scan, and parts that no rig measured, marked as such."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from model.skin import SkinAppearance
from rigsim.face_parts.eyelids import EyelidError, Eyelids
from rigsim.face_parts.hair import Hair, draw_hair
from rigsim.geometry.atlas import unwrap
from rigsim.geometry.mesh import Mesh, build_mesh
from rigsim.subject.pigment import nearest_preset
from skinrig.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int64Array
from skinrig.rendering.geometry import read_own_mesh
from skinrig.rendering.hole_patches import (
    GRID_CELLS,
    PATCH_MARGIN,
    ClosedMesh,
    close_holes,
    place_disc,
)
from skinrig.unmeasured.completion import CompletedHead, complete_head
from skinrig.unmeasured.head_fit import FittedHead, fit_head
from skinrig.unmeasured.lids import cut_lids
from skinrig.unmeasured.rim import RimError

HEAD_FILE: Final = "unmeasured_head.npz"
"""Mean head fitted to the scan, in an appearance."""
UNMEASURED_KEY: Final = "unmeasured"
"""Key in `parameters`: parts that no rig measured, with their source and errors."""
FACE_PARTS: Final = ("eyes", "lids", "lashes", "brows")
HAIR_PART: Final = "hair"
HEAD_REGIONS: Final = ("crown", "neck", "sides of the head", "upper face", "lower face")
"""Regions of the mean head, see `_divide`."""
CROWN_MM: Final = 88.0
NECK_MM: Final = -75.0
SIDES_MM: Final = -45.0
"""Heights above which the crown begins and below which the neck does; depth of the sides."""
MIN_NAMED_FRACTION: Final = 0.005
"""Least filled fraction of a region that is named."""
MIN_CHART_RADIUS: Final = 0.02
"""Least radius of the added surface's disc in the texture, texture units."""
MELANIN_MAP: Final = "melanin"


@dataclass(frozen=True, slots=True, eq=False)
class FaceParts:
    """Eyes behind lids that open, and hair, on a mesh.

    Attributes
    ----------
    lids
        Lids of both eyes, on the image's right (x > 0) and left.
    hair
        Brows, lashes and hair of the scalp.
    label
        What the parts are, for display.
    names
        Names of the parts.
    """

    lids: tuple[Eyelids, Eyelids]
    hair: Hair
    label: str
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class HeadChart:
    """Square of the texture for the added surface.

    Attributes
    ----------
    head
        Added surface.
    center : ndarray of float64, shape (2,)
    side : float
        Length of its sides, texture units.
    rim_uv : ndarray of float64, shape (r, 2)
        Texture coordinates of the rim on the scan.
    """

    head: CompletedHead
    center: Float64Array
    side: float
    rim_uv: Float64Array

    def texture(self) -> Float64Array:
        """Return the texture coordinates of the added surface's vertices, shape (r + m, 2)."""
        return np.asarray(self.center + self.side * (self.head.plane - 0.5))

    def paint(self, values: FloatArray) -> Float32Array:
        """Return values, (..., H, W, C) or (H, W), with those of the rim on the added surface.

        Row 0 is at v = 1. The rim's texels must have values.
        """
        from scipy.interpolate import LinearNDInterpolator

        layers = np.array(values if values.ndim > 2 else values[..., None], np.float32)
        height, width, channels = layers.shape[-3:]
        if min(height, width) < 2:  # one value for the whole face
            return layers.reshape(values.shape)
        flat = layers.reshape(-1, height, width, channels)
        rim = np.concatenate([_sample(one, self.rim_uv) for one in flat], axis=-1)
        drawn = self.head.interpolate_from_rim(rim)
        reach = 0.5 * self.side + 0.5 * PATCH_MARGIN
        x0, y0 = self.center
        j = np.arange(max(int((x0 - reach) * width), 0), min(int((x0 + reach) * width) + 1, width))
        top, bottom = int((1.0 - y0 - reach) * height), int((1.0 - y0 + reach) * height) + 1
        i = np.arange(max(top, 0), min(bottom, height))
        x, y = np.meshgrid((j + 0.5) / width - x0, 1.0 - (i + 0.5) / height - y0)
        # beyond the square, values of its sides, for texture filters
        at = np.clip(np.stack([x, y], axis=-1) / self.side + 0.5, 0.0, 1.0)
        found = LinearNDInterpolator(self.head.plane, drawn)(at)
        found = found.reshape(*at.shape[:2], len(flat), channels)
        block = flat[:, i[0] : i[-1] + 1, j[0] : j[-1] + 1]
        new = np.moveaxis(found, 2, 0)
        block[...] = np.where(np.isnan(new), block, new)
        return layers.reshape(values.shape)


def _sample(layer: Float32Array, uv: Float64Array) -> Float64Array:
    """Return a map's bilinear values at texture coordinates, (N, C)."""
    from scipy import ndimage

    height, width, _ = layer.shape
    at = [(1.0 - uv[:, 1]) * height - 0.5, uv[:, 0] * width - 0.5]
    planes = np.moveaxis(layer, -1, 0)
    drawn = [ndimage.map_coordinates(one, at, order=1, mode="nearest") for one in planes]
    return np.stack(drawn, axis=-1).astype(np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class DisplayedPerson:
    """A scan with the parts that no rig measured.

    Attributes
    ----------
    mesh
        The scan within its smooth rim, the added surface, and vertices along the lids.
    filled : ndarray of bool, shape (V,)
        Whether the position of a vertex is the fitted head's; other vertices are on the scan.
    stderr_mm : ndarray of float64, shape (V,)
        Standard error of the filled vertices across the surface, 0 for others.
    fractions
        Filled fraction of the whole surface, "head", and of `HEAD_REGIONS`, by area, 0 to 1.
    closed
        The scan with closed holes.
    chart
        Texture of the added surface; None: the scan keeps its rim.
    parts
        Eyes and hair; None: left out.
    left_out
        Parts that could not be added, with reasons.
    """

    mesh: Mesh
    filled: BoolArray
    stderr_mm: Float64Array
    fractions: Mapping[str, float]
    closed: ClosedMesh
    chart: HeadChart | None
    parts: FaceParts | None
    left_out: tuple[tuple[str, str], ...]

    @property
    def charts(self) -> tuple[object, ...]:
        """Charts of the closed holes."""
        return self.closed.charts

    def paint(self, values: FloatArray) -> Float32Array:
        """Return values with closed holes and the added surface, see `HeadChart.paint`."""
        drawn = self.closed.paint(values)
        return drawn if self.chart is None else self.chart.paint(drawn)

    @property
    def regions(self) -> tuple[str, ...]:
        """Regions of the surface that are the fitted head's, at least in part."""
        return tuple(n for n in HEAD_REGIONS if self.fractions.get(n, 0.0) >= MIN_NAMED_FRACTION)

    @property
    def names(self) -> tuple[str, ...]:
        """Displayed parts that no rig measured."""
        return (*(() if self.parts is None else self.parts.names), *self.regions)

    def added(self) -> tuple[tuple[str, str], ...]:
        """Return the displayed parts that were not measured, with their source and error."""
        rows = [*self.closed.added()]
        if self.regions:
            errors = self.stderr_mm[self.filled]
            each = ", ".join(
                f"{name} {100.0 * self.fractions[name]:.0f} %" for name in self.regions
            )
            rows.append(
                (
                    ", ".join(self.regions),
                    f"{100.0 * self.fractions['head']:.0f} % of the displayed surface ({each}); "
                    "the mean head, fitted to the scan, standard error "
                    f"{errors.min():.2f} to {errors.max():.2f} mm, with colors of the scan's rim",
                )
            )
        if self.parts is not None:
            rows.append((", ".join(self.parts.names), self.parts.label))
        return tuple(rows)

    def omitted(self) -> tuple[tuple[str, str], ...]:
        """Return what is not displayed, with reasons."""
        return (*self.closed.omitted(), *self.left_out)


def fit_unmeasured(
    appearance: SkinAppearance, landmarks_mm: Mapping[str, tuple[float, float, float]] | None
) -> tuple[dict[str, bytes], dict[str, Any], tuple[tuple[str, str], ...]]:
    """Fit the mean head to the mesh of an appearance, and try which parts it adds.

    Parameters
    ----------
    appearance
        With the mesh of its maps.
    landmarks_mm
        Points of the mesh by name that guide the fit.

    Returns
    -------
    files
        `HEAD_FILE`; none if the page can add no part.
    description
        Parts, source and errors, as JSON values.
    left_out
        Parts that cannot be added, with reasons.

    Raises
    ------
    skinrig.unmeasured.head_fit.HeadFitError, reconstruction.scan.repair.ScanMeshError
        If the mesh is not a face that looks along +z.
    rigsim.geometry.mesh.MeshError, skinrig.rendering.geometry.GeometryError
        If the mesh is not readable, or has no texture coordinates.
    """
    mesh = read_own_mesh(appearance)
    fitted = fit_head(mesh, landmarks_mm)
    files = {HEAD_FILE: fitted.to_bytes()}
    with_head = replace(appearance, files={**appearance.files, **files})
    person = assemble_person(with_head, close_holes(mesh), 0)
    if not person.names:
        return {}, {}, person.left_out
    errors = fitted.stderr_mm[~fitted.measured]
    described = {
        "parts": list(person.names),
        "measured": False,
        "source": "mean of simulated heads, fitted to the scan",
        "file": HEAD_FILE,
        "median_stderr_mm": round(float(np.median(errors)), 3) if errors.size else 0.0,
        "filled_fraction": round(person.fractions.get("head", 0.0), 3),
    }
    return files, described, person.left_out


def assemble_person(appearance: SkinAppearance, closed: ClosedMesh, seed: int) -> DisplayedPerson:
    """Add the parts of an appearance that no rig measured to its mesh.

    Parameters
    ----------
    appearance
        With `HEAD_FILE`.
    closed
        Mesh of its maps with closed holes.
    seed
        Seed of the hair, >= 0.

    Raises
    ------
    skinrig.unmeasured.head_fit.HeadFitError
        If the file is damaged.
    """
    fitted = FittedHead.from_bytes(appearance.files[HEAD_FILE], HEAD_FILE)
    left_out = []
    scan = closed.mesh
    none = np.zeros(len(scan.vertices_mm))
    person = DisplayedPerson(scan, none > 0.0, none, {}, closed, None, None, ())
    try:
        person = _complete(person, fitted)
    except RimError as error:
        left_out.append(("crown and neck", str(error)))
    try:
        mesh, lids = cut_lids(person.mesh, fitted, person.filled)
    except EyelidError as error:
        left_out.append(("eyes and hair", str(error)))
        return replace(person, left_out=tuple(left_out))
    hair = _draw_hair(mesh, lids, fitted, _preset(appearance), seed)
    names: tuple[str, ...] = FACE_PARTS
    if hair.counts[2]:
        names = (*names, HAIR_PART)
    else:
        left_out.append(("hair of the scalp", "the displayed surface ends below the hairline"))
    label = (
        "captured with closed eyes; from the mean head, fitted to the scan; hair and irises are "
        "random, their colors typical of the skin's melanin"
    )
    added = np.zeros(len(mesh.vertices_mm) - len(person.mesh.vertices_mm))
    return replace(
        person,
        mesh=mesh,
        filled=np.concatenate([person.filled, added > 0.0]),
        stderr_mm=np.concatenate([person.stderr_mm, added]),
        parts=FaceParts(lids, hair, label, names),
        left_out=tuple(left_out),
    )


def _complete(person: DisplayedPerson, fitted: FittedHead) -> DisplayedPerson:
    """Trim the scan and add the fitted head around it."""
    scan = person.mesh
    head = complete_head(scan, fitted)
    trimmed = head.trimmed
    uv = trimmed.carry(scan.uv)
    inside = build_mesh(head.measured_mm, trimmed.faces, uv)
    place = place_disc(unwrap(inside, GRID_CELLS).covered, 0.5, min_scale=2.0 * MIN_CHART_RADIUS)
    if place is None:
        raise RimError("texture: got no space for the added surface, expected some")
    center, radius = place
    chart = HeadChart(head, center, float(np.sqrt(2.0) * radius), uv[trimmed.rim])
    count = len(head.measured_mm)
    faces: Int64Array = np.concatenate([trimmed.faces, head.faces + count])
    mesh = build_mesh(
        np.concatenate([head.measured_mm, head.filled_mm]),
        faces,
        np.concatenate([uv, chart.texture()]),
    )
    filled = np.arange(len(mesh.vertices_mm)) >= count + head.rim_count
    errors = np.concatenate([np.zeros(count), head.stderr_mm])
    return replace(
        person,
        mesh=mesh,
        filled=filled,
        stderr_mm=np.where(filled, errors, 0.0),
        fractions=_divide(mesh, len(trimmed.faces), fitted),
        chart=chart,
    )


def _divide(mesh: Mesh, measured: int, fitted: FittedHead) -> dict[str, float]:
    """Return the fractions of the head and its regions that triangles after the first fill."""
    corners = mesh.vertices_mm[mesh.faces].astype(np.float64)
    sides = corners[:, 1:] - corners[:, :1]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    rotation, shift, scale = fitted.locate_head()
    _, y, z = ((corners.mean(axis=1) - shift) @ rotation / scale).T
    chosen = [y > CROWN_MM, y < NECK_MM, z < SIDES_MM, y >= 0.0]
    region = np.select(chosen, range(len(chosen)), len(chosen))
    is_filled = np.arange(len(area)) >= measured
    found = {"head": float(area[is_filled].sum() / area.sum())}
    for number, name in enumerate(HEAD_REGIONS):
        here = region == number
        whole = float(area[here].sum())
        found[name] = float(area[here & is_filled].sum()) / whole if whole > 0.0 else 0.0
    return found


def _preset(appearance: SkinAppearance) -> str:
    """Return the skin type whose melanin is nearest to the measured one."""
    found = appearance.maps.get(MELANIN_MAP)
    if found is None or not found.mask.any():
        return "III"
    return nearest_preset(max(float(np.median(found.values[found.mask])), 1e-4))


def _draw_hair(
    mesh: Mesh, lids: tuple[Eyelids, Eyelids], fitted: FittedHead, preset: str, seed: int
) -> Hair:
    """Draw hair in the frame of the mean head, at its size."""
    rotation, shift, scale = fitted.locate_head()
    there = replace(
        mesh,
        vertices_mm=((mesh.vertices_mm - shift) @ rotation / scale).astype(np.float32),
        normals=(mesh.normals @ rotation).astype(np.float32),
    )
    turned = [
        replace(
            one,
            center_mm=(one.center_mm - shift) @ rotation / scale,
            opening_mm=one.opening_mm @ rotation / scale,
            arc_mm=one.arc_mm @ rotation / scale,
        )
        for one in lids
    ]
    hair = draw_hair(there, preset, seed=seed, lids=(turned[0], turned[1]))
    return replace(
        hair,
        points_mm=(scale * hair.points_mm @ rotation.T + shift).astype(np.float32),
        opening_mm=(scale * hair.opening_mm @ rotation.T).astype(np.float32),
    )
