"""Read the surface that a simulation stored with its ground truth for scenes."""

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model.skin import SkinAppearance
from skinrig.exporting.options import ExportError
from skinrig.simulating.orders import SURFACE_FILE


def read_surface(truth: SkinAppearance, session: Path) -> dict[str, NDArray[np.generic]]:
    """Return the arrays of a ground truth's surface.

    Parameters
    ----------
    truth
        Ground truth of a face in the flash rig or of a patch in the gradient rig.
    session
        Its session, for the message.

    Raises
    ------
    ExportError
        The ground truth has no surface.
    """
    if SURFACE_FILE not in truth.files:
        raise ExportError(
            f"{session}: its ground truth has no {SURFACE_FILE}, expected the surface of a scene; "
            "an older version, a sequence or voxels have none: simulate a face [SR-EXP-010]"
        )
    with np.load(io.BytesIO(truth.files[SURFACE_FILE])) as arrays:
        return dict(arrays)
