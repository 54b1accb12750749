"""Build the assets of Jimenez 2010: chromophores, hemoglobin rig, skin color table, albedo."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from capture.calibration import store
from capture.calibration.color import matrix as color
from capture.session import Session, SessionError
from model import color_table, spectra
from model.facial_color import HemoglobinRig
from model.facial_color.rig import GLOBAL_GAINS
from model.facial_color.state_maps import NEUTRAL
from model.skin import SkinAppearance, SkinMap
from model.tissue_optics.layers import ANISOTROPY_SKIN, C_HD_MAX, C_M_MAX
from rigsim.subject import SimulatedSubject
from rigsim.subject.perfusion import STATE_NAMES
from skinrig.appearances.contents import hash_file as sha256_of
from skinrig.appearances.dynamic import FACIAL_COLOR, describe_parts
from skinrig.arrays import Float64Array
from skinrig.capturing.camera_colors import fit_skin_colors
from skinrig.viewer.assets.placed_color import (
    RIG_PX,
    FaceColor,
    place_chromophores,
    place_facial_color,
)
from skinrig.viewer.fine_skin import FineSkin
from skinrig.viewer.map_filling import downsample, fill_holes
from skinrig.viewer.scene import Assets, SceneSource, Texture

COLOR_KIND: Final = "color"
CALIBRATION_INPUT_PREFIX: Final = "calibration "
"""Prefix of an appearance's inputs that are files of a calibration."""


@dataclass(frozen=True, slots=True)
class CameraColor:
    """Conversion of camera RGB, relative to white, to linear sRGB.

    Attributes
    ----------
    convert
        Function from (..., 3) to (..., 3).
    provenance
        Source of the conversion, in words.
    known
        False: unknown, and camera RGB is taken as linear sRGB.
    """

    convert: Callable[[Float64Array], Float64Array]
    provenance: str
    known: bool = True


def find_camera_color(source: SceneSource) -> CameraColor:
    """Find the color conversion of the camera that measured a scene's albedo.

    Raises
    ------
    capture.calibration.record.CalibrationError
        If a color calibration is damaged, or missing in the given folder.
    """
    kind = next(name for name in ("model", "dome") if name in source.appearances)
    appearance, path = source.appearances[kind], source.paths.get(kind)
    folder = source.calibration or (None if path is None else _find_calibration(appearance, path))
    if folder is not None:
        return _calibrated_color(folder)
    found = None if path is None else _tabulated_color(appearance, path)
    shown = "camera RGB is displayed as linear sRGB; give --calibration with a color calibration"
    return found or CameraColor(lambda rgb: rgb, shown, known=False)


def _find_calibration(appearance: SkinAppearance, path: Path) -> Path | None:
    """Return the calibration of an appearance, if it is next to it and has color."""
    digests = {
        name.removeprefix(CALIBRATION_INPUT_PREFIX): digest
        for name, digest in appearance.inputs.items()
        if name.startswith(CALIBRATION_INPUT_PREFIX)
    }
    for folder in sorted(path.resolve().parent.iterdir()):
        if not (folder / f"{COLOR_KIND}.json").is_file():
            continue
        for kind, digest in digests.items():
            file = folder / f"{kind}.json"
            if file.is_file() and sha256_of(file) == digest:
                return folder
    return None


def _calibrated_color(folder: Path) -> CameraColor:

    found = store.load(folder, COLOR_KIND)
    cameras = [
        (color.from_calibration(found, serial), found.quantity(serial, "white_rgb").value)
        for serial in found.serials
    ]
    error = float(np.mean([one.mean_delta_e for one, _ in cameras]))

    def convert(rgb: Float64Array) -> Float64Array:
        # maps are merged over all cameras, thus their conversions are averaged
        seen = [one.to_linear_srgb(rgb * white) for one, white in cameras]
        return np.asarray(np.mean(seen, axis=0))

    several = f" of {len(cameras)} cameras" if len(cameras) > 1 else ""
    quality = f"{error:.1f} dE2000 on held-out patches"
    return CameraColor(convert, f"{folder.name}/{COLOR_KIND}.json{several}, {quality}")


def _tabulated_color(appearance: SkinAppearance, path: Path) -> CameraColor | None:
    """Fit a matrix for skin colors, if a session next to the maps records sensor and light."""
    name: Any = appearance.parameters.get("session")
    if not isinstance(name, str):
        return None
    folder = path.resolve().parent / Path(name).name
    try:
        rig = Session.open(folder).rig
    except (SessionError, OSError):
        return None
    camera, light = rig.views[0].spectral_sensitivity, rig.lights[0].illuminant
    if camera not in spectra.camera_names() or light not in spectra.illuminant_names():
        return None
    matrix, error = fit_skin_colors(camera, light)
    return CameraColor(
        lambda rgb: np.asarray(rgb @ matrix),
        f"without color calibration; matrix for skin colors from the tabulated sensor "
        f"{camera} under {light} to linear sRGB, {error:.4f} RMS",
    )


TABLE_NODES: Final = 128
"""Nodes along each axis of the color table."""
RADIUS_PER_SIZE: Final = 24.0 / 512.0
"""Radius of the disc of local statistics, fraction of the map's side."""
FINEST_STEP_WORDS: Final = 8
"""Quantization step of the finest octave for large chromophore maps; detail below 0.4 mm is mostly
noise."""
MIN_ROUNDED_PX: Final = 1024
"""Side from which on the finest octave of chromophores is rounded, texels."""
ALBEDO_MAP: Final = "r_d"
CHROMOPHORE_MAPS: Final = ("melanin", "hemoglobin")


def build_assets(source: SceneSource) -> Assets:
    """Build chromophores, color table, hemoglobin rig and the albedo, if measured."""
    albedo = _albedo(source)
    found = _face(source, measured=albedo is not None)
    table = color_table.build(
        spectra.LINEAR_SRGB, "D65", size=TABLE_NODES, anisotropy=ANISOTROPY_SKIN
    )
    textures = build_textures(found)
    names = list(found.states)
    facts: dict[str, Any] = {
        "color_table": {"c_m_max": C_M_MAX, "c_hd_max": C_HD_MAX, "size": TABLE_NODES},
        "facial_color": {
            "states": names,
            "gains": {n: g for n, g in GLOBAL_GAINS.items() if n in names},
            "global_states": list(found.global_states),
            **found.facts,
        },
    }
    left_out = dict(found.left_out)
    if albedo is not None:
        textures["albedo_map"], seen = albedo
        facts["albedo_color"] = seen.provenance
        if not seen.known:
            left_out["colors of this face"] = seen.provenance
        if _measured_chromophores(source) is None:
            left_out["chromophores of this face"] = (
                "the dome measures color only; expressions scale it by the ratio of simulated blood"
            )
    return {
        "textures": textures,
        # 11 bits are finer than linear interpolation between the nodes, and pack twice as small
        "tables": {"skin_color": table.rgb.astype(np.float16).astype(np.float32)},
        "facts": facts,
        "params": {"weights": dict.fromkeys([*names[1:], *source.mesh.shapes], 0.0)},
        "left_out": tuple(left_out.items()),
    }


def build_textures(face: FaceColor) -> dict[str, Texture]:
    """Build the textures of a face's chromophores and of its blood by expression."""
    roots = np.cbrt(np.stack([face.melanin, face.hemoglobin], axis=-1))
    return {
        "chromophores": Texture(
            roots.astype(np.float32), fine=FINEST_STEP_WORDS if len(roots) >= MIN_ROUNDED_PX else 1
        ),
        "facial_states": Texture(np.stack(list(face.states.values())).astype(np.float32), "u8"),
    }


def _face(source: SceneSource, *, measured: bool) -> FaceColor:
    """Return the chromophores, coarse if albedo is measured, as then only changes are visible."""
    subject, dynamic = source.subject, source.appearances.get("dynamic")
    if dynamic is not None and FACIAL_COLOR in describe_parts(dynamic):
        return place_facial_color(source)
    found = simulate_chromophores(
        subject, FineSkin(subject, subject.size) if measured else source.skin
    )
    if "flash" in source.appearances:
        return _placed_chromophores(source, found)
    fused = _measured_chromophores(source)
    if fused is None:
        return found
    maps = [downsample(fill_holes(one.values, one.mask), source.size) for one in fused]
    facts = {"source": source.fitted[0].source}
    return replace(found, melanin=maps[0], hemoglobin=maps[1], facts=facts)


def _measured_chromophores(source: SceneSource) -> tuple[SkinMap, SkinMap] | None:
    """Return melanin and blood on the albedo's texture, of a fused person; None without them."""
    for appearance in source.fitted:
        maps = [appearance.maps.get(name) for name in CHROMOPHORE_MAPS]
        if ALBEDO_MAP in appearance.maps and maps[0] is not None and maps[1] is not None:
            return maps[0], maps[1]
    return None


def _placed_chromophores(source: SceneSource, simulated: FaceColor) -> FaceColor:
    """Return the flash rig's chromophores on the texture, with the simulated rig for its blood."""
    placed, subject = place_chromophores(source, simulated), source.subject
    hemoglobin = downsample(placed.hemoglobin, subject.size)
    covered = downsample(subject.atlas.covered.astype(np.float64), len(hemoglobin)) > 0.5
    rig = _simulate_rig(subject).transfer_to(hemoglobin, valid=covered)
    return replace(placed, states=_stored_states(rig))


def _simulate_rig(person: SimulatedSubject) -> HemoglobinRig:
    """Simulate a person's hemoglobin rig of all expressions."""
    return HemoglobinRig.from_maps(
        person.hemoglobin(),
        {name: person.hemoglobin(name) for name in STATE_NAMES if name != NEUTRAL},
        radius_px=RADIUS_PER_SIZE * person.size,
        valid=person.atlas.covered,
        stored_size=min(RIG_PX, person.size),
    )


def simulate_chromophores(person: SimulatedSubject, skin: FineSkin) -> FaceColor:
    """Simulate the chromophores of a person, with a rig of all expressions."""
    rig = _simulate_rig(person)
    return FaceColor(
        melanin=skin.melanin(),
        hemoglobin=skin.hemoglobin(),
        states=_stored_states(rig),
        global_states=rig.global_states,
        facts={"source": "simulated"},
    )


def _stored_states(rig: HemoglobinRig) -> dict[str, Float64Array]:
    """Return a rig's scale and bias by expression, (h, w, 2), with invalid cells filled."""
    valid = {NEUTRAL: rig.neutral_mean_valid, **{name: m.valid for name, m in rig.states.items()}}
    return {
        name: fill_holes(np.stack([rig.scale[name], rig.bias[name]], axis=-1), valid[name])
        for name in (NEUTRAL, *rig.states)
    }


def _albedo(source: SceneSource) -> tuple[Texture, CameraColor] | None:
    """Return the measured albedo, (N, N, 3), of the dome's or a fitted model's folder."""
    for appearance in source.fitted:
        if ALBEDO_MAP not in appearance.maps:
            continue
        found = appearance.maps[ALBEDO_MAP]
        values = fill_holes(found.values, found.mask)
        seen = find_camera_color(source)
        shown = np.clip(seen.convert(downsample(values, source.size)), 0.0, 1.0)
        return Texture(shown.astype(np.float32), "u8"), seen
    return None
