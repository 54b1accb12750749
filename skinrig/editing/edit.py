"""Edit traits and spots of an appearance; its texture layout is kept: `skinrig edit`."""

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
"""Maximum amount of a trait, absolute; at 10, strong traits reach the limits of an edit."""
MAX_RESIDUAL_DISTANCE: Final = 0.5
"""Fraction of the distance to the target histograms above which the residual is reported."""
STALE_MAPS: Final = {"lobe_residual": "residual of the basis BRDFs before the edit"}
"""Maps that an edit of the basis BRDFs invalidates, with the reason."""


class EditError(ValueError):
    """An edit that is invalid for the appearance."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EditRequest:
    """Traits and spots of an edit, with its region and parts.

    Attributes
    ----------
    traits
        Amount by trait.
    region
        Region of the library: "face", "beard" or "no-beard", see `common_regions.REGION_NAMES`.
    parts
        Edited parts, of `EDITABLE_PARTS`; None: those with a significant effect of the trait.
    mask
        Mask image of the texture, see `skinrig.editing.masks.read`.
    spots
        Spots that are added or removed after the traits.
    landmarks
        Table of landmarks, see `face_textures.read`.
    basis
        Folder of MERL and RGL files that the lobes were fitted with.
    iterations
        Number of iterations of the albedo matching.
    seed
        Random seed.
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
        """Raise for an empty request and values out of range."""
        if not self.traits and not self.spots:
            raise UsageError("edit: got neither traits nor spots, expected --trait or --spots")
        for name, amount in self.traits.items():
            if not abs(amount) <= MAX_TRAIT_AMOUNT:
                raise EditError(
                    f"--trait {name}: got {amount:g}, expected -{MAX_TRAIT_AMOUNT:g} to "
                    f"{MAX_TRAIT_AMOUNT:g}; enter a smaller one (1: faces with and without it)"
                )
        for part in self.parts or ():
            require_choice("parts", part, EDITABLE_PARTS, EditError)
        if self.iterations < 1:
            raise EditError(
                f"--iterations: got {self.iterations}, expected 1 or more; enter another"
            )
        if self.seed < 0:
            raise EditError(f"--seed: got {self.seed}, expected 0 or more; enter another")


@dataclass(frozen=True, slots=True, eq=False)
class EditResult:
    """Result of an edit.

    Attributes
    ----------
    appearance
        All maps, edited and unchanged.
    changed
        Names of maps and files that differ from the source's.
    record
        Record of the edit as JSON values; the appearance's parameter "edit".
    warnings
        Sentences.
    """

    appearance: SkinAppearance
    changed: tuple[str, ...]
    record: Mapping[str, Any]
    warnings: tuple[str, ...]


@dataclass(slots=True)
class _EditState:
    """State of an edit under way."""

    face: Face
    request: EditRequest
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
    """Edit an appearance and write the result.

    Parameters
    ----------
    path
        APPEARANCE/ folder.
    request
        Traits and spots.
    out
        APPEARANCE/ folder to write; not the source.
    library
        Trait library; required if the request has traits.
    library_hash
        Digest of the library's file, for the record.
    progress
        Called with one line per step.

    Raises
    ------
    EditError, FaceError, MaskError, SpotError, StoreError, UnusableError
        If an input is missing or inconsistent; nothing is written.
    """
    if out.resolve() == path.resolve():
        raise EditError(f"--out: {out} is the source; name another folder")
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
        "landmarks": face.landmark_source,
        "changed": changed,
        "warnings": list(work.warnings),
        **work.record,
    }
    before = source.parameters.get("edit")
    if before is not None:
        record["before"] = before
    parameters = {**source.parameters, "edit": record}
    # the result contains data of the people whose traits were used: it inherits their consent
    used = () if library is None or not asked else (library,)
    if agreed := consent.merge_consent(source, *used):
        parameters[consent.CONSENT_KEY] = agreed
    left_out = tuple(work.left_out)
    appearance = dataclasses.replace(
        source, maps=work.maps, files=work.files, left_out=left_out, parameters=parameters
    )
    return EditResult(appearance, tuple(changed), record, tuple(work.warnings))


def _open_library(request: EditRequest, library: TraitLibrary | None) -> LibraryParts | None:
    """Return the library's parts; raise if a requested trait is missing."""
    if not request.traits:
        return None
    if library is None:
        raise EditError("--trait: got no trait library, expected one; add --space FILE")
    parts = regions.open_library(library)
    for name in request.traits:
        if name not in parts.traits:
            near = difflib.get_close_matches(name, parts.traits, n=1, cutoff=0.5)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise EditError(
                f"--trait: got {name!r}, expected one of {', '.join(parts.traits)}{hint}; "
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
        f"{face.path}: got {', '.join(sorted(source.maps)) or 'no map'}, expected r_d or "
        "basis_weight_0; reconstruct them first"
    )


def _select_traits(
    requested: Mapping[str, float], parts: LibraryParts, work: _EditState
) -> dict[str, dict[str, float]]:
    """Select the traits to edit in each part."""
    where = work.request.region
    have: dict[str, Mapping[str, TraitVector]] = {
        "albedo": parts.albedo[where].traits.traits if where in parts.albedo else {},
        "surface": {} if parts.surface is None else parts.surface.traits,
    }
    missing = {"albedo": "r_d", "surface": "basis_weight_0"}
    out: dict[str, dict[str, float]] = {part: {} for part in EDITABLE_PARTS}
    for name, amount in requested.items():
        possible = [p for p in EDITABLE_PARTS if name in have[p] and missing[p] in work.maps]
        if work.request.parts is not None:
            use = [p for p in possible if p in work.request.parts]
        else:
            use = [p for p in possible if have[p][name].confidence.p_value <= MAX_P_VALUE]
            for p in possible if use else []:
                if p not in use:
                    chance = have[p][name].confidence.p_value
                    why = f"effect of the trait is not significant (p = {chance:.2g})"
                    work.left_out.append((f"{name} in {p}", f"{why}; --parts {p} edits it"))
            use = use or possible
        if not use:
            known = ", ".join(p for p in EDITABLE_PARTS if name in have[p]) or "no part"
            shown = ", ".join(p for p in EDITABLE_PARTS if missing[p] in work.maps)
            raise EditError(
                f"--trait {name}: applies to {known}, the appearance has {shown}; choose another "
                "trait or --parts"
            )
        for p in use:
            out[p][name] = amount
            work.warnings += [f"{p}: {text}" for text in have[p][name].warnings]
    return out


def _edit_albedo(work: _EditState, parts: LibraryParts, amounts: Mapping[str, float]) -> None:
    request, mask = work.request, work.mask
    space = parts.albedo[request.region]
    chart = work.face.chart(parts.frame)
    source = work.maps["r_d"]
    _warn_without_landmarks(work)

    region = common_regions.region_mask(request.region, parts.frame)
    share = masks.feather_region(request.region, parts.frame)

    def one(values: Float32Array, given: Mapping[str, float], stream: int) -> AlbedoEdit:
        how: dict[str, Any] = {"region": region, "weight": share, "iterations": request.iterations}
        rng = np.random.default_rng([request.seed, stream])
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
            f"albedo: matching reached {100 * (1 - found.after / found.before):.0f} % of the "
            "distance to the target histograms; use a smaller amount to reach them"
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
        "stderr": "multiplied by the factor of the edit, which is taken as exact",
    }


def _edit_surface(work: _EditState, parts: LibraryParts, amounts: Mapping[str, float]) -> None:
    request, mask = work.request, work.mask
    if parts.surface is None:
        return
    share = mask
    if request.region != "face":
        _warn_without_landmarks(work)
        over = masks.region_weights(request.region, parts.frame, work.face.chart(parts.frame))
        share = over if mask is None else mask * over
    current = dataclasses.replace(work.face.appearance, maps=work.maps, files=work.files)
    source = surface_mixtures.read(current)
    found = editing_surface.edit_surface(source, parts.surface, amounts, weight=share)
    names, radius_rad = source.materials, source.light_radius_rad
    tables = surface_mixtures.load_materials(names, radius_rad, request.basis)
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
        "stderr": "unchanged; of a basis BRDF added by a trait, the relative error of its vector",
    }


def _edit_spots(
    work: _EditState, spots: Sequence[SpotRequest], progress: Callable[[str], None]
) -> None:
    face, request, mask = work.face, work.request, work.mask
    if "r_d" not in work.maps:
        raise EditError(f"{face.path}: map r_d is missing, expected it for spots; reconstruct it")
    frame = editing_spots.build_spot_frame(face)
    chart = face.chart(frame)
    region = "skin" if request.region == "face" else request.region
    skin = masks.region_weights(region, frame, chart)
    # a mask image limits the spots; without it, they avoid eyes, brows and lips
    share = skin if mask is None else (mask if request.region == "face" else mask * skin)
    reports = []
    for number, spot in enumerate(spots):
        progress(f"{spot.kind}: {spot.amount:+g}")
        source = work.maps["r_d"]
        rng = np.random.default_rng([request.seed, 2, number])
        if spot.amount > 0:
            values, one = editing_spots.add_spots(face, source, spot, share, rng)
            work.maps["r_d"] = editing_spots.replace_values(source, values)
        else:
            values, one = editing_spots.remove_spots(source, spot, share, chart, frame)
            good = face_textures.find_valid_texels(source) if source.valid is not None else None
            moved = editing_spots.replace_values(source, values)
            if moved.stderr is not None:  # the size of the change is added as uncertainty
                off = np.abs(values - source.values)
                moved = dataclasses.replace(moved, stderr=np.hypot(moved.stderr, off))
            work.maps["r_d"] = dataclasses.replace(moved, valid=good)
        reports.append({**dataclasses.asdict(spot), **one})
        least = pigment_spots.SPOT_KINDS[spot.kind].diameter_mm
        if face.texel_mm() > least:
            work.warnings.append(
                f"{spot.kind}: {least} mm is smaller than a texel ({face.texel_mm():.2f} mm), "
                "which is darkened by the spot's fraction of its area"
            )
    _warn_without_landmarks(work)
    work.record["spots_done"] = reports


def _warn_without_landmarks(work: _EditState) -> None:
    text = "the face has no landmarks; regions are those of a mean face at its foremost point"
    regional = work.request.region != "face" or work.request.spots
    if not work.face.landmarks and regional and text not in work.warnings:
        work.warnings.append(text)


def _relative(a: Float32Array, b: Float32Array, valid: BoolArray) -> float:
    return _relative_rms_difference(a[valid].astype(np.float64), b[valid].astype(np.float64))


def _strength_difference(a: SurfaceMixtures, b: SurfaceMixtures, strength: NDArray[Any]) -> float:
    """Return the RMS difference of two faces' mixtures over texels, relative to the second."""
    good = b.valid
    x, y = (one.weights()[good] @ (one.mix * strength) for one in (a, b))
    return _relative_rms_difference(x, y)


def _relative_rms_difference(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Return the RMS difference of values relative to the RMS of the second ones; 0 if empty."""
    size = float(np.sqrt(np.mean(b**2))) if b.size else 0.0
    return float(np.sqrt(np.mean((a - b) ** 2))) / size if size > 0 else 0.0
