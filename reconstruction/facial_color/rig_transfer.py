"""Transfer a hemoglobin rig from one face's image to another's by landmarks.

Faces photographed differently have no common map space. Points with the same name on both faces
determine the positions of the rig's stored maps on the other face.
"""

from collections.abc import Mapping

import numpy as np
from scipy import ndimage

from model.checks import Checks
from model.facial_color import HemoglobinRig, StateMaps
from model.facial_color.coarse_maps import CoarseGrid
from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.correspondence import landmark_field

Points = Mapping[str, tuple[float, float]]

TRANSFER_LANDMARK_STDERR_PX = 2.0
"""Standard error of landmarks on two different people, along each axis: their correspondence is
not exact."""
MIN_TRANSFER_LANDMARKS = 4
_MAP_NAMES = ("scale", "bias", "scale_stderr", "bias_stderr", "misfit")


class RigTransferError(ValueError):
    """Landmarks that do not determine the warp between two faces."""


def transfer_rig(
    rig: HemoglobinRig, shape: tuple[int, int], *, landmarks_rig: Points, landmarks_onto: Points
) -> HemoglobinRig:
    """Warp a rig to another face's image, to be applied to that face's blood.

    Parameters
    ----------
    rig
        Rig in the map space of its own face.
    shape
        Rows and columns of the other face's maps.
    landmarks_rig, landmarks_onto
        Named points (x, y) of both faces, px of their maps; those of the same name are used.

    Returns
    -------
    HemoglobinRig
        Rig of the other face's size; its neutral map is the smooth mean of the rig's. Use
        `HemoglobinRig.applied_to` with the other face's blood. Valid where the rig's own maps are
        and where the standard error of the position is within the rig's radius. Within the radius
        the statistics hardly change, so the position error does not add to theirs.

    Raises
    ------
    RigTransferError
        For fewer than `MIN_TRANSFER_LANDMARKS` common names, or points on one line.
    """
    names = sorted(set(landmarks_rig) & set(landmarks_onto))
    got, least = f"{len(names)} names in both tables", MIN_TRANSFER_LANDMARKS
    Checks(RigTransferError).require(
        len(names) >= least, "landmarks", got, f"at least {least}; mark more"
    )
    onto = np.array([landmarks_onto[name] for name in names], np.float64)
    own = np.array([landmarks_rig[name] for name in names], np.float64)
    try:
        field = landmark_field.fit_landmark_field(onto, own, stderr_px=TRANSFER_LANDMARK_STDERR_PX)
    except landmark_field.LandmarkFieldError as error:
        raise RigTransferError(f"landmarks: {error}") from error
    stored = (min(rig.neutral_mean.shape[0], shape[0]), min(rig.neutral_mean.shape[1], shape[1]))
    place = _centers(shape, stored)
    moved, unsure_px = field.evaluate(place.reshape(-1, 2))
    source = place + moved.reshape(place.shape)
    located = unsure_px.reshape(stored) <= rig.radius_px
    sides = zip(
        rig.neutral_mean.shape, rig.neutral.shape, (source[..., 1], source[..., 0]), strict=True
    )
    cell = np.stack([(at + 0.5) * few / full - 0.5 for few, full, at in sides])
    mean, seen = _sampled(rig.neutral_mean, rig.neutral_mean_valid, cell)
    here = seen & located
    states: dict[str, StateMaps] = {}
    for name, state in rig.states.items():
        sampled = {part: _sampled(getattr(state, part), state.valid, cell) for part in _MAP_NAMES}
        good = np.logical_and.reduce([here, *(seen for _, seen in sampled.values())])
        maps = {part: np.where(good, values, 0.0) for part, (values, _) in sampled.items()}
        states[name] = StateMaps(
            **maps,
            valid=good,
            prior=state.prior,
            storage_rms=state.storage_rms,
            storage_largest=state.storage_largest,
        )
    (neutral,) = CoarseGrid(shape, stored).refine(np.where(here, mean, 0.0), valid=here)
    valid = np.isfinite(neutral)
    size = float(np.median(np.hypot(*np.gradient(source[..., 0]))))
    per_cell = shape[1] / stored[1]
    return HemoglobinRig(
        neutral=np.where(valid, neutral, 0.0),
        valid=valid,
        neutral_stderr=np.zeros(shape),
        neutral_mean=np.where(here, mean, 0.0),
        states=states,
        radius_px=rig.radius_px * per_cell / max(size, 1e-9),
        global_states=rig.global_states,
    )


def _centers(shape: tuple[int, int], stored: tuple[int, int]) -> Float64Array:
    """Return the positions of the cells' centers on the map, (h, w, 2) as (x, y) px."""
    rows, columns = (
        (np.arange(few) + 0.5) * full / few - 0.5 for full, few in zip(shape, stored, strict=True)
    )
    return np.stack(np.meshgrid(columns, rows), axis=-1)


def _sampled(
    values: Float64Array, valid: BoolArray, cell: Float64Array
) -> tuple[Float64Array, BoolArray]:
    """Interpolate a stored map at positions (2, h, w), rows first; return also its validity."""
    share = ndimage.map_coordinates(valid.astype(np.float64), cell, order=1, cval=0.0)
    total = ndimage.map_coordinates(np.where(valid, values, 0.0), cell, order=1, cval=0.0)
    known = share > 0.5
    return np.where(known, total / np.where(known, share, 1.0), 0.0), known
