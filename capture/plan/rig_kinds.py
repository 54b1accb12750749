"""Kinds of rigs: the controller that identifies each, and the step that shows the subject.

The folders and modules of a rig bear its kind's name: `capture.acquire.flash` has ``acquire``,
`reconstruction.pipeline.flash.recipe` has ``RECIPE``.
"""

from typing import Final, NamedTuple

from capture.rig import Rig


class RigKind(NamedTuple):
    """Distinguishing features of a kind of rigs and of its sessions."""

    box: str
    """The controller that every rig of the kind has."""
    subject_step: str
    """Kind of the steps whose images show the subject."""


RIG_KINDS: Final = {
    "flash": RigKind("flash", "subject"),
    "dome": RigKind("dome", "olat"),
    "gradient": RigKind("gradient_sphere", "gradient"),
    "probe": RigKind("probe", "fibers"),
}


def find_rig_kind(rig: Rig) -> str:
    """Return the name of a rig's kind: that of its controller, "flash" when it has none of them.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> find_rig_kind(load_rig("gradient"))
    'gradient'
    """
    return next((name for name, kind in RIG_KINDS.items() if kind.box in rig.boxes), "flash")
