"""Shell completion of arguments and options.

Each function takes the incomplete word and returns its completions. Only the shell's completion
calls them, so their imports do not slow down any command.
"""

from collections.abc import Iterable
from contextlib import suppress

import typer

from skinrig.next_steps import CALIBRATION_BY_TARGET, DEFAULT_WANTS


def complete_rig_list(incomplete: str) -> list[str]:
    """Complete a list of rigs, separated by commas.

    Examples
    --------
    >>> complete_rig_list("flash,d")
    ['flash,dome']
    """
    return complete_list(CALIBRATION_BY_TARGET, incomplete)


def list_targets(rig: str) -> tuple[str, ...]:
    """Return the calibration targets of a rig.

    Examples
    --------
    >>> list_targets("probe")
    ('phantom', 'dark')
    """
    return tuple(dict.fromkeys((*CALIBRATION_BY_TARGET[rig], "dark")))


def complete_calibrations(incomplete: str) -> list[str]:
    """Complete a kind of calibration."""
    kinds = {kind for kinds in CALIBRATION_BY_TARGET.values() for kind in kinds.values()}
    return filter_by_prefix(kinds, incomplete)


def complete_wants(context: typer.Context, incomplete: str) -> list[str]:
    """Complete a list of maps: those of the given session's rig, else those of any rig."""
    names: Iterable[str] = ()
    given = context.params.get("sessions") or ()
    with suppress(Exception):  # completion offers names of any rig for a damaged session
        from reconstruction.pipeline.recipes import list_maps

        names = list_maps(given[0]) if given else ()
    return complete_list(names or list_usual_maps(), incomplete)


def list_usual_maps() -> list[str]:
    """Return the maps that sessions of any rig are usually reconstructed to.

    Examples
    --------
    >>> list_usual_maps()[:2]
    ['melanin', 'hemoglobin']
    """
    return list(dict.fromkeys(name for text in DEFAULT_WANTS.values() for name in text.split(",")))


def complete_subjects(incomplete: str) -> list[str]:
    """Complete a skin preset."""
    from rigsim.subject import PRESET_NAMES

    return filter_by_prefix(PRESET_NAMES, incomplete)


def complete_states(incomplete: str) -> list[str]:
    """Complete an expression or condition of a simulated face (flash and dome rigs)."""
    from rigsim.subject import STATE_NAMES

    return filter_by_prefix(STATE_NAMES, incomplete)


def complete_conditions(incomplete: str) -> list[str]:
    """Complete a surface condition of a simulated face (dome)."""
    from rigsim.population.conditions import CONDITION_NAMES

    return filter_by_prefix(CONDITION_NAMES, incomplete)


def complete_stages(incomplete: str) -> list[str]:
    """Complete a benchmark stage."""
    from skinrig.benchmarks.stages import STAGES

    return filter_by_prefix(STAGES, incomplete)


def filter_by_prefix(names: Iterable[str], incomplete: str) -> list[str]:
    """Return the names that begin with the incomplete word, in their order; sets sorted."""
    ordered = sorted(names) if isinstance(names, (set, frozenset)) else names
    return [name for name in ordered if name.startswith(incomplete)]


def complete_list(names: Iterable[str], incomplete: str) -> list[str]:
    """Return the completions of the last name of a list separated by commas, without repeats."""
    before, comma, last = incomplete.rpartition(",")
    taken = set(before.split(","))
    return [before + comma + name for name in filter_by_prefix(names, last) if name not in taken]
