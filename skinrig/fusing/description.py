"""Describe a fusion by JSON values: common properties, agreement of the rigs, the patch."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from reconstruction.fusion.consistency import RigCheck
from reconstruction.fusion.person import PersonSkin
from reconstruction.fusion.signals import PROPERTY_NAMES, RigBands
from skinrig.fusing.patches import PlacedPatch


def describe_person(person: PersonSkin, rigs: Sequence[RigBands]) -> dict[str, Any]:
    """Return what the person's skin has in common, as JSON values.

    Parameters
    ----------
    person
        Estimate.
    rigs
        Rigs of the signals.
    """
    sd = np.sqrt(np.diag(person.covariance))
    return {
        "properties_sd": {
            name: {"value": float(person.properties_sd[k]), "stderr": float(sd[k])}
            for k, name in enumerate(PROPERTY_NAMES)
        },
        "log_offset": {
            rig.rig: {
                "value": person.offset[3 * k : 3 * k + 3].tolist(),
                "stderr": sd[6 + 3 * k : 9 + 3 * k].tolist(),
            }
            for k, rig in enumerate(rigs)
        },
        "log_melanin_stderr": float(sd[-2]),
        "log_blood_stderr": float(sd[-1]),
    }


def describe_checks(checks: Sequence[RigCheck]) -> list[dict[str, Any]]:
    """Return the agreement of the rigs, as JSON values.

    Parameters
    ----------
    checks
        Of all rigs.
    """
    return [
        {
            "rig": check.rig,
            "probability_faulty": check.probability,
            "log_gain": check.log_gain.tolist(),
            "stderr": check.stderr.tolist(),
            "p_value": check.p_value,
        }
        for check in checks
    ]


def describe_patch(patch: PlacedPatch) -> dict[str, Any]:
    """Return the place and the agreement of the gradient rig's patch, as JSON values.

    Parameters
    ----------
    patch
        Patch on the face.
    """
    degrees = np.degrees(
        [patch.check.rotation_rad, patch.check.rotation_stderr_rad, patch.check.tilt_rad]
    )
    found: dict[str, Any] = {
        "site": patch.site,
        "probability_faulty": patch.check.probability,
        "p_value": patch.check.p_value,
        "rotation_deg": {"value": float(degrees[0]), "stderr": float(degrees[1])},
        "tilt_deg": float(degrees[2]),
    }
    if patch.fused is not None:
        found["common_covariance_rad2"] = patch.fused.common.tolist()
    return found
