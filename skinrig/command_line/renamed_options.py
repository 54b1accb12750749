"""Former names of options and values: accepted with a notice until `REMOVAL_VERSION`."""

import sys
from collections.abc import Mapping, Sequence
from typing import Any, Final

REMOVAL_VERSION: Final = "0.2"
"""First version that refuses the former names."""

_FACE_EFFECTS: Final = {"--leave-out": "--omit"}
_SIMULATION: Final = {"--size": "--scale"}
_PLAN: Final = {"--want": "--goals", "--valid-share": "--min-valid-fraction"}
_RELIEF: Final = {"--size": "--size-px", "--site": "--relief-site"}

RENAMED_OPTIONS: Final[Mapping[str, Mapping[str, str]]] = {
    "analyse albedo": {"--size": "--size-px"},
    "analyse brdf": {"--basis": "--merl-basis"},
    "apply expression": _RELIEF | {"--onto": "--target-face"},
    "apply microstructure": _RELIEF,
    "bench": {"--toy": "--smoke"},
    "edit": {"--basis": "--merl-basis"},
    "export": {"--onto": "--target-face"},
    "fit traits": {"--size": "--size-px", "--basis": "--merl-basis"},
    "fit wrinkles": {"--size": "--size-px"},
    "plan dome": _PLAN | {"--most-lights": "--max-lights"},
    "plan flash": _PLAN,
    "plan gradient": _PLAN,
    "plan probe": _PLAN,
    "reconstruct": {"--want": "--maps", "--basis": "--merl-basis"},
    "render": {"--size": "--size-px", "--target": "--look-at"},
    "serve dome": _SIMULATION,
    "serve flash": _SIMULATION,
    "serve gradient": _SIMULATION,
    "serve probe": _SIMULATION,
    "simulate dome": _SIMULATION | _FACE_EFFECTS,
    "simulate flash": _SIMULATION | _FACE_EFFECTS | {"--nearer": "--camera-offset-mm"},
    "simulate gradient": _SIMULATION | _FACE_EFFECTS,
    "simulate probe": _SIMULATION,
    "view": {"--size": "--size-px"},
}
"""Present name by former name of an option, by command."""
FORMER_STAGES: Final = {"fibre-readings": "fiber-readings"}
"""Present name of a benchmark's stage by its former name."""


def renamed_options_of(group: str | None, command: str | None) -> Mapping[str, str]:
    """Return the present names of a command's renamed options, by former name.

    Examples
    --------
    >>> renamed_options_of(None, "bench"), renamed_options_of("simulate", "probe")
    ({'--toy': '--smoke'}, {'--size': '--scale'})
    """
    path = " ".join(filter(None, (group, command)))
    return RENAMED_OPTIONS.get(path, {})


def replace_former_names(
    arguments: Sequence[str], renamed: Mapping[str, str], options: Mapping[str, Any]
) -> tuple[list[str], list[str]]:
    """Replace former option names in a command's arguments; values of options stay unchanged.

    Parameters
    ----------
    arguments
        Arguments as typed, ``--name value`` or ``--name=value``.
    renamed
        Present by former names.
    options
        Typer's options by present name; those that are not flags take one value.

    Returns
    -------
    list of str, list of str
        Arguments with present names, and the former names that were given, without repeats.

    Examples
    --------
    >>> replace_former_names(["a", "--toy", "--", "--toy"], {"--toy": "--smoke"}, {})
    (['a', '--smoke', '--', '--toy'], ['--toy'])
    >>> replace_former_names(["--size=64"], {"--size": "--size-px"}, {})
    (['--size-px=64'], ['--size'])
    """
    replaced: list[str] = []
    found: list[str] = []
    is_value = False  # the argument is the value of the option before it
    for position, argument in enumerate(arguments):
        if argument == "--" and not is_value:
            replaced += arguments[position:]
            break
        name, sign, value = argument.partition("=")
        if not is_value and name in renamed:
            found.append(name)
            name = renamed[name]
            argument = name + sign + value
        option = None if is_value or sign else options.get(name)
        is_value = option is not None and not option.is_flag
        replaced.append(argument)
    return replaced, list(dict.fromkeys(found))


def format_notice(former: str, present: str) -> str:
    """Format the notice of a former option name.

    Examples
    --------
    >>> format_notice("--toy", "--smoke")
    'skinrig: --toy is now --smoke; the old name works until version 0.2'
    """
    return f"skinrig: {former} is now {present}; the old name works until version {REMOVAL_VERSION}"


def replace_former_values(values: Sequence[str], renamed: Mapping[str, str]) -> list[str]:
    """Return values by their present names; print a notice on stderr for each former name.

    Examples
    --------
    >>> replace_former_values(["melanin", "image"], {"picture": "image"})
    ['melanin', 'image']
    """
    for former in dict.fromkeys(value for value in values if value in renamed):
        print(format_notice(former, renamed[former]), file=sys.stderr, flush=True)
    return [renamed.get(value, value) for value in values]
