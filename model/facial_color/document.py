"""Convert a hemoglobin rig to maps of an APPEARANCE/ folder with one JSON document, and back."""

import json
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from model.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from model.checks import Checks
from model.checks.files import decode_json
from model.facial_color.rig import HemoglobinRig
from model.facial_color.state_maps import NEUTRAL, FacialColorError, StateMaps
from model.skin import MAP_UNITS, SkinMap

SCHEMA: Final = "skinrig.facial-color/1"
RIG_DOCUMENT: Final = "facial_color.json"
_COMMON_KEY: Final = "common_log_sd"
"""Key that documents of earlier versions lack."""
_BLOOD_UNIT: Final = MAP_UNITS["hemoglobin"]
_DOCUMENT_KEYS: Final = {"schema", "radius_px", "shape", "stored", "global_states", "states"}
_NEUTRAL_TEXT: Final = "neutral state; linear volume fraction"
_NEUTRAL_MEAN_TEXT: Final = "mean of the neutral state in a disc"
_STATE_MAPS: Final = {
    "scale": ("1", "deviation in a disc over that of the neutral state"),
    "bias": (_BLOOD_UNIT, "mean in a disc"),
    "misfit": (_BLOOD_UNIT, "deviation in a disc of the measured state from scale and bias"),
}
"""Units and descriptions of each state's maps."""
_STATE_KEYS: Final = ("prior", "storage_rms", "storage_largest")


def to_maps(rig: HemoglobinRig) -> tuple[dict[str, SkinMap], bytes]:
    """Return a rig's maps by name, and its document."""
    maps = {
        "hemoglobin": _skin_map(
            rig.neutral, _BLOOD_UNIT, rig.neutral_stderr, rig.valid, _NEUTRAL_TEXT
        ),
        f"bias_{NEUTRAL}": _skin_map(
            rig.neutral_mean, _BLOOD_UNIT, None, rig.neutral_mean_valid, _NEUTRAL_MEAN_TEXT
        ),
    }
    states: dict[str, Any] = {}
    for name, state in rig.states.items():
        for kind, (unit, text) in _STATE_MAPS.items():
            stderr = getattr(state, f"{kind}_stderr", None)
            maps[f"{kind}_{name}"] = _skin_map(
                getattr(state, kind), unit, stderr, state.valid, text
            )
        states[name] = {key: getattr(state, key) for key in _STATE_KEYS}
    document = {
        "schema": SCHEMA,
        "radius_px": rig.radius_px,
        "shape": list(rig.neutral.shape),
        "stored": list(rig.neutral_mean.shape),
        "global_states": list(rig.global_states),
        _COMMON_KEY: rig.common_log_sd,
        "states": states,
    }
    return maps, (json.dumps(document, indent=1, allow_nan=False) + "\n").encode("utf-8")


def from_maps_and_document(maps: Mapping[str, SkinMap], document: bytes) -> HemoglobinRig:
    """Return the rig of `to_maps`; maps of other names are ignored.

    Raises
    ------
    FacialColorError
        For a map or key that is missing, unknown, of another schema or of another shape; names it.
    """
    try:
        loaded = decode_json(document)
    except ValueError as error:
        raise FacialColorError(f"{RIG_DOCUMENT}: is not JSON ({error})") from error
    version = loaded.get("schema") if isinstance(loaded, dict) else None
    if version != SCHEMA:
        raise FacialColorError(f"{RIG_DOCUMENT}: got schema {version!r}, expected {SCHEMA!r}")
    common = _number(_COMMON_KEY, loaded.pop(_COMMON_KEY, 0.0))
    _require_equal("", loaded, _DOCUMENT_KEYS)
    shape, stored = (_size(key, loaded[key]) for key in ("shape", "stored"))
    radius = _number("radius_px", loaded["radius_px"])
    listed = loaded["global_states"]
    if not (isinstance(listed, list) and all(isinstance(name, str) for name in listed)):
        raise FacialColorError(f"{RIG_DOCUMENT}: global_states: got {listed!r}, expected names")
    if not isinstance(loaded["states"], dict):
        raise FacialColorError(f"{RIG_DOCUMENT}: states: expected an object by name")
    neutral = _map(maps, "hemoglobin", shape, _BLOOD_UNIT)
    states = {}
    for name, entry in loaded["states"].items():
        if not isinstance(entry, dict):
            raise FacialColorError(f"{RIG_DOCUMENT}: states.{name}: expected an object")
        _require_equal(f"states.{name}.", entry, set(_STATE_KEYS))
        number = {key: _number(f"states.{name}.{key}", entry[key]) for key in _STATE_KEYS}
        scale, bias, misfit = (
            _map(maps, f"{kind}_{name}", stored, unit) for kind, (unit, _) in _STATE_MAPS.items()
        )
        valid = scale.mask
        states[name] = StateMaps(
            scale=_double(scale.values, valid),
            bias=_double(bias.values, valid),
            scale_stderr=_double(_stderr(scale), valid),
            bias_stderr=_double(_stderr(bias), valid),
            misfit=_double(misfit.values, valid),
            valid=valid,
            **number,
        )
    mean = _map(maps, f"bias_{NEUTRAL}", stored, _BLOOD_UNIT)
    held = neutral.mask
    return HemoglobinRig(
        neutral=np.where(held, neutral.values, np.float32(0)),
        valid=held,
        neutral_stderr=np.where(held, _stderr(neutral), np.float32(0)),
        neutral_mean=_double(mean.values, mean.mask),
        states=states,
        radius_px=radius,
        global_states=tuple(listed),
        common_log_sd=common,
    )


def _skin_map(
    values: FloatArray, unit: str, stderr: FloatArray | None, valid: BoolArray, text: str
) -> SkinMap:
    error = None if stderr is None else stderr.astype(np.float32)
    return SkinMap(values.astype(np.float32), unit, error, valid, text)


def _double(values: Float32Array, valid: BoolArray) -> Float64Array:
    return np.where(valid, values, 0.0).astype(np.float64)


def _stderr(skin_map: SkinMap) -> Float32Array:
    if skin_map.stderr is None:
        return np.zeros(skin_map.values.shape, np.float32)
    return skin_map.stderr


def _map(maps: Mapping[str, SkinMap], name: str, shape: tuple[int, int], unit: str) -> SkinMap:
    if name not in maps:
        raise FacialColorError(f"maps: {name!r} is missing, which {RIG_DOCUMENT} needs")
    found = maps[name]
    Checks(FacialColorError).shape(name, found.values, shape)
    Checks(FacialColorError).choice(f"unit of {name}", found.unit, (unit,))
    return found


def _require_equal(where: str, got: Mapping[str, Any], expected: set[str]) -> None:
    for key in sorted(expected - set(got)):
        raise FacialColorError(f"{RIG_DOCUMENT}: {where}{key} is missing")
    for key in sorted(set(got) - expected):
        raise FacialColorError(f"{RIG_DOCUMENT}: {where}{key} is unknown")


def _number(where: str, got: object) -> float:
    if isinstance(got, bool) or not isinstance(got, int | float) or not np.isfinite(got):
        raise FacialColorError(f"{RIG_DOCUMENT}: {where}: got {got!r}, expected a finite number")
    return float(got)


def _size(where: str, got: object) -> tuple[int, int]:
    if (
        isinstance(got, list)
        and len(got) == 2
        and all(isinstance(n, int) and not isinstance(n, bool) and n >= 1 for n in got)
    ):
        return got[0], got[1]
    raise FacialColorError(f"{RIG_DOCUMENT}: {where}: got {got!r}, expected two numbers of pixels")
