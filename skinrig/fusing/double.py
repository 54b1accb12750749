"""Fuse one person's maps by several rigs into one appearance: `skinrig fuse`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from model import store
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from model.skin_reflectance import NORMAL_MAPS, TRANSLUCENCY_MAP
from reconstruction.fusion.consistency import MIN_PROBABILITY, RigCheck, check_rigs, name_faulty_rig
from reconstruction.fusion.patch_normals import PatchCheck
from reconstruction.fusion.person import PersonSkin
from reconstruction.fusion.signals import RigBands
from reconstruction.fusion.texels import (
    BLOCK_TEXELS,
    OffsetModel,
    TexelSkin,
    estimate_texels,
    melanin_depth_factor,
)
from reconstruction.subsurface.translucency import TranslucencyPrior
from skinrig.appearances import face_textures
from skinrig.appearances.contents import (
    FUSION_KEY,
    derive_appearance,
    intersect_valid,
    list_assumptions,
)
from skinrig.appearances.texel_placement import TexelPlacement, place_texels
from skinrig.arrays import Float32Array, Int64Array
from skinrig.fitting import probe_sites
from skinrig.fusing.description import describe_checks, describe_patch, describe_person
from skinrig.fusing.measurements import SITE_SIGMA_TR_SD, Measurements
from skinrig.fusing.patches import PATCH_PREFIX, PlacedPatch, place_patch
from skinrig.fusing.sources import FusionInputError, Source, Sources, read_sources
from skinrig.fusing.texel_colors import (
    LOG_R_D_OVER_REFLECTANCE,
    ColorSource,
    DomeColors,
    FlashColors,
)

OWN_SUFFIX: Final = "_texel_stderr"
"""Suffix of maps of standard errors without those common to the face."""
QUANTITY_BY_RIG: Final[Mapping[str, str]] = {
    "dome": "R_d",
    "flash": "diffuse light",
    "probe": "sigma_tr",
    "gradient": "normals",
}
"""Quantity of a rig in the name of a contradiction."""
FUSED_MAPS: Final = ("melanin", "melanin_optical_depth", "hemoglobin", "r_d", TRANSLUCENCY_MAP)
"""Maps that the fusion estimates; all others are carried over."""


@dataclass(frozen=True, slots=True)
class FusionInputs:
    """Files and choices of a fusion.

    Attributes
    ----------
    paths
        Sessions with their maps next to them, or appearances, one per rig.
    without
        Rigs to leave out.
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

    @property
    def assumed(self) -> tuple[str, ...]:
        """What was assumed."""
        return (*self.measured.assumed, *(() if self.patch is None else self.patch.assumed))

    @property
    def left_out(self) -> tuple[tuple[str, str], ...]:
        """What was omitted, with reasons."""
        return (*self.measured.left_out, *(() if self.patch is None else self.patch.left_out))

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
    given: FusionInputs, *, out: Path, progress: Callable[[str], None] | None = None
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

    Raises
    ------
    FusionInputError
        If folders cannot be fused; the message names them.
    """
    store.require_free(out)
    sources = read_sources(given.paths).without(given.without)
    if any(one.path.resolve() == out.resolve() for one in sources.by_rig.values()):
        raise FusionInputError(f"{out}: is one of the inputs; name another --out")
    found = fuse_sources(sources, given, progress=progress)
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
        Landmarks and sites.
    progress
        As of `fuse`.
    """
    report = progress or (lambda _step: None)
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
    fused, p_value = _fused_maps(measured, person, errors, base, report)
    maps = {name: maps[name] for name in carried} | fused
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
    if patch is not None:
        parameters["parts"] = patch.parameters
        parameters[FUSION_KEY]["patch"] = describe_patch(patch)
    appearance = derive_appearance(
        *(one.appearance for one in sources.by_rig.values()),
        maps=maps,
        parameters=parameters,
        inputs={one.rig: one.digest for one in sources.by_rig.values()},
        left_out=(*base.appearance.left_out, *left_out),
        files=files,
    )
    return FusedDouble(appearance, person, errors, measured, checks, patch)


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
    if dome is not None:
        camera, illuminant, _ = dome.spectra()
        colors.append(DomeColors.of(dome.appearance, camera, illuminant))
    if flash is not None:
        camera, illuminant, _ = flash.spectra()
        if dome is not None:
            placement = _place_flash(dome, flash, given)
        colors.append(FlashColors.of(flash.appearance, placement, camera, illuminant))
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
    )


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


def _fused_maps(
    measured: Measurements,
    person: PersonSkin,
    errors: OffsetModel,
    base: Source,
    report: Callable[[str], None],
) -> tuple[dict[str, SkinMap], list[float]]:
    """Estimate all texels block by block, and write the maps."""
    height, width = measured.shape
    planes = {
        name: np.zeros((measured.count, channels), np.float32)
        for name, channels in (
            ("melanin", 3),
            ("depth", 2),
            ("blood", 3),
            ("covariance", 1),
            ("misfit", 1),
            ("r_d", 9),
            ("expected", 3),
        )
    }
    valid = np.zeros(measured.count, bool)
    factor = melanin_depth_factor(person.properties_sd)
    known = np.flatnonzero(np.logical_or.reduce([one.valid for one in measured.colors]))
    for start in range(0, known.size, BLOCK_TEXELS):
        report(f"texels: {100 * start // known.size} %")
        block = known[start : start + BLOCK_TEXELS]
        colors = [one.colors(k, block) for k, one in enumerate(measured.colors)]
        for _, skin in estimate_texels(person, colors, errors):
            _write_block(planes, block, skin, factor, measured)
            valid[block] = skin.valid

    def one_map(plane: str, column: int, error: int | None, unit: str, what: str) -> SkinMap:
        values = planes[plane].reshape(height, width, -1)
        stderr = None if error is None else values[..., error]
        return SkinMap(values[..., column], unit, stderr, valid.reshape(height, width), what)

    thickness = "for an epidermis of 0.09 mm"
    apart = "standard error by errors of the texel alone"
    maps = {
        "melanin": one_map("melanin", 0, 1, MAP_UNITS["melanin"], f"fused, {thickness}"),
        f"melanin{OWN_SUFFIX}": one_map("melanin", 2, None, MAP_UNITS["melanin"], apart),
        "melanin_optical_depth": one_map("depth", 0, 1, "1", "fused, at 550 nm"),
        "hemoglobin": one_map("blood", 0, 1, MAP_UNITS["hemoglobin"], "fused"),
        f"hemoglobin{OWN_SUFFIX}": one_map("blood", 2, None, MAP_UNITS["hemoglobin"], apart),
        "melanin_blood_covariance": one_map(
            "covariance", 0, None, "1", "covariance of log melanin optical depth and log blood"
        ),
        "fusion_misfit": one_map("misfit", 0, None, "1", "chi-squared over degrees of freedom"),
    }
    if base.rig == "dome":
        r_d, good = planes["r_d"].reshape(height, width, 9), valid.reshape(height, width)
        what = "fused, camera RGB over that of a perfect white"
        maps["r_d"] = SkinMap(r_d[..., :3], "1", r_d[..., 3:6], good, what)
        maps[f"r_d{OWN_SUFFIX}"] = SkinMap(r_d[..., 6:], "1", None, good, apart)
    p_value: list[float] = []
    if measured.probe_bands is not None:
        usual = measured.errors(person.mean).unexplained
        at_mm = base.appearance.maps["position"]
        place = SkinMap(
            at_mm.values, "mm", valid=intersect_valid(at_mm) & valid.reshape(height, width)
        )
        prior = TranslucencyPrior(
            np.zeros(3), np.sqrt(np.diag(usual)[-3:]), np.full(3, SITE_SIGMA_TR_SD)
        )
        # a site may be at a texel without colors
        planes["expected"][~valid] = np.median(planes["expected"][valid], axis=0)
        expected = planes["expected"].reshape(height, width, 3)
        found = probe_sites.interpolate_sites(
            measured.sites, place, prior=prior, expected_mm=expected
        )
        maps[TRANSLUCENCY_MAP] = found.map
        p_value = list(found.p_value)
    return maps, p_value


def _write_block(
    planes: Mapping[str, Float32Array],
    block: Int64Array,
    skin: TexelSkin,
    factor: float,
    measured: Measurements,
) -> None:
    """Write the estimates of a block into the planes of the maps."""
    depth, blood = np.exp(skin.log_skin).T
    melanin = depth / factor
    own = np.sqrt(np.einsum("naa->na", skin.covariance))
    both = skin.covariance + skin.common
    total = np.sqrt(np.einsum("naa->na", both))
    # half-widths of 68 % intervals of lognormal quantities
    planes["melanin"][block] = np.stack(
        [
            melanin,
            melanin * np.sinh(np.sqrt(skin.log_melanin_variance)),
            melanin * np.sinh(own[:, 0]),
        ],
        axis=-1,
    )
    planes["depth"][block] = np.stack([depth, depth * np.sinh(total[:, 0])], axis=-1)
    planes["blood"][block] = np.stack(
        [blood, blood * np.sinh(total[:, 1]), blood * np.sinh(own[:, 1])], axis=-1
    )
    planes["covariance"][block, 0] = both[:, 0, 1]
    planes["misfit"][block, 0] = skin.misfit
    if measured.rigs[0].rig == "dome":
        r_d = np.exp(skin.log_signals[:, :3] + LOG_R_D_OVER_REFLECTANCE)
        own, common = skin.signal_variance[:, :3], skin.signal_common[:, :3]
        sd = np.sinh(np.sqrt(np.concatenate([own + common, own], axis=-1)))
        planes["r_d"][block] = np.concatenate([r_d, np.tile(r_d, 2) * sd], axis=-1)
    if measured.probe_bands is not None:
        planes["expected"][block] = np.exp(-skin.log_signals[:, -3:])
