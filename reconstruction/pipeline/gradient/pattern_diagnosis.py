"""Diagnose the patterns of a gradient session: exchanged, missing and inconsistent images."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from capture.plan.gradient import strain_state
from capture.session import Session
from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.pipeline.diagnosed_images import (
    DiagnosedImages,
    ImageGroup,
    collect_images,
    renumber,
)
from reconstruction.pipeline.gradient.images import GradientImages, Key, StatePatterns
from reconstruction.pipeline.gradient.skin_strain import skin_mask
from reconstruction.pipeline.inputs import InputsError
from reconstruction.stack_diagnosis import Finding
from reconstruction.stack_diagnosis.pattern_faults import (
    PATTERN_NAMES,
    find_pattern_faults,
    measure_sum_misfit,
)
from reconstruction.stack_diagnosis.polarized_pairs import find_pair_faults
from reconstruction.stack_diagnosis.reduced_stack import reduce_stack

POLARIZER_NAMES = ("parallel", "crossed")
MAX_MISFIT_RATIO = 0.5
"""Ratio of the sums' errors with and without an exchange of polarizers, below which it is right."""


def diagnose_patterns(session: Session) -> DiagnosedImages:
    """Compare the patterns of each strain step with each other, in both polarizations.

    Raises
    ------
    InputsError
        If the session has no neutral strain step, or none that can be judged.
    """
    found = diagnose_states(GradientImages(session), session)
    if not found.names:
        raise InputsError(f"{session.path}: {'; '.join(found.assumed)}")
    return found


def diagnose_states(images: GradientImages, session: Session) -> DiagnosedImages:
    """Return the diagnosis of all strain steps, with images that are already open.

    A step that cannot be judged is left out; `DiagnosedImages.assumed` then states why.
    """
    planned = list_planned_patterns(session)
    groups, skipped = [], []
    for state in images.states:
        try:
            patterns = images.of(state)
        except InputsError as error:
            skipped.append(f"the patterns of {state.name} were not compared: {error}")
            continue
        groups.append(diagnose_state(patterns, planned.get(state.name, ()), name=state.name))
    return replace(collect_images(groups), assumed=tuple(skipped))


def list_planned_patterns(session: Session) -> dict[str, tuple[Key, ...]]:
    """Return the pattern and polarizer of each lit frame that the plan has, by strain step."""
    planned: dict[str, list[Key]] = {}
    omitted = session.omitted_steps()
    for step in session.plan.steps:
        name = strain_state(step)
        if name is not None and step.id not in omitted:
            key = str(step.index["pattern"]), str(step.index["polarizer"])
            planned.setdefault(name, []).append(key)
    return {name: tuple(keys) for name, keys in planned.items()}


def diagnose_state(patterns: StatePatterns, planned: Sequence[Key], *, name: str) -> ImageGroup:
    """Return the faults of one strain step, with its reduced images.

    Images whose polarizers are exchanged are exchanged back before patterns are compared.

    Parameters
    ----------
    patterns
        Images of the strain step.
    planned
        Pattern and polarizer of each image that it should have.
    name
        Of the strain step.
    """
    keys = list(dict.fromkeys([*patterns.values, *(key for key in planned if key[0] != "dark")]))
    has_crossed = any(light == "crossed" for _, light in patterns.values)
    mask = patterns.valid & skin_mask(patterns.crossed()) if has_crossed else patterns.valid
    stack, _ = reduce_stack(list(patterns.values.values()), None, mask)
    images = dict(zip(patterns.values, stack.gray, strict=True))
    shown = [images.get(key, np.zeros(stack.inside.shape)) for key in keys]
    findings = []
    exchanged = _find_exchanged(images, stack.inside)
    if exchanged is not None:
        swapped, one = exchanged
        findings = renumber(
            [one], [keys.index((p, light)) for p in swapped for light in POLARIZER_NAMES]
        )
        images = _exchange(images, swapped)
    for light in POLARIZER_NAMES:
        own = {pattern: image for (pattern, other), image in images.items() if other == light}
        expected = [pattern for pattern, other in keys if other == light]
        found = find_pattern_faults(own, stack.inside, expected=expected) if own else ()
        at = [keys.index(key) if (key := (p, light)) in keys else -1 for p in PATTERN_NAMES]
        # faults of axes name inverse patterns, too, which some series do not have
        there = [replace(one, frames=tuple(k for k in one.frames if at[k] >= 0)) for one in found]
        findings += renumber(there, at)
    return ImageGroup(findings, [f"{name} {light} {pattern}" for pattern, light in keys], shown)


def _find_exchanged(
    images: Mapping[Key, Float64Array], inside: BoolArray
) -> tuple[list[str], Finding] | None:
    """Return the patterns whose polarizers are exchanged, and one finding about all of them.

    Its frames count the parallel and the crossed image of each of these patterns. A pattern that is
    exchanged with another one can look alike, but only the right exchange makes the sums right.
    """
    both = [
        name for name in PATTERN_NAMES if all((name, light) in images for light in POLARIZER_NAMES)
    ]
    found: dict[str, Finding] = {}
    for pattern in both:
        pair = [images[pattern, light] for light in POLARIZER_NAMES]
        for one in find_pair_faults(pair[0], pair[1], inside):
            found[pattern] = one  # gray images can only be exchanged
    if not found:
        return None
    swapped = list(found)
    if 2 * len(swapped) > len(both):  # faint patterns show less
        by_all, by_some = (
            _sum_misfit(_exchange(images, tried), inside, swapped) for tried in (both, swapped)
        )
        swapped = both if by_all <= by_some else swapped
    elif not _repairs_sums(images, inside, swapped):
        swapped = [one for one in swapped if _repairs_sums(images, inside, [one])]
    if not swapped:
        return None
    surest = max(found.values(), key=lambda one: one.ratio_to_limit)
    text = f"{surest.evidence} (patterns {', '.join(swapped)})"
    return swapped, replace(surest, frames=tuple(range(2 * len(swapped))), evidence=text)


def _repairs_sums(
    images: Mapping[Key, Float64Array], inside: BoolArray, patterns: Sequence[str]
) -> bool:
    """Return whether exchanged polarizations of these patterns lower the error of their sums."""
    exchanged = _exchange(images, patterns)
    before, after = (_sum_misfit(one, inside, patterns) for one in (images, exchanged))
    return after <= MAX_MISFIT_RATIO * before


def _exchange(
    images: Mapping[Key, Float64Array], patterns: Sequence[str]
) -> dict[Key, Float64Array]:
    """Return the images with the two polarizations of some patterns exchanged."""
    other = dict(zip(POLARIZER_NAMES, POLARIZER_NAMES[::-1], strict=True))
    return {
        (name, other[light] if name in patterns else light): one
        for (name, light), one in images.items()
    }


def _sum_misfit(
    images: Mapping[Key, Float64Array], inside: BoolArray, patterns: Sequence[str]
) -> float:
    """Return the root mean square error of these patterns' sums in both polarizations."""
    by_light: dict[str, dict[str, Float64Array]] = {light: {} for light in POLARIZER_NAMES}
    for (name, light), one in images.items():
        by_light[light][name] = one
    found = [measure_sum_misfit(own, inside, patterns=patterns) for own in by_light.values()]
    return math.hypot(*found)
