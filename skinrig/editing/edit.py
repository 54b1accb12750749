"""An appearance with other traits and other spots, in the same layout: `skinrig edit`."""

import dataclasses
import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from model import store
from model.skin import SkinAppearance, SkinMap
from model.traits.storage import TraitLibrary
from model.traits.vectors import MAX_P_VALUE, TraitVector
from reconstruction.correspondence import common_regions
from skinrig import consent
from skinrig.appearances import face_textures
from skinrig.appearances.contents import hash_document, hash_file
from skinrig.appearances.face_textures import Face
from skinrig.arrays import BoolArray, Float32Array
from skinrig.console import select_attributes
from skinrig.editing import albedo as editing_albedo
from skinrig.editing import masks, pigment_spots, surface_mixtures
from skinrig.editing import spots as editing_spots
from skinrig.editing import surface as editing_surface
from skinrig.editing.albedo import AlbedoEdit
from skinrig.editing.spots import SpotRequest
from skinrig.editing.surface_mixtures import SurfaceMixtures
from skinrig.errors import UsageError, require_choice
from skinrig.traits import regions
from skinrig.traits.regions import LibraryParts

EDITABLE_PARTS: Final = ("albedo", "surface")
MAX_TRAIT_AMOUNT: Final = 10.0
"""Of a trait. The strongest of the package's change R_d by a factor of 1.3 (tan) to 1.9 (powder)
per amount: at 10 they reach the smallest or largest factor of an edit."""
MAX_RESIDUAL_DISTANCE: Final = 0.5
"""Fraction of the distance to the target histograms above which the residual is reported."""
STALE_MAPS: Final = {"lobe_residual": "is of the lobes before the edit"}
"""Maps that an edit of the lobes leaves without meaning."""


class EditError(ValueError):
    """An edit that cannot be made as asked."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EditRequest:
    """What to do to an appearance.

    Attributes
    ----------
    traits
        Name to amount.
    region
        One of `common_regions.REGION_NAMES` that the library has: "face", "beard" or "no-beard".
    parts
        Of `EDITABLE_PARTS`; None: those with a significant effect of the trait.
    mask
        Picture of the texture, see `edit_masks.read`.
    spots
        Added and removed after the traits.
    landmarks
        Table, see `face_textures.read`.
    basis
        Folder of MERL files that the lobes were fitted with.
    iterations
        Of matching the albedo.
    seed
        Of noise and spots.
    """

    traits: Mapping[str, float]
    region: str = "face"
    parts: tuple[str, ...] | None = None
    mask: Path | None = None
    spots: tuple[SpotRequest, ...] = ()
    landmarks: Path | None = None
    basis: Path | None = None
    iterations: int = 5
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse an empty order and values out of range."""
        if not self.traits and not self.spots:
            raise UsageError("edit: got neither traits nor spots, expected --trait or --spots")
        for name, amount in self.traits.items():
            if not abs(amount) <= MAX_TRAIT_AMOUNT:
                raise EditError(
                    f"trait {name}: got {amount:g}, expected -{MAX_TRAIT_AMOUNT:g} to "
                    f"{MAX_TRAIT_AMOUNT:g}; faces with and without the trait differ by 1, and "
                    "no face of the training data lies beyond; give a smaller amount"
                )
        for part in self.parts or ():
            require_choice("parts", part, EDITABLE_PARTS, EditError)
        if self.iterations < 1:
            raise EditError(
                f"iterations: got {self.iterations}, expected at least 1: none changes nothing"
            )
        if self.seed < 0:
            raise EditError(f"seed: got {self.seed}, expected at least 0")


@dataclass(frozen=True, slots=True, eq=False)
class EditResult:
    """What an edit made.

    Attributes
    ----------
    appearance
        All maps, edited and not.
    changed
        Names of maps and files that differ from the source's.
    record
        What was done, as JSON values; in the appearance's parameters as "edit".
    warnings
        A sentence each.
    """

    appearance: SkinAppearance
    changed: tuple[str, ...]
    record: Mapping[str, Any]
    warnings: tuple[str, ...]


@dataclass(slots=True)
class _EditState:
    """State of an edit under way."""

    face: Face
    order: EditRequest
    mask: Float32Array | None
    maps: dict[str, SkinMap]  # as edited so far
    files: dict[str, bytes]  # as edited so far
    record: dict[str, Any]
    warnings: list[str]
    left_out: list[tuple[str, str]]


def edit_folder(
    path: Path,
    request: EditRequest,
    *,
    out: Path,
    library: TraitLibrary | None = None,
    library_hash: str = "",
    progress: Callable[[str], None] | None = None,
) -> EditResult:
    """Write an edited appearance.

    Parameters
    ----------
    path
        APPEARANCE/ folder.
    order
        What to do.
    out
        APPEARANCE/ folder to write; not the source.
    library
        Traits; needed where the order has any.
    library_hash
        Of its file, for the record.
    progress
        Called with a line a step.

    Raises
    ------
    EditError, FaceError, MaskError, SpotError, StoreError, UnusableError
        Naming what is missing or does not fit; nothing is written.
    """
    if out.resolve() == path.resolve():
        raise EditError(f"out: {out} is the source; name another folder")
    face = face_textures.read(path, request.landmarks)
    inputs = {
        **{f"source {name}": value for name, value in face.appearance.inputs.items()},
        "appearance": hash_document(path),
    }
    for name, file in (("mask", request.mask), ("landmarks", request.landmarks)):
        if file is not None:
            inputs[name] = hash_file(file)
    if library is not None and library_hash:
        inputs["traits"] = library_hash
    done = edit_face(face, request, library, progress=progress)
    store.write(out, dataclasses.replace(done.appearance, inputs=inputs))
    return done


def edit_face(
    face: Face,
    request: EditRequest,
    library: TraitLibrary | None = None,
    *,
    progress: Callable[[str], None] | None = None,
) -> EditResult:
    """Edit an appearance in memory; see `edit_folder`."""
    report = progress or (lambda text: None)
    source = face.appearance
    parts = _open_library(request, library)
    shape = _texture_shape(source, face)
    mask = None if request.mask is None else masks.read(request.mask, shape)
    maps, files = dict(source.maps), dict(source.files)
    work = _EditState(face, request, mask, maps, files, {}, [], list(source.left_out))
    asked = {name: amount for name, amount in request.traits.items() if amount}
    if asked and parts is not None:
        chosen = _select_traits(asked, parts, work)
        if chosen["albedo"]:
            report(f"albedo: {', '.join(chosen['albedo'])}")
            _edit_albedo(work, parts, chosen["albedo"])
        if chosen["surface"]:
            report(f"lobes: {', '.join(chosen['surface'])}")
            _edit_surface(work, parts, chosen["surface"])
    spots = [spot for spot in request.spots if spot.amount]
    if spots:
        _edit_spots(work, spots, report)
    changed = sorted(
        {n for n, m in work.maps.items() if source.maps.get(n) is not m}
        | {n for n in source.maps if n not in work.maps}
        | {n for n, c in work.files.items() if source.files.get(n) != c}
    )
    record = {
        "of": face.path.resolve().name,
        "traits": dict(request.traits),
        "mask": None if request.mask is None else request.mask.name,
        "spots": [dataclasses.asdict(spot) for spot in request.spots],
        **select_attributes(request, "region", "seed", "iterations"),
        "landmarks": face.marked_by,
        "changed": changed,
        "warnings": list(work.warnings),
        **work.record,
    }
    before = source.parameters.get("edit")
    if before is not None:
        record["before"] = before
    parameters = {**source.parameters, "edit": record}
    # the people whose traits were used are in the result, too
    used = () if library is None or not asked else (library,)
    if agreed := consent.merge_consent(source, *used):
        parameters[consent.CONSENT_KEY] = agreed
    left_out = tuple(work.left_out)
    appearance = dataclasses.replace(
        source, maps=work.maps, files=work.files, left_out=left_out, parameters=parameters
    )
    return EditResult(appearance, tuple(changed), record, tuple(work.warnings))


def _open_library(request: EditRequest, library: TraitLibrary | None) -> LibraryParts | None:
    """Return the library's parts, after a check that it has what is asked for."""
    if not request.traits:
        return None
    if library is None:
        raise EditError("traits: got no library to take them from, expected --space FILE")
    parts = regions.open_library(library)
    for name in request.traits:
        if name not in parts.traits:
            near = difflib.get_close_matches(name, parts.traits, n=1, cutoff=0.5)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise EditError(
                f"trait {name!r}: is not one of {', '.join(parts.traits)}{hint} "
                "`skinrig fit traits` learns others"
            )
    if request.region != "face":
        require_choice("region", request.region, dict.fromkeys(("face", *parts.albedo)), EditError)
    return parts


def _texture_shape(source: SkinAppearance, face: Face) -> tuple[int, int]:
    for name in ("r_d", "basis_weight_0"):
        if name in source.maps:
            height, width = source.maps[name].values.shape[:2]
            return int(height), int(width)
    raise EditError(
        f"{face.path}: has neither r_d nor basis_weight_0, there is nothing to edit; it has "
        f"{', '.join(sorted(source.maps)) or 'no map'}"
    )


def _select_traits(
    requested: Mapping[str, float], parts: LibraryParts, work: _EditState
) -> dict[str, dict[str, float]]:
    """Return which traits to use in which part."""
    order = work.order
    have: dict[str, Mapping[str, TraitVector]] = {
        "albedo": parts.albedo[order.region].traits.traits if order.region in parts.albedo else {},
        "surface": {} if parts.surface is None else parts.surface.traits,
    }
    missing = {"albedo": "r_d", "surface": "basis_weight_0"}
    out: dict[str, dict[str, float]] = {part: {} for part in EDITABLE_PARTS}
    for name, amount in requested.items():
        possible = [p for p in EDITABLE_PARTS if name in have[p] and missing[p] in work.maps]
        if order.parts is not None:
            use = [p for p in possible if p in order.parts]
        else:
            use = [p for p in possible if have[p][name].confidence.p_value <= MAX_P_VALUE]
            for p in possible if use else []:
                if p not in use:
                    chance = have[p][name].confidence.p_value
                    why = f"the effect of the trait is not significant (p = {chance:.2g})"
                    work.left_out.append((f"{name} in {p}", f"{why}; --parts {p} edits it"))
            use = use or possible
        if not use:
            known = ", ".join(p for p in EDITABLE_PARTS if name in have[p]) or "no part"
            shown = ", ".join(p for p in EDITABLE_PARTS if missing[p] in work.maps)
            raise EditError(
                f"trait {name!r}: none of the parts asked for can be edited by it; the traits have "
                f"it in {known}, the appearance has {shown}"
            )
        for p in use:
            out[p][name] = amount
            work.warnings += [f"{p}: {text}" for text in have[p][name].warnings]
    return out


def _edit_albedo(work: _EditState, parts: LibraryParts, amounts: Mapping[str, float]) -> None:
    order, mask = work.order, work.mask
    space = parts.albedo[order.region]
    chart = work.face.chart(parts.frame)
    source = work.maps["r_d"]
    _warn_without_landmarks(work)

    region = common_regions.region_mask(order.region, parts.frame)
    share = masks.feather_region(order.region, parts.frame)

    def one(values: Float32Array, given: Mapping[str, float], stream: int) -> AlbedoEdit:
        how: dict[str, Any] = {"region": region, "weight": share, "iterations": order.iterations}
        rng = np.random.default_rng([order.seed, stream])
        known = face_textures.find_valid_texels(source)
        return editing_albedo.edit_albedo(values, known, chart, space, given, **how, rng=rng)

    found = one(source.values, amounts, 0)
    values, held = found.apply(source.values, mask)
    back = one(values, {name: -amount for name, amount in amounts.items()}, 1)
    again, _ = back.apply(values, mask)
    work.maps["r_d"] = editing_spots.replace_values(source, values)
    good = face_textures.find_valid_texels(source) & (values != source.values).any(axis=-1)
    if found.after > MAX_RESIDUAL_DISTANCE * found.before and any(
        abs(a) > 1 for a in amounts.values()
    ):
        work.warnings.append(
            f"albedo: matching came {100 * (1 - found.after / found.before):.0f} % of the way to "
            "the histograms asked for; smaller amounts can be reached"
        )
    work.record["albedo"] = {
        "traits": dict(amounts),
        "vectors": space.kind,
        "clipped_share": found.clipped,
        "distance_before": found.before,
        "distance_after": found.after,
        "held_at_white": int(held.sum()),
        "change_rms": _relative(values, source.values, good),
        "return_error_rms": _relative(again, source.values, good),
        "stderr": "carried: multiplied by the factor of the edit, which has no error of its own",
    }


def _edit_surface(work: _EditState, parts: LibraryParts, amounts: Mapping[str, float]) -> None:
    order, mask = work.order, work.mask
    if parts.surface is None:
        return
    share = mask
    if order.region != "face":
        _warn_without_landmarks(work)
        over = masks.region_weights(order.region, parts.frame, work.face.chart(parts.frame))
        share = over if mask is None else mask * over
    current = dataclasses.replace(work.face.appearance, maps=work.maps, files=work.files)
    source = surface_mixtures.read(current)
    found = editing_surface.edit_surface(source, parts.surface, amounts, weight=share)
    tables = surface_mixtures.load_materials(source.materials, source.light_radius_rad, order.basis)
    back = editing_surface.edit_surface(
        found.mixtures, parts.surface, {n: -a for n, a in amounts.items()}, weight=share
    )
    strength = tables.strength()
    replaced = surface_mixtures.replace_mixtures(
        current, found.mixtures, surface_mixtures.serialize_mixtures(found.mixtures, tables)
    )
    work.maps = {n: m for n, m in replaced.maps.items() if n not in STALE_MAPS}
    work.files = dict(replaced.files)
    work.left_out += [(n, f"{STALE_MAPS[n]}") for n in STALE_MAPS if n in replaced.maps]
    work.record["surface"] = {
        "traits": dict(amounts),
        "clipped_share": found.clipped,
        "misfit": dict(found.misfit),
        "lobes": len(found.mixtures.mix),
        "change_rms": _strength_difference(found.mixtures, source, strength),
        "return_error_rms": _strength_difference(back.mixtures, source, strength),
        "stderr": "carried; of a lobe that a trait brought the relative error of its vector",
    }


def _edit_spots(
    work: _EditState, spots: Sequence[SpotRequest], progress: Callable[[str], None]
) -> None:
    face, order, mask = work.face, work.order, work.mask
    if "r_d" not in work.maps:
        raise EditError(f"{face.path}: has no map r_d, which spots are drawn into")
    frame = editing_spots.build_spot_frame(face)
    chart = face.chart(frame)
    skin = masks.region_weights("skin" if order.region == "face" else order.region, frame, chart)
    # a mask image limits spots itself; without one they avoid eyes, brows and lips
    share = skin if mask is None else (mask if order.region == "face" else mask * skin)
    reports = []
    for number, spot in enumerate(spots):
        progress(f"{spot.kind}: {spot.amount:+g}")
        source = work.maps["r_d"]
        rng = np.random.default_rng([order.seed, 2, number])
        if spot.amount > 0:
            values, one = editing_spots.add_spots(face, source, spot, share, rng)
            work.maps["r_d"] = editing_spots.replace_values(source, values)
        else:
            values, one = editing_spots.remove_spots(source, spot, share, chart, frame)
            good = face_textures.find_valid_texels(source) if source.valid is not None else None
            moved = editing_spots.replace_values(source, values)
            if moved.stderr is not None:  # what is filled in is known no better than it changed
                off = np.abs(values - source.values)
                moved = dataclasses.replace(moved, stderr=np.hypot(moved.stderr, off))
            work.maps["r_d"] = dataclasses.replace(moved, valid=good)
        reports.append({**dataclasses.asdict(spot), **one})
        least = pigment_spots.SPOT_KINDS[spot.kind].diameter_mm
        if face.texel_mm() > least:
            work.warnings.append(
                f"{spot.kind}: are smaller ({least} mm) than a texel ({face.texel_mm():.2f} mm) "
                "and only darken it by their share"
            )
    _warn_without_landmarks(work)
    work.record["spots_done"] = reports


def _warn_without_landmarks(work: _EditState) -> None:
    text = "the face has no landmarks: it was unrolled from its foremost point, regions are typical"
    regional = work.order.region != "face" or work.order.spots
    if not work.face.landmarks and regional and text not in work.warnings:
        work.warnings.append(text)


def _relative(a: Float32Array, b: Float32Array, valid: BoolArray) -> float:
    return _relative_rms_difference(a[valid].astype(np.float64), b[valid].astype(np.float64))


def _strength_difference(a: SurfaceMixtures, b: SurfaceMixtures, strength: NDArray[Any]) -> float:
    """Return how far two faces' mixtures differ over the texels, RMS, relative to the second's."""
    good = b.valid
    x, y = (one.weights()[good] @ (one.mix * strength) for one in (a, b))
    return _relative_rms_difference(x, y)


def _relative_rms_difference(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Return how far some values are from others, RMS, relative to the others; 0 without any."""
    size = float(np.sqrt(np.mean(b**2))) if b.size else 0.0
    return float(np.sqrt(np.mean((a - b) ** 2))) / size if size > 0 else 0.0
