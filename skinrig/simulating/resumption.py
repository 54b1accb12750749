"""Whether and from where a simulated session may be gone on with: settings and shot numbers."""

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

from capture.session import Session, SubjectRecord

_MAX_SHOWN_CHARACTERS = 60
"""Characters of a value that are shown; of a plan nobody reads more."""


def describe_differences(
    recorded: Mapping[str, Any], requested: Mapping[str, Any], *, of: str = ""
) -> tuple[str, ...]:
    """Return what of two settings differs, a line each.

    Parameters
    ----------
    begun, asked
        JSON values by name, as a session's manifest and an order hold them. A record of a file,
        with its ``file`` and ``sha256``, is told by its name where that stayed.
    of
        What they are settings of, where they lie inside another.

    Examples
    --------
    >>> describe_differences({"width_px": 64, "mesh": ""}, {"width_px": 96, "mesh": "",
    ...     "nearer_mm": 5.0})
    ('width_px: begun with 64, got 96', 'nearer_mm: begun without, got 5.0')
    >>> describe_differences({"map": {"file": "m.npy", "sha256": "a"}},
    ...             {"map": {"file": "m.npy", "sha256": "b"}}, of="subject")
    ('subject map: the file m.npy was changed since',)
    """
    lines: list[str] = []
    for key in dict.fromkeys((*recorded, *requested)):
        name = f"{of} {key}" if of else key
        was, now = recorded.get(key), requested.get(key)
        if was == now and (key in recorded) == (key in requested):
            continue
        if isinstance(was, Mapping) and isinstance(now, Mapping) and key != "plan":
            if "sha256" in was and was.get("file") == now.get("file"):
                lines.append(f"{name}: the file {was['file']} was changed since")
            else:
                file = was.get("file")
                same = file is not None and file == now.get("file")
                lines += describe_differences(was, now, of=f"{name} {file}" if same else name)
        elif key == "plan" and was and now:
            lines.append(f"{name}: begun with {_shorten_value(was)}, got another")
        else:
            old = f"with {_shorten_value(was)}" if key in recorded else "without"
            new = _shorten_value(now) if key in requested else "none"
            lines.append(f"{name}: begun {old}, got {new}")
    return tuple(lines)


def list_refusals(
    session: Session, requested: Mapping[str, Any], seed: int, person: SubjectRecord | None
) -> tuple[str, ...]:
    """Return why a session cannot be gone on with as asked, a line each; empty where it can.

    Parameters
    ----------
    session
        Begun by a simulation, or by something else, which is told too.
    asked
        Settings of the simulation.
    seed
        Of subject, sensor and boxes.
    person
        Pseudonym and consent; None: nothing is said of them, and those of the session stay.
    """
    begun = session.manifest.extra.get("simulation")
    if not isinstance(begun, Mapping):
        return ("it was not begun by a simulation",)
    lines = list(describe_differences({**begun, "seed": session.seed}, {**requested, "seed": seed}))
    if person is not None:
        lines += describe_differences(
            _consent_record(session.manifest.subject), _consent_record(person)
        )
    return tuple(lines)


def count_shots(session: Session) -> Mapping[str, int]:
    """Return how many shots each camera has made for a session, as far as anything came of them.

    The noise of a simulated frame is seeded by the number of the shot. A world that is made anew
    for the rest of a session must not begin at 0 again: later frames would bear the noise of
    earlier ones, and averages over them would be noisier than their errors say.

    Parameters
    ----------
    session
        As it is before more is captured.

    Returns
    -------
    mapping
        Shots by name of the view; 0 of one that has made none.

    Notes
    -----
    A step counts as often as all its cameras kept it, and once more for each try that failed: a
    step that a kill left with some of its cameras is shot again with all, under the number that it
    had. So a session that was interrupted holds the pixels of one that was not, where the same
    shots are made. A caliper's are not: skin is taped and pictured anew. There more is counted
    (pictures of newly taped skin, steps that were left out later), so that no number comes twice.
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
    """Return whom a session is of; uses sorted, since their order says nothing."""
    day = person.consent_expires
    return {
        "pseudonym": person.pseudonym,
        "consent": ", ".join(sorted(person.consent_scope)) or "nothing",
        "consent_expires": "no end" if day is None else day.isoformat(),
    }


def _shorten_value(value: Any) -> str:
    """Return a value as people read it: of files their name, of lists their members."""
    if isinstance(value, Mapping) and "file" in value:
        return str(value["file"])
    if isinstance(value, Mapping) and "steps" in value:
        return f"a plan of {len(value['steps'])} steps"
    if isinstance(value, list | tuple) and all(isinstance(one, str) for one in value):
        text = ", ".join(value) or "none"
    else:
        text = value if isinstance(value, str) and value else repr(value)
    return text if len(text) <= _MAX_SHOWN_CHARACTERS else text[: _MAX_SHOWN_CHARACTERS - 3] + "..."
