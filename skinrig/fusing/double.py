"""Fuse one person's maps by several rigs into one appearance: `skinrig fuse`."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from capture.rig import load_rig
from model import store
from model.skin import SkinAppearance
from model.skin_reflectance import NORMAL_MAPS, TRANSLUCENCY_MAP
from reconstruction.fusion.consistency import MIN_PROBABILITY, RigCheck, check_rigs, name_faulty_rig
from reconstruction.fusion.patch_normals import PatchCheck
from reconstruction.fusion.person import PersonSkin
from reconstruction.fusion.signals import SIGMA_TR_DISTANCE_MM, RigBands
from reconstruction.fusion.texels import OffsetModel
from reconstruction.pipeline.probe.stages import PROFILE_FILE
from skinrig.appearances import face_textures
from skinrig.appearances.contents import (
    FUSION_KEY,
    derive_appearance,
    intersect_valid,
    list_assumptions,
)
from skinrig.appearances.dynamic import WRINKLES
from skinrig.appearances.texel_placement import TexelPlacement, place_texels
from skinrig.fitting import probe_sites
from skinrig.fusing.description import describe_checks, describe_patch, describe_person
from skinrig.fusing.filled_normals import MEASURED_SUFFIX, fill_normals
from skinrig.fusing.filled_skin import fill_skin
from skinrig.fusing.maps import FUSED_MAPS, estimate_maps
from skinrig.fusing.measurements import Measurements
from skinrig.fusing.patches import PATCH_PREFIX, PlacedPatch, place_patch
from skinrig.fusing.sources import FusionInputError, Source, Sources, read_sources
from skinrig.fusing.texel_colors import ColorSource, DomeColors, FlashColors
from skinrig.fusing.unmeasured import UNMEASURED_NAME, UnmeasuredParts, add_unmeasured
from skinrig.fusing.wrinkles import carry_wrinkles

QUANTITY_BY_RIG: Final[Mapping[str, str]] = {
    "dome": "R_d",
    "flash": "diffuse light",
    "probe": "sigma_tr",
    "gradient": "normals",
}
"""Quantity of a rig in the name of a contradiction."""
FUSION_FILE: Final = "fusion.json"
"""Common properties, rigs behind each map and agreement of the rigs, as in `parameters`, which
exports lack."""
ALBEDO_MAP: Final = "r_d"
COVARIANCE_NAME: Final = "covariance"
NAMES_OF_NO_RIG: Final = (ALBEDO_MAP, COVARIANCE_NAME, UNMEASURED_NAME)
"""What can be left out without leaving out a rig."""
MAP_RIGS: Final[Mapping[str, str]] = {
    "diffuse": "flash",
    "sigma_tr": "probe",
    "normals": "gradient",
}
"""Rigs that give one map to the fusion; the dome's `r_d` can be left out alone."""


@dataclass(frozen=True, slots=True)
class FusionInputs:
    """Files and choices of a fusion.

    Attributes
    ----------
    paths
        Sessions with their maps next to them, or appearances, one per rig.
    without
        Rigs, maps of `MAP_RIGS`, "covariance" or "unmeasured" to leave out. Without `r_d` the
        dome's mesh and normals stay; without "unmeasured" nothing is added for display.
    landmarks
        Table ``name,x,y,z`` in mm of the dome's mesh, or ``name,x,y`` in texels of its maps.
    image_landmarks
        Table ``name,x,y`` in pixels of the flash rig's maps.
    sites
        Table ``name,x,y`` of the probe's sites in texels of the dome's maps.
    """

    paths: tuple[Path, ...]
    without: tuple[str, ...] = ()
    landmarks: Path | None = None
    image_landmarks: Path | None = None
    sites: Path | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FusedDouble:
    """One person's maps by all rigs, and what the skin has in common."""

    appearance: SkinAppearance
    person: PersonSkin
    errors: OffsetModel
    measured: Measurements
    checks: tuple[RigCheck, ...]
    patch: PlacedPatch | None = None
    undrawn: tuple[tuple[str, str], ...] = ()
    """Parts for display that could not be added, with reasons."""

    @property
    def all_checks(self) -> tuple[RigCheck | PatchCheck, ...]:
        """Agreement of the rigs, and of the patch with a surface."""
        return (*self.checks, *(() if self.patch is None else (self.patch.check,)))

    @property
    def assumed(self) -> tuple[str, ...]:
        """What was assumed."""
        return (*self.measured.assumed, *(() if self.patch is None else self.patch.assumed))

    @property
    def left_out(self) -> tuple[tuple[str, str], ...]:
        """What was omitted, with reasons."""
        placed = () if self.patch is None else self.patch.left_out
        return (*self.measured.left_out, *placed, *self.undrawn)

    @property
    def contradiction(self) -> str | None:
        """The rigs that contradict the others or themselves, in words; None without a clear one."""
        named: list[RigCheck | PatchCheck] = []
        if (rig := name_faulty_rig(self.checks)) is not None:
            named.append(rig)
        if self.patch is not None and self.patch.check.probability > MIN_PROBABILITY:
            named.append(self.patch.check)
        return "; ".join(one.describe(QUANTITY_BY_RIG[one.rig]) for one in named) or None


def fuse(
    given: FusionInputs,
    *,
    out: Path,
    progress: Callable[[str], None] | None = None,
    unmeasured: UnmeasuredParts | None = None,
) -> FusedDouble:
    """Fuse one person's maps and write them as one appearance.

    Parameters
    ----------
    given
        Inputs.
    out
        Folder to write.
    progress
        Receives a line of progress.
    unmeasured
        Parts for display, fitted to the dome's mesh before; None: they are fitted here.

    Raises
    ------
    FusionInputError
        If folders cannot be fused; the message names them.
    """
    store.require_free(out)
    sources = read_sources(given.paths)
    if any(one.path.resolve() == out.resolve() for one in sources.by_rig.values()):
        raise FusionInputError(f"{out}: is one of the inputs; name another --out")
    found = fuse_sources(sources, given, progress=progress)
    dome = sources.get("dome")
    if dome is not None and not {UNMEASURED_NAME, "dome"} & set(given.without):
        report = progress or (lambda _step: None)
        whole = add_unmeasured(
            found.appearance, dome.path, given.landmarks, progress=report, found=unmeasured
        )
        undrawn = whole.left_out[len(found.appearance.left_out) :]
        found = replace(found, appearance=whole, undrawn=undrawn)
    store.write(out, found.appearance)
    return found


def fuse_sources(
    sources: Sources, given: FusionInputs, *, progress: Callable[[str], None] | None = None
) -> FusedDouble:
    """Fuse maps that were read.

    Parameters
    ----------
    sources
        Maps by rig.
    given
        Landmarks and sites, and what is left out.
    progress
        As of `fuse`.

    Raises
    ------
    FusionInputError
        If no colors are left.
    """
    report = progress or (lambda _step: None)
    kept = [name for name in given.without if name not in NAMES_OF_NO_RIG]
    sources = sources.without([MAP_RIGS.get(name, name) for name in kept])
    report("place texels")
    measured = measure(sources, given)
    report("common properties of the skin")
    person, errors = measured.estimate_person()
    checks = check_rigs(measured.rigs, measured.regions(errors), errors, person)
    gradient = sources.get("gradient")
    patch = None
    if gradient is not None:
        patch = place_patch(gradient, sources.get("dome"), sites=given.sites)
    base = sources.get("dome") or sources.by_rig["flash"]
    maps = dict(base.appearance.maps)
    carried = [name for name in maps if name not in FUSED_MAPS]
    position = base.appearance.maps.get("position")
    fused, p_value = estimate_maps(measured, person, errors, position=position, progress=report)
    fused = fill_skin(fused, position, next((maps[n] for n in NORMAL_MAPS if n in maps), None))
    maps = {name: maps[name] for name in carried}
    if position is not None:
        for name in [name for name in NORMAL_MAPS if name in maps]:
            maps[name], measured_at = fill_normals(maps[name], position)
            if measured_at is not None:
                maps[f"{name}{MEASURED_SUFFIX}"] = measured_at
    carried = list(maps)
    maps |= fused
    color_rigs = [rig.rig for rig in measured.rigs if rig.kind == "reflectance"]
    provenance = {name: [base.rig] for name in carried}
    provenance |= {name: list(color_rigs) for name in fused}
    if TRANSLUCENCY_MAP in fused:
        provenance[TRANSLUCENCY_MAP] = [rig.rig for rig in measured.rigs]
    files = dict(base.appearance.files)
    assumed, left_out = list(measured.assumed), list(measured.left_out)
    if patch is not None:
        maps |= patch.maps
        files |= patch.files
        rigs = ["gradient"] if patch.fused is None else ["dome", "gradient"]
        for name in patch.maps:
            provenance[name] = rigs if name.startswith(PATCH_PREFIX) else ["gradient"]
        assumed += patch.assumed
        left_out += patch.left_out
    parts = {} if patch is None else dict(patch.parameters)
    if (moving := sources.get(WRINKLES)) is not None:
        wrinkles = carry_wrinkles(moving, sources.get("dome"))
        maps |= wrinkles.maps
        files |= wrinkles.files
        provenance |= {name: ["dome"] for name in wrinkles.maps}
        parts[WRINKLES] = wrinkles.document
    own = {name: value for name, value in base.appearance.parameters.items() if name != "work"}
    parameters: dict[str, Any] = {
        **own,
        "assumed": [
            *(f"{s.rig}: {text}" for s in sources.by_rig.values() for text in _assumed(s)),
            *assumed,
        ],
        "appearances": [one.path.name for one in sources.by_rig.values()],
        FUSION_KEY: {
            "maps": provenance,
            "common": describe_person(person, measured.rigs),
            "translucency_p_value": p_value,
            "checks": describe_checks(checks),
        },
    }
    if parts:
        parameters["parts"] = parts
    if patch is not None:
        parameters[FUSION_KEY]["patch"] = describe_patch(patch)
    files[FUSION_FILE] = json.dumps(parameters[FUSION_KEY], indent=1).encode()
    appearance = derive_appearance(
        *(one.appearance for one in sources.by_rig.values()),
        maps=maps,
        parameters=parameters,
        inputs=_session_input(base) | {one.rig: one.digest for one in sources.by_rig.values()},
        left_out=(*base.appearance.left_out, *left_out),
        files=files,
    )
    return FusedDouble(appearance, person, errors, measured, checks, patch)


def _session_input(base: Source) -> dict[str, str]:
    """Return the hash of the session of the mesh, whose held-out photographs stay held out."""
    found = base.appearance.inputs.get("session")
    return {} if found is None else {"session": found}


def _assumed(source: Source) -> list[str]:
    return list_assumptions(source.appearance)


def measure(sources: Sources, given: FusionInputs) -> Measurements:
    """Bring the colors of all rigs, and the probe's sites, to one texture.

    Parameters
    ----------
    sources
        Maps by rig. The texture is that of the dome, else the image of the flash rig.
    given
        Landmarks and sites.

    Raises
    ------
    FusionInputError
        If the flash image cannot be placed on the dome's mesh.
    """
    dome, flash, probe = (sources.get(name) for name in ("dome", "flash", "probe"))
    colors: list[ColorSource] = []
    assumed: list[str] = []
    left_out: list[tuple[str, str]] = []
    placement: TexelPlacement | None = None
    position = None if dome is None else dome.appearance.maps["position"]
    for one in (dome, flash, probe):
        if one is not None and not one.spectra()[2]:
            assumed.append(f"{one.rig}: camera and light are those of the rig file")
    if dome is not None and ALBEDO_MAP not in given.without:
        camera, illuminant, _ = dome.spectra()
        colors.append(DomeColors.of(dome.appearance, camera, illuminant))
    if flash is not None:
        camera, illuminant, _ = flash.spectra()
        if dome is not None:
            placement = _place_flash(dome, flash, given)
        colors.append(FlashColors.of(flash.appearance, placement, camera, illuminant))
    if not colors:
        raise FusionInputError("--without: got r_d of the only rig with colors; leave out another")
    sites: tuple[probe_sites.ProbeSite, ...] = ()
    bands = None
    if probe is not None and position is None:
        left_out.append(("probe", "its sites are placed on a dome's mesh, which is missing"))
    elif probe is not None and position is not None:
        placed = probe_sites.place_sites(probe.appearance, position, landmarks=given.sites)
        sites, assumed = placed.sites, [*assumed, *placed.assumed]
        left_out += [(f"probe: {site}", why) for site, why in placed.left_out]
        camera, illuminant, _ = probe.spectra()
        bands = RigBands("probe", camera, illuminant, "sigma_tr")
        assumed += _assume_light_distance(probe)
    name = "r_d" if dome is not None else "diffuse"
    first = (sources.get("dome") or sources.by_rig["flash"]).appearance.maps[name]
    return Measurements(
        tuple(colors),
        (first.values.shape[0], first.values.shape[1]),
        sites,
        None if position is None else position.values.reshape(-1, 3),
        tuple(assumed),
        tuple(left_out),
        bands,
        placement,
        COVARIANCE_NAME in given.without,
    )


def _assume_light_distance(probe: Source) -> list[str]:
    """Return what is assumed of a probe's light if its fibers are not the packaged probe's."""
    document = probe.appearance.files.get(PROFILE_FILE)
    packaged = load_rig("probe").probe
    if document is None or packaged is None:
        return []
    usual_mm = packaged.radius_mm
    try:
        radius_mm = [float(radius) for radius in json.loads(document)["radius_mm"]]
        low, high = min(radius_mm), max(radius_mm)
    except (ValueError, KeyError, TypeError) as error:
        raise FusionInputError(
            f"{PROFILE_FILE}: not readable: {error!r}; reconstruct the probe's session again"
        ) from error
    if len(radius_mm) == len(usual_mm) and np.allclose(radius_mm, usual_mm, atol=0.05):
        return []
    return [
        f"probe: its light has sigma_tr at {SIGMA_TR_DISTANCE_MM:g} mm, set for fibers at "
        f"{usual_mm[0]:g} to {usual_mm[-1]:g} mm; its fibers are at {low:g} to "
        f"{high:g} mm"
    ]


def _place_flash(dome: Source, flash: Source, given: FusionInputs) -> TexelPlacement:
    """Return the places of the dome's texels in the flash image."""
    face = face_textures.read(dome.path, given.landmarks)
    if given.image_landmarks is not None:
        from reconstruction.correspondence.landmark_table import read_landmark_table

        pixels = dict(read_landmark_table(given.image_landmarks))
    else:
        truth = flash.truth()
        known: Any = {} if truth is None else truth.parameters.get("landmarks_px", {})
        pixels = {name: (float(x), float(y)) for name, (x, y) in known.items()}
    if not pixels or not face.landmarks:
        which = "--image-landmarks" if not pixels else "--landmarks"
        raise FusionInputError(
            f"{flash.path if not pixels else dome.path}: got maps without landmarks, expected "
            f"some to place the image on the mesh; give {which} FILE"
        )
    normals = next(dome.appearance.maps[n] for n in NORMAL_MAPS if n in dome.appearance.maps)
    position = dome.appearance.maps["position"]
    return place_texels(
        position.values,
        normals.values,
        intersect_valid(position, normals),
        landmarks_mm=face.landmarks,
        landmarks_px=pixels,
    )
