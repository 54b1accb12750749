"""A power cut at any instant: nothing acknowledged is lost, nothing damaged is believed.

The disk is modelled at its worst. Data that was not synced is on the medium not at all, wholly, in
part, as zeros, or with a hole; a name that was not synced in its folder is there or not. Every
prefix of the log of operations is such an instant. Three mutants, each leaving out one kind of
sync, show that the model can tell.
"""

import shutil
from collections import Counter

import numpy as np
import pytest
from fixtures.small_sessions import CAMERAS, DOME, commit_step, fill_of, plan_of

from capture import raw
from capture.session import Session, SessionError, SubjectRecord, verify
from skinrig.soaking.storage import LoggedDisk, Medium, lay_out

SCAN = b"ply: a scan " * 7


# --- the log --------------------------------------------------------------------------------------


class NoFrameSync(LoggedDisk):
    left_out = "frame"


class NoFolderSync(LoggedDisk):
    left_out = "s/frames"


class NoAttachmentSync(LoggedDisk):
    left_out = "attachment"


class NoAttachmentFolderSync(LoggedDisk):
    left_out = "s/attachments"


class NoJournalSync(LoggedDisk):
    left_out = "journal.jsonl"


def write_at_once(log):
    """Return the log as threads may make it: files of a step are created, written, then synced."""
    order = ("create", "write", "sync")
    step, found = [], []
    for operation in [*log, ("end",)]:
        if operation[0] in order:
            step.append(operation)
            continue
        found += [one for kind in order for one in step if one[0] == kind]
        found.append(operation)
        step = []
    return found[:-1]


# --- the medium -----------------------------------------------------------------------------------


def crash_images(log):
    """Yield (image, what was acknowledged before) for every instant of the log, each once."""
    medium, acknowledged, seen = Medium(), frozenset(), set()
    for operation in log:
        if operation[0] == "acknowledged":
            acknowledged |= {operation[1]}
        elif operation[0] == "whole":
            for earlier in operation[1]:
                medium.apply(earlier)
        else:
            medium.apply(operation)
        for image in medium.images():
            key = (tuple(sorted(image.items(), key=lambda kv: kv[0])), acknowledged)
            if key not in seen:
                seen.add(key)
                yield image, acknowledged


# --- the judgement --------------------------------------------------------------------------------


def judge(path, acknowledged, plan):
    """Return what became of a session after a crash: ok, lost, corrupt or refused."""
    frames = acknowledged - {"created", "closed"}  # and the scan
    try:
        if "created" not in acknowledged and not (path / "session.json").exists():
            create(path, plan, LoggedDisk(path.parent)).release()  # over whatever debris there is
        try:
            session = Session.resume(path, disk=LoggedDisk(path.parent))
        except SessionError as exc:
            if "closed" not in str(exc):
                raise
            session = Session.open(path)
            return outcome(session, frames, plan)
        if "closed" in acknowledged:
            return "lost"
        with session:
            found = outcome(session, frames, plan)
            for step_id in dict.fromkeys(step.id for step, _ in session.pending_frames()):
                commit_step(session, step_id)
            if not session.attachments():
                session.attach("scan.ply", SCAN)
            session.close()
    except SessionError:
        return "refused"
    return found if found != "ok" else "ok" if verify(path).ok else "corrupt"


def outcome(session, frames, plan):
    records = {(record.step_id, record.camera): record for record in session.frames()}
    whole = {
        step.id for step in plan.steps if all((step.id, name) in records for name in step.cameras)
    }
    if not frames <= whole | set(session.attachments()):
        return "lost"
    for name in session.attachments():
        try:
            if session.attachment(name) != SCAN:
                return "corrupt"
        except SessionError:
            return "corrupt"
    for place, record in records.items():
        try:
            right = set(np.unique(session.read(record).cfa)) == {fill_of(*place)}
        except (SessionError, raw.RawError):
            right = False
        if not right:
            return "corrupt"
    return "ok" if session.plan == plan else "corrupt"


def create(path, plan, disk):
    words = {"devices": {}, "subject": SubjectRecord("P1"), "source": "simulated"}
    return Session.create(path, plan=plan, rig=DOME, session_id="model", disk=disk, **words)


def record(root, disk, plan):
    """Capture a whole session on ``disk``, noting what was acknowledged and when."""
    session = create(root / "s", plan, disk)
    disk.note("acknowledged", "created")
    for number, step in enumerate(plan.steps):
        commit_step(session, step.id)
        disk.note("acknowledged", step.id)
        if number == 0:
            session.attach("scan.ply", SCAN)
            disk.note("acknowledged", "scan.ply")
    session.close()
    disk.note("acknowledged", "closed")
    return disk.log


def outcomes(tmp_path, disk_kind, plan, reorder=list):
    (tmp_path / "real").mkdir()
    log = reorder(record(tmp_path / "real", disk_kind(tmp_path / "real"), plan))
    counts = Counter()
    for number, (image, acknowledged) in enumerate(crash_images(log)):
        root = tmp_path / f"{number}"
        root.mkdir()
        lay_out(image, root)
        counts[judge(root / "s", acknowledged, plan)] += 1
        shutil.rmtree(root)
    return counts


@pytest.mark.parametrize("frames", [3, pytest.param(25, marks=pytest.mark.long, id="25 frames")])
def test_power_cut_at_any_instant_keeps_acknowledged_data(tmp_path, frames):
    counts = outcomes(tmp_path, LoggedDisk, plan_of(frames, 1))
    print(f"{sum(counts.values())} crash images: {dict(counts)}")
    assert set(counts) == {"ok"}
    assert counts["ok"] > 15 * frames


@pytest.mark.parametrize("steps", [1, pytest.param(4, marks=pytest.mark.long, id="4 steps")])
@pytest.mark.parametrize("reorder", [list, write_at_once])
def test_power_cut_in_step_of_several_cameras(tmp_path, steps, reorder):
    plan = plan_of(steps, len(CAMERAS))
    counts = outcomes(tmp_path, LoggedDisk, plan, reorder)
    print(f"{sum(counts.values())} crash images: {dict(counts)}")
    assert set(counts) == {"ok"}
    assert counts["ok"] > 10 * steps * len(CAMERAS)


@pytest.mark.long
@pytest.mark.parametrize("cameras", [1, len(CAMERAS)])
@pytest.mark.parametrize(
    ("mutant", "crime"),
    [
        (NoFrameSync, {"refused", "corrupt"}),
        (NoFolderSync, {"refused", "lost"}),
        (NoAttachmentSync, {"refused", "corrupt"}),
        (NoAttachmentFolderSync, {"refused", "lost"}),
        (NoJournalSync, {"refused", "lost"}),
    ],
)
def test_omitted_sync_is_detected(tmp_path, mutant, crime, cameras):
    counts = outcomes(tmp_path, mutant, plan_of(2, cameras))
    print(f"{mutant.__name__}: {dict(counts)}")
    assert crime & set(counts)


def test_second_power_cut_while_resuming_keeps_acknowledged_data(tmp_path):
    """Cut the power at every instant of a capture, and again at every instant of the recovery."""
    plan = plan_of(2, 1)
    (tmp_path / "real").mkdir()
    log = record(tmp_path / "real", LoggedDisk(tmp_path / "real"), plan)
    counts = Counter()
    first_cuts = [(i, a) for i, a in crash_images(log) if "created" in a and "closed" not in a]
    for number, (image, acknowledged) in enumerate(first_cuts):
        root = tmp_path / f"{number}"
        root.mkdir()
        lay_out(image, root)
        disk = Inheriting(root, image)
        if Session.open(root / "s").closed:
            continue
        Session.resume(root / "s", disk=disk).release()
        for again, (second, _) in enumerate(crash_images(disk.log)):
            place = tmp_path / f"{number}-{again}"
            place.mkdir()
            lay_out(second, place)
            counts[judge(place / "s", acknowledged, plan)] += 1
            shutil.rmtree(place)
    print(f"{sum(counts.values())} images of two cuts: {dict(counts)}")
    assert set(counts) == {"ok"}


def test_resuming_confirms_line_of_interrupted_process(tmp_path):
    """A process ended between its last line and that line's synchronization; another continues."""
    plan, root = plan_of(2, 1), tmp_path / "real"
    root.mkdir()
    disk = LoggedDisk(root)
    session = create(root / "s", plan, disk)
    disk.note("acknowledged", "created")
    disk.left_out = "journal.jsonl"
    commit_step(session, "S000")
    session.release()
    disk.left_out = LoggedDisk.left_out
    with Session.resume(root / "s", disk=disk) as resumed:
        commit_step(resumed, "S001")
        disk.note("acknowledged", "S001")
    counts = Counter()
    for number, (image, acknowledged) in enumerate(crash_images(disk.log)):
        place = tmp_path / f"{number}"
        place.mkdir()
        lay_out(image, place)
        counts[judge(place / "s", acknowledged, plan)] += 1
    assert set(counts) == {"ok"}


class Inheriting(LoggedDisk):
    """A logged disk that begins with an image, all of it on the medium."""

    def __init__(self, root, image):
        super().__init__(root)
        self.adopt(image)
        # the instants before the image was whole are no instants of this story
        self.log = [("whole", tuple(self.log))]
