"""Images of a session with the faults that they show."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from numpy.typing import NDArray

from model.skin import SkinMap
from reconstruction.arrays import Float64Array
from reconstruction.pipeline.inputs import Inputs
from reconstruction.stack_diagnosis import Diagnosis, Finding

FAULT_MARK = "; images have faults: "
"""Begins the end of a map's description."""
FAULTS_NOTE = "image_faults"
"""Parameter of the maps: the faults that their images still have."""


@dataclass(frozen=True, slots=True)
class ImageGroup:
    """Findings whose frames count the group's names, and its images (H, W)."""

    findings: Sequence[Finding]
    names: Sequence[str]
    images: Sequence[NDArray[Any]]


@dataclass(frozen=True, slots=True)
class DiagnosedImages:
    """Images of a session with what is wrong with them.

    Attributes
    ----------
    findings
        Faults, the most certain first; their frames count `names`.
    names
        Of the N images: a number, or state, polarizer and pattern.
    gray
        N images (H, W), linear; those of a light list over exposure and strength of the light.
    diagnosis
        Of images under listed lights; None: of other sessions.
    listed
        (N, 3), unit vectors of the list, in the order of the images; None: of other sessions.
    assumed
        What the import of the images assumed, such as the loss by compression of a video, and
        which images could not be compared.
    """

    findings: tuple[Finding, ...]
    names: tuple[str, ...]
    gray: Sequence[NDArray[Any]] | NDArray[Any]
    diagnosis: Diagnosis | None = None
    listed: Float64Array | None = None
    assumed: tuple[str, ...] = ()

    def name_images(self, one: Finding) -> str:
        """Return the names of a finding's images; "all" for one of all images."""
        return ", ".join(self.names[number] for number in one.frames) or "all"

    def record_in(self, inputs: Inputs) -> None:
        """Note the findings in the record of a reconstruction, whose maps then name them."""
        inputs.noted["diagnosis"] = [
            one.to_json() | {"names": [self.names[k] for k in one.frames]} for one in self.findings
        ]
        inputs.assumed += self.assumed
        inputs.assumed += [
            f"{one.fault} ({self.name_images(one)}): {one.evidence}; {one.remedy}"
            for one in self.findings
        ]
        inputs.noted[FAULTS_NOTE] = [self._describe(one) for one in self.findings]

    def _describe(self, one: Finding) -> str:
        first, *others = [self.names[number] for number in one.frames] or ["all images"]
        return f"{one.fault} ({first}{f' and {len(others)} more' * bool(others)})"

    def to_json(self) -> dict[str, Any]:
        """Return findings and names, and of a light list its order and directions, from 1."""
        found: dict[str, Any] = {
            "findings": [one.to_json() for one in self.findings],
            "names": list(self.names),
            "assumed": list(self.assumed),
        }
        if self.diagnosis is None:
            return found
        return found | {
            "order": [int(number) + 1 for number in self.diagnosis.order],
            "left_out": [int(number) + 1 for number in self.diagnosis.left_out.nonzero()[0]],
            "directions": self.diagnosis.directions,
            "strength": self.diagnosis.strength,
        }


def collect_images(groups: Iterable[ImageGroup]) -> DiagnosedImages:
    """Join the findings, names and images of several groups; frames then count all images."""
    findings: list[Finding] = []
    names: list[str] = []
    images: list[NDArray[Any]] = []
    for one in groups:
        findings += renumber(one.findings, range(len(names), len(names) + len(one.names)))
        names += one.names
        images += one.images
    findings.sort(key=lambda one: -one.ratio_to_limit)
    return DiagnosedImages(tuple(findings), tuple(names), tuple(images))


def renumber(findings: Iterable[Finding], numbers: Sequence[int]) -> list[Finding]:
    """Return findings about some of the images with the numbers of all.

    Raises
    ------
    ValueError
        If a finding's frame or its new number is negative: it would count from the end.
    """
    found = []
    for one in findings:
        frames = tuple(sorted(numbers[k] for k in one.frames))
        if min((*one.frames, *frames), default=0) < 0:
            got = f"{one.fault}: got frames {one.frames} with the numbers {frames}"
            raise ValueError(f"{got}, expected none below 0; leave out images that are not there")
        found.append(replace(one, frames=frames))
    return found


def mark_faults(maps: Mapping[str, Any], faults: Sequence[str]) -> dict[str, Any]:
    """Return products whose maps' descriptions name the faults that their images still have.

    Examples
    --------
    >>> import numpy as np
    >>> one = SkinMap(np.zeros((2, 2), np.float32), "1", description="light")
    >>> mark_faults({"a": one}, ["near lights"])["a"].description
    'light; images have faults: near lights'
    """
    mark = f"{FAULT_MARK}{', '.join(faults)}" if faults else ""
    return {
        name: replace(one, description=one.description.split(FAULT_MARK)[0] + mark)
        if isinstance(one, SkinMap)
        else one
        for name, one in maps.items()
    }
