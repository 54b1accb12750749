"""Check whether a simulated session can be resumed, and count the shots that it has made."""

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

from capture.session import Session, SubjectRecord
from skinrig.simulating.orders import SimulationResult


class SessionComplete(Exception):
    """Raised when a resumed simulation lacks neither frames nor ground truth.

    Attributes
    ----------
    result : SimulationResult
        Result of the simulation.
    """

    def __init__(self, result: SimulationResult) -> None:
        super().__init__(result)
        self.result = result


_MAX_SHOWN_CHARACTERS = 60
"""Maximum number of characters of a value in a message."""


def describe_differences(
    recorded: Mapping[str, Any], requested: Mapping[str, Any], *, of: str = ""
) -> tuple[str, ...]:
    """Describe the differences between two settings, one line each.

    Parameters
    ----------
    recorded, requested
        JSON values by name, of a session's manifest and of an order. A changed file, a record with
        ``file`` and ``sha256``, is reported by its name if that is the same.
    of
        Name of the parent setting, for nested settings.

    Examples
    --------
    >>> describe_differences({"width_px": 64, "mesh": ""}, {"width_px": 96, "mesh": "",
    ...     "nearer_mm": 5.0})
    ('width_px: recorded with 64, got 96', 'nearer_mm: recorded without, got 5.0')
    >>> describe_differences({"map": {"file": "m.npy", "sha256": "a"}},
    ...             {"map": {"file": "m.npy", "sha256": "b"}}, of="subject")
    ('subject map: the file m.npy has changed since',)
    """
    lines: list[str] = []
    for key in dict.fromkeys((*recorded, *requested)):
        name = f"{of} {key}" if of else key
        was, now = recorded.get(key), requested.get(key)
        if was == now and (key in recorded) == (key in requested):
            continue
        if isinstance(was, Mapping) and isinstance(now, Mapping) and key != "plan":
            if "sha256" in was and was.get("file") == now.get("file"):
                lines.append(f"{name}: the file {was['file']} has changed since")
            else:
                file = was.get("file")
                same = file is not None and file == now.get("file")
                lines += describe_differences(was, now, of=f"{name} {file}" if same else name)
        elif key == "plan" and was and now:
            lines.append(f"{name}: recorded with {_shorten_value(was)}, got another")
        else:
            old = f"with {_shorten_value(was)}" if key in recorded else "without"
            new = _shorten_value(now) if key in requested else "none"
            lines.append(f"{name}: recorded {old}, got {new}")
    return tuple(lines)


def list_refusals(
    session: Session, requested: Mapping[str, Any], seed: int, person: SubjectRecord | None
) -> tuple[str, ...]:
    """List the reasons why a session cannot be resumed as requested, one line each.

    Parameters
    ----------
    session
        Session to resume; one that is not of a simulation is a reason, too.
    requested
        Settings of the simulation.
    seed
        Seed of subject, sensor and controllers.
    person
        Pseudonym and consent; None: those of the session.
    """
    recorded = session.manifest.extra.get("simulation")
    if not isinstance(recorded, Mapping):
        return ("it was not created by a simulation",)
    lines = list(
        describe_differences({**recorded, "seed": session.seed}, {**requested, "seed": seed})
    )
    if person is not None:
        lines += describe_differences(
            _consent_record(session.manifest.subject), _consent_record(person)
        )
    return tuple(lines)


def count_shots(session: Session) -> Mapping[str, int]:
    """Count the shots that each camera has made for a session, as far as they were recorded.

    The number of the shot seeds the noise of a simulated frame. A new world that resumes a session
    must not restart at 0: later frames would repeat the noise of earlier ones, and the noise of
    their averages would exceed its stated standard error.

    Parameters
    ----------
    session
        Session before it is resumed.

    Returns
    -------
    mapping
        Shots by name of the view; 0 for a view without any.

    Notes
    -----
    A step counts once per attempt that all its cameras recorded, and once per failed attempt. Steps
    that an interruption left incomplete are shot again by all their cameras with the old number. A
    resumed session then has the same pixels as an uninterrupted one, if the same shots are made.
    With a caliper they are not, because skin is taped and imaged again: images of newly taped skin
    and omitted steps are counted too, so that no number occurs twice.
    """
    counts: defaultdict[str, int] = defaultdict(int)
    attempts: defaultdict[str, dict[str, int]] = defaultdict(dict)
    tries: defaultdict[str, int] = defaultdict(int)
    for record in session.frames():
        attempts[record.step_id][record.camera] = record.attempt
        tries[record.step_id] = max(tries[record.step_id], int(record.actual.get("tries", 1)))
    skin_left_out = session.omitted_steps() if session.rig.caliper is not None else {}
    for step in session.plan.steps:
        kept = min(attempts[step.id].get(name, 0) for name in step.cameras)
        shots = kept + max(tries[step.id] - 1, 0) if kept else 0
        for name in step.cameras:
            counts[name] += shots + (step.id in skin_left_out)
    for name in session.attachments():
        camera = session.attachment_line(name).about.get("camera")
        if camera is not None:
            counts[str(camera)] += 1
    return counts


def _consent_record(person: SubjectRecord) -> dict[str, Any]:
    """Return pseudonym and consent for a comparison; uses are sorted, as their order is free."""
    day = person.consent_expires
    return {
        "pseudonym": person.pseudonym,
        "consent": ", ".join(sorted(person.consent_scope)) or "nothing",
        "consent_expires": "no end" if day is None else day.isoformat(),
    }


def _shorten_value(value: Any) -> str:
    """Format a value for a message: files by name, lists by their members, long texts cut."""
    if isinstance(value, Mapping) and "file" in value:
        return str(value["file"])
    if isinstance(value, Mapping) and "steps" in value:
        return f"a plan of {len(value['steps'])} steps"
    if isinstance(value, list | tuple) and all(isinstance(one, str) for one in value):
        text = ", ".join(value) or "none"
    else:
        text = value if isinstance(value, str) and value else repr(value)
    return text if len(text) <= _MAX_SHOWN_CHARACTERS else text[: _MAX_SHOWN_CHARACTERS - 3] + "..."
