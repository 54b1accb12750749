"""Write fitted basis BRDFs, and the BRDF of a position on the skin, in formats of renderers."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from model import fresnel, merl, skin_reflectance
from model.brdf import rgl
from model.brdf.tables import BrdfBasis
from model.skin import SkinAppearance
from skinrig.arrays import BoolArray, Float64Array
from skinrig.exporting.options import ExportError, ExportSettings, SkinPosition
from skinrig.exporting.sealing import write_json

Brdf = Callable[[Float64Array, Float64Array], Float64Array]
"""BRDF of unit vectors to light and view, (n, 3), +z is the normal; 1/sr, (n,) or (n, 3)."""

DOCUMENT_FILE = "brdfs.json"
BRDF_SUFFIXES: Mapping[str, str] = {"merl": ".binary", "rgl": ".bsdf"}
_SURFACE_NORMAL = np.array([0.0, 0.0, 1.0])


def write_merl(appearance: SkinAppearance, folder: Path, delivery: ExportSettings) -> None:
    """Write MERL tables, .binary files of 35 MB each; see `write`."""
    write(appearance, folder, delivery.place, "merl")


def write_rgl(appearance: SkinAppearance, folder: Path, delivery: ExportSettings) -> None:
    """Write .bsdf files for Mitsuba's ``measured``, RGB; see `write`."""
    write(appearance, folder, delivery.place, "rgl")


def write(appearance: SkinAppearance, folder: Path, place: SkinPosition | None, to: str) -> None:
    """Write each basis BRDF as lobe_K, the BRDF of a position as place, and a document.

    Parameters
    ----------
    appearance
        Appearance of a dome, or a fitted model.
    folder
        Existing folder.
    place
        Position on the skin; None: only basis BRDFs.
    to
        "merl" or "rgl".

    Raises
    ------
    ExportError
        If the position has no valid texel, or a negative albedo.
    model.skin_reflectance.SkinReflectanceError
        If the appearance has no basis BRDFs.
    """
    lobes = skin_reflectance.load_basis(appearance)
    suffix, light = BRDF_SUFFIXES[to], lobes.light_radius_rad
    files: dict[str, object] = {}
    for k in range(lobes.size):
        description = f"basis BRDF {k}, equal in all channels: highlights have the light's color"
        _write(to, folder / f"lobe_{k}{suffix}", _lobe(lobes, k), description, light)
        files[f"lobe_{k}{suffix}"] = {"what": description, "light_from_inside": False}
    if place is not None:
        at, entry = _place(appearance, lobes, place)
        _write(to, folder / f"place{suffix}", at, str(entry["what"]), light)
        files[f"place{suffix}"] = entry
    document = {
        "schema": "skinrig.brdfs/1",
        "format": to,
        "source": appearance.source,
        "light_radius_rad": lobes.light_radius_rad,
        "light": "angular radius of the round light with which the BRDFs are convolved: replace "
        "a renderer's light of this size by a point; larger lights are nearly unaffected",
        "unit": "1/sr, without the cosine, Fresnel reflection included",
        "files": files,
    }
    write_json(folder / DOCUMENT_FILE, document)


def tabulate_merl(brdf: Brdf) -> merl.MerlTable:
    """Tabulate a BRDF at the centers of MERL's bins; -1 if light or view are below the horizon.

    Parameters
    ----------
    brdf
        See :data:`Brdf`.
    """
    theta_h, theta_d, phi_d = merl.bin_centers()
    d, phi = np.meshgrid(theta_d, phi_d, indexing="ij")
    values = np.full((*merl.TABLE_SHAPE, 3), -1.0)
    for i, h in enumerate(theta_h):
        light, view = merl.to_directions(h, d, phi)
        above = (light[..., 2] > 0.0) & (view[..., 2] > 0.0)
        found = np.asarray(brdf(light[above], view[above]))
        values[i][above] = found.reshape(len(found), -1)
    return merl.MerlTable.from_values(values)


def _lobe(lobes: BrdfBasis, k: int) -> Brdf:
    one = lobes.mix_materials(np.eye(lobes.size)[k : k + 1])
    return lambda light, view: one.evaluate(light, view, _SURFACE_NORMAL)[:, 0]


def _place(
    appearance: SkinAppearance, lobes: BrdfBasis, place: SkinPosition
) -> tuple[Brdf, dict[str, object]]:
    """Return the mean BRDF over the texels around a position, and its description."""
    model = skin_reflectance.assemble(appearance)
    row, column = _nearest_valid(model.valid, place)
    near = np.zeros_like(model.valid)
    near[row, column] = True
    if place.radius_mm > 0.0:
        apart = np.linalg.norm(model.position_mm - model.position_mm[row, column], axis=-1)
        near = model.valid & (apart <= place.radius_mm)
    r_d = model.r_d[near].astype(np.float64).mean(axis=0)
    if place.diffuse and not np.all(r_d >= 0.0):
        raise ExportError(
            f"--at: r_d is {r_d.tolist()} there, expected 0 or more; choose another position, a "
            "larger --radius, or --without-diffuse"
        )
    surface = lobes.mix_materials(model.weights[near].astype(np.float64).mean(axis=0)[None])

    def brdf(light: Float64Array, view: Float64Array) -> Float64Array:
        found = np.repeat(surface.evaluate(light, view, _SURFACE_NORMAL), 3, axis=-1)
        if place.diffuse:
            through = 1.0 - fresnel.reflectance(light[:, 2], model.eta)
            through = through * (1.0 - fresnel.reflectance(view[:, 2], model.eta))
            found = found + through[:, None] * r_d / np.pi
        return np.asarray(found)

    inside = "with subsurface scattering" if place.diffuse else "specular reflection only"
    entry: dict[str, object] = {
        "what": f"mean of {int(near.sum())} texels, {inside}; camera RGB over a perfect white",
        "light_from_inside": place.diffuse,
        "position_mm": model.position_mm[row, column].tolist(),
        "radius_mm": place.radius_mm,
        "texels": int(near.sum()),
        "r_d": r_d.tolist(),
    }
    return brdf, entry


def _nearest_valid(valid: BoolArray, place: SkinPosition) -> tuple[int, int]:
    height, width = valid.shape
    row = min(int((1.0 - place.v) * height), height - 1)
    column = min(int(place.u * width), width - 1)
    if not valid[row, column]:
        raise ExportError(
            f"--at: u {place.u}, v {place.v} is texel row {row}, column {column}, which is not "
            f"valid ({np.count_nonzero(valid)} of {valid.size} texels are); choose another position"
        )
    return row, column


def _write(to: str, path: Path, brdf: Brdf, description: str, light_radius_rad: float) -> None:
    if to == "merl":  # the format has no description
        merl.write(path, tabulate_merl(brdf))
    else:
        description = f"{description}; measured with a light of radius {light_radius_rad:.6g} rad"
        rgl.write(path, rgl.tabulate_brdf(brdf, description=description))
