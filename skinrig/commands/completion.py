"""What the shell offers when Tab is pressed: names that an argument or option takes.

Each function takes what is typed so far and returns what it may become. They are called by the
shell's completion alone, so that what they import costs no command anything.
"""

from collections.abc import Iterable

from skinrig.next_steps import CALIBRATION_BY_TARGET, DEFAULT_WANTS


def several_rigs(incomplete: str) -> list[str]:
    """Return lists of rigs, joined by commas.

    Examples
    --------
    >>> several_rigs("flash,d")
    ['flash,dome']
    """
    return after_comma(CALIBRATION_BY_TARGET, incomplete)


def targets_of(rig: str) -> tuple[str, ...]:
    """Return the calibration targets of a rig.

    Examples
    --------
    >>> targets_of("probe")
    ('phantom', 'dark')
    """
    return tuple(dict.fromkeys((*CALIBRATION_BY_TARGET[rig], "dark")))


def calibrations(incomplete: str) -> list[str]:
    """Return kinds of calibration."""
    kinds = {kind for kinds in CALIBRATION_BY_TARGET.values() for kind in kinds.values()}
    return beginning(kinds, incomplete)


def wants(incomplete: str) -> list[str]:
    """Return what is usually wanted of sessions, joined by commas.

    Examples
    --------
    >>> wants("melanin,hemo")
    ['melanin,hemoglobin']
    """
    names = dict.fromkeys(name for text in DEFAULT_WANTS.values() for name in text.split(","))
    return after_comma(names, incomplete)


def subjects(incomplete: str) -> list[str]:
    """Return presets of skin."""
    from rigsim.subject import PRESET_NAMES

    return beginning(PRESET_NAMES, incomplete)


def states(incomplete: str) -> list[str]:
    """Return states of a simulated face."""
    from rigsim.subject import STATE_NAMES

    return beginning(STATE_NAMES, incomplete)


def conditions(incomplete: str) -> list[str]:
    """Return conditions of a simulated face."""
    from rigsim.population.conditions import CONDITION_NAMES

    return beginning(CONDITION_NAMES, incomplete)


def stages(incomplete: str) -> list[str]:
    """Return stages that can be measured."""
    from skinrig.benchmarks.stages import STAGES

    return beginning(STAGES, incomplete)


def sizes(incomplete: str) -> list[str]:
    """Return sizes of simulated pictures."""
    return beginning(("small", "full"), incomplete)


def beginning(names: Iterable[str], incomplete: str) -> list[str]:
    """Return those of some names that begin with what is typed, in their order; sets by name."""
    ordered = sorted(names) if isinstance(names, (set, frozenset)) else names
    return [name for name in ordered if name.startswith(incomplete)]


def after_comma(names: Iterable[str], incomplete: str) -> list[str]:
    """Return the lists that what is typed, joined by commas, may become by one more name."""
    before, comma, last = incomplete.rpartition(",")
    taken = set(before.split(","))
    return [before + comma + name for name in beginning(names, last) if name not in taken]
