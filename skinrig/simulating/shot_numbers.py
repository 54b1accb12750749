"""Where the cameras of a resumed simulation go on counting their shots.

The noise of a simulated frame is seeded by the number of the shot. A world that is made anew for
the rest of a session must not begin at 0 again: later frames would bear the noise of earlier ones,
and averages over them would be noisier than their errors say.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping

from capture.session import Session


def shots_made(session: Session) -> Mapping[str, int]:
    """Return how many shots each camera has made for a session, as far as anything came of them.

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
    skin_left_out = session.left_out() if session.rig.caliper is not None else {}
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
