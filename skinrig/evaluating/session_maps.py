"""Read the maps of an appearance that describe a person, for a comparison of two sessions."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from model.skin import SkinAppearance, SkinMap
from reconstruction.pipeline.probe.stages import SUBSURFACE_FILE
from skinrig.arrays import BoolArray, Float64Array
from skinrig.evaluating.subsurface import RECOMMENDED_METHOD, read_document

Kind = Literal["level", "direction", "structure"]

LEVEL_MAPS: Final = ("melanin", "hemoglobin", "oxygenation", "r_d")
"""Maps whose level in a region is compared, relative to the mean of both sessions. Light, optical
depth and skin tone are not among them: they repeat the same errors, or depend on the light."""
STRUCTURE_MAPS: Final = ("height_", "normals_")
"""Prefixes of the maps of a patch, whose relief is compared pixel by pixel."""
CHANNEL_NAMES: Final = ("red", "green", "blue")


@dataclass(frozen=True, slots=True, eq=False)
class ComparedQuantity:
    """One quantity of a session on the samples of a map.

    Attributes
    ----------
    name
        Name of the map, with its channel where it has several.
    kind
        How sessions are compared.
    values, stderr, noise
        (N, C): values, their stated standard uncertainty, and its part by noise alone.
    valid
        (N,).
    """

    name: str
    kind: Kind
    values: Float64Array
    stderr: Float64Array
    noise: Float64Array
    valid: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class SessionMaps:
    """Quantities of a session, and where their samples are.

    Attributes
    ----------
    kind
        "image", "surface", "patch" or "sites".
    shape
        Rows and columns of the maps; (sites, 1) for a fiber probe.
    quantities
        By name.
    position_mm, normals
        (N, 3) in the rig frame, NaN where unknown; only of a surface.
    seen
        (N,): samples with any quantity.
    sites
        Names of the samples of a fiber probe.
    structure
        (H, W[, C]): image with visible structure, for registration; empty without.
    """

    kind: Literal["image", "surface", "patch", "sites"]
    shape: tuple[int, int]
    quantities: dict[str, ComparedQuantity]
    position_mm: Float64Array
    normals: Float64Array
    seen: BoolArray
    sites: tuple[str, ...]
    structure: Float64Array


def read_session_maps(appearance: SkinAppearance) -> SessionMaps | None:
    """Return the quantities of an appearance that describe its person; None without any.

    Parameters
    ----------
    appearance
        Maps of a flash camera, a dome, a gradient sphere or a fiber probe.
    """
    if SUBSURFACE_FILE in appearance.files:
        return _read_probe(appearance)
    found = {q.name: q for q in _iterate_quantities(appearance)}
    if not found:
        return None
    shape = next(
        m.values.shape[:2] for name, m in appearance.maps.items() if name.startswith(_stem(found))
    )
    position, normals = (appearance.maps.get(name) for name in ("position", "normals"))
    flat = np.full((shape[0] * shape[1], 3), np.nan)
    places, facing = flat, flat
    if position is not None:
        places = np.where(position.mask[..., None], position.values, np.nan).reshape(-1, 3)
        if normals is not None:
            facing = np.where(normals.mask[..., None], normals.values, np.nan).reshape(-1, 3)
    patch = all(q.kind == "structure" for q in found.values())
    return SessionMaps(
        kind="surface" if position is not None else "patch" if patch else "image",
        shape=(shape[0], shape[1]),
        quantities=found,
        position_mm=places.astype(np.float64),
        normals=facing.astype(np.float64),
        seen=np.any([q.valid for q in found.values()], axis=0),
        sites=(),
        structure=_structure(appearance),
    )


def _stem(found: dict[str, ComparedQuantity]) -> str:
    return next(iter(found)).split(",")[0]


def _structure(appearance: SkinAppearance) -> Float64Array:
    """Return the image by which two sessions are registered."""
    for name in ("diffuse", "melanin"):
        if name in appearance.maps:
            return appearance.maps[name].values.astype(np.float64)
    for name, one in appearance.maps.items():
        if name.startswith("height_"):
            return one.values.astype(np.float64)
    return np.zeros((0, 0))


def _iterate_quantities(appearance: SkinAppearance) -> Iterator[ComparedQuantity]:
    surface = "position" in appearance.maps
    for name, one in appearance.maps.items():
        if one.stderr is None:
            continue
        if name in LEVEL_MAPS:
            noise = appearance.maps.get(f"{name}_noise_stderr")
            yield from _levels(name, one, noise)
        elif name == "normals" and surface:
            yield _flat(name, "direction", one)
        elif name.startswith(STRUCTURE_MAPS) and not surface:
            yield _flat(name, "structure", one)


def _levels(name: str, one: SkinMap, noise: SkinMap | None) -> Iterator[ComparedQuantity]:
    whole = _flat(name, "level", one)
    if noise is not None:
        least = noise.values.reshape(len(whole.values), -1).astype(np.float64)
        whole = dataclasses.replace(whole, noise=np.fmin(whole.stderr, least))
    if whole.values.shape[1] == 1:
        yield whole
        return
    for k, channel in enumerate(CHANNEL_NAMES):
        part = {key: getattr(whole, key)[:, k : k + 1] for key in ("values", "stderr", "noise")}
        yield dataclasses.replace(whole, name=f"{name}, {channel}", **part)


def _flat(name: str, kind: Kind, one: SkinMap) -> ComparedQuantity:
    count = one.mask.size
    values = one.values.reshape(count, -1).astype(np.float64)
    error = np.broadcast_to(
        np.asarray(one.stderr, np.float64).reshape(count, -1), values.shape
    ).copy()
    valid = one.mask.reshape(-1) & np.isfinite(values).all(axis=1) & np.isfinite(error).all(axis=1)
    return ComparedQuantity(name, kind, values, error, error, valid)


def _read_probe(appearance: SkinAppearance) -> SessionMaps | None:
    """Return sigma_tr by channel, one sample per site: the mean over its placements."""
    document = read_document(appearance, SUBSURFACE_FILE)
    rows: dict[tuple[str, str], list[tuple[float, float, float]]] = {}
    for measured in document["measurements"] if document else ():
        for fit in measured["fits"]:
            if fit["method"] == RECOMMENDED_METHOD and fit["valid"]:
                numbers = ("sigma_tr_per_mm", "sigma_tr_stderr", "sigma_tr_stderr_readings")
                known = tuple(float(fit[key]) for key in numbers)
                rows.setdefault((measured["site"], fit["channel"]), []).append(known)  # type: ignore[arg-type]
    if not rows:
        return None
    sites = tuple(dict.fromkeys(site for site, _ in rows))
    quantities = {}
    for channel in CHANNEL_NAMES:
        table = np.full((len(sites), 3), np.nan)
        for k, site in enumerate(sites):
            if (site, channel) in rows:
                table[k] = np.mean(rows[site, channel], axis=0)
        valid = np.isfinite(table).all(axis=1)
        name = f"sigma_tr, {channel}"
        value, stderr, noise = np.nan_to_num(table).T[..., None]
        quantities[name] = ComparedQuantity(name, "level", value, stderr, noise, valid)
    nowhere = np.full((len(sites), 3), np.nan)
    seen = np.ones(len(sites), np.bool_)
    return SessionMaps(
        "sites", (len(sites), 1), quantities, nowhere, nowhere, seen, sites, np.zeros((0, 0))
    )
