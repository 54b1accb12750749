"""What the shell offers when Tab is pressed: names that an argument or option takes.

Each function takes what is typed so far and returns what it may become. They are called by the
shell's completion alone, so that what they import costs no command anything.
"""

from collections.abc import Iterable

from skinrig.next_steps import CALIBRATION_BY_TARGET, DEFAULT_WANTS


def complete_rig_list(incomplete: str) -> list[str]:
    """Return lists of rigs, joined by commas.

    Examples
    --------
    >>> complete_rig_list("flash,d")
    ['flash,dome']
    """
    return complete_list(CALIBRATION_BY_TARGET, incomplete)


def target_completer(rig: str) -> tuple[str, ...]:
    """Return the calibration targets of a rig.

    Examples
    --------
    >>> target_completer("probe")
    ('phantom', 'dark')
    """
    return tuple(dict.fromkeys((*CALIBRATION_BY_TARGET[rig], "dark")))


def calibrations(incomplete: str) -> list[str]:
    """Return kinds of calibration."""
    kinds = {kind for kinds in CALIBRATION_BY_TARGET.values() for kind in kinds.values()}
    return filter_by_prefix(kinds, incomplete)


def complete_wants(incomplete: str) -> list[str]:
    """Return what is usually wanted of sessions, joined by commas.

    Examples
    --------
    >>> complete_wants("melanin,hemo")
    ['melanin,hemoglobin']
    """
    names = dict.fromkeys(name for text in DEFAULT_WANTS.values() for name in text.split(","))
    return complete_list(names, incomplete)


def subjects(incomplete: str) -> list[str]:
    """Return presets of skin."""
    from rigsim.subject import PRESET_NAMES

    return filter_by_prefix(PRESET_NAMES, incomplete)


def states(incomplete: str) -> list[str]:
    """Return states of a simulated face."""
    from rigsim.subject import STATE_NAMES

    return filter_by_prefix(STATE_NAMES, incomplete)


def conditions(incomplete: str) -> list[str]:
    """Return conditions of a simulated face."""
    from rigsim.population.conditions import CONDITION_NAMES

    return filter_by_prefix(CONDITION_NAMES, incomplete)


def stages(incomplete: str) -> list[str]:
    """Return stages that can be measured."""
    from skinrig.benchmarks.stages import STAGES

    return filter_by_prefix(STAGES, incomplete)


def sizes(incomplete: str) -> list[str]:
    """Return sizes of simulated pictures."""
    return filter_by_prefix(("small", "full"), incomplete)


def filter_by_prefix(names: Iterable[str], incomplete: str) -> list[str]:
    """Return those of some names that begin with what is typed, in their order; sets by name."""
    ordered = sorted(names) if isinstance(names, (set, frozenset)) else names
    return [name for name in ordered if name.startswith(incomplete)]


def complete_list(names: Iterable[str], incomplete: str) -> list[str]:
    """Return the lists that what is typed, joined by commas, may become by one more name."""
    before, comma, last = incomplete.rpartition(",")
    taken = set(before.split(","))
    return [before + comma + name for name in filter_by_prefix(names, last) if name not in taken]
