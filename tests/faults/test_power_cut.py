"""A power cut at any instant: nothing acknowledged is lost, nothing damaged is believed.

The disk is modelled at its worst. Data that was not synced is on the medium not at all, wholly, in
part, as zeros, or with a hole; a name that was not synced in its folder is there or not. Every
prefix of the log of operations is such an instant. Three mutants, each leaving out one kind of
sync, show that the model can tell.
"""

import itertools
import os
import shutil
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from capture import raw
from capture.plan import Plan, Step
from capture.rig import load_rig
from capture.session import Disk, Session, SessionError, SubjectRecord, verify

RIG = load_rig("flash").resized(16)
# what of unsynced data reaches the medium
DATA_FATES = {
    "none": lambda data: b"",
    "all": lambda data: data,
    "one byte": lambda data: data[:1],
    "half": lambda data: data[: len(data) // 2],
    "all but one byte": lambda data: data[:-1],
    "zeros": lambda data: bytes(len(data)),
    "half and zeros": lambda data: data[: len(data) // 2].ljust(len(data), b"\0"),
    "hole": lambda data: bytes(len(data) // 2) + data[len(data) // 2 :],
}


def plan_of(frames):
    return Plan(
        "flash", tuple(Step(f"S{n:03d}", "subject", {}, {}, ("cam",)) for n in range(frames))
    )


SCAN = b"ply: a scan " * 7


def commit(session, step_id):
    values = np.full((10, 16), 600 + int(step_id[1:]), np.uint16)
    words = {"pattern": "RGGB", "black": 512, "white": 16383}
    blob = raw.encode_dng(values, **words, step_id=step_id, session_id=session.id)
    session.commit(step_id, "cam", blob, settings={}, actual={}, t_host_s=0.0)


# --- the log --------------------------------------------------------------------------------------


class LoggedDisk(Disk):
    """The real disk without the wait of its syncs, writing down every operation."""

    left_out = "nothing"

    def __init__(self, root):
        self.root = root
        self.log = []
        self.inodes = itertools.count()
        self.known = {}
        self.open = {}

    def note(self, *operation):
        self.log.append(operation)

    def name(self, path):
        return os.path.relpath(path, self.root)

    def make_dir(self, path):
        super().make_dir(path)
        self.note("mkdir", self.name(path))

    def create(self, path):
        descriptor = super().create(path)
        inode = self.known[os.fstat(descriptor).st_ino] = next(self.inodes)
        self.open[descriptor] = (self.name(path), inode)
        self.note("create", self.name(path), inode)
        return descriptor

    def open_append(self, path):
        descriptor = super().open_append(path)
        self.open[descriptor] = (self.name(path), self.known[os.fstat(descriptor).st_ino])
        return descriptor

    def write(self, descriptor, data):
        super().write(descriptor, data)
        self.note("write", self.open[descriptor][1], bytes(data))

    def truncate(self, descriptor, size):
        super().truncate(descriptor, size)
        self.note("truncate", self.open[descriptor][1], size)

    def sync(self, descriptor):
        name, inode = self.open[descriptor]
        kinds = {".dng.part": "frame", ".ply.part": "attachment"}
        kind = next((k for end, k in kinds.items() if name.endswith(end)), Path(name).name)
        if kind != self.left_out:
            self.note("sync", inode)

    def fsync(self, descriptor):
        self.sync(descriptor)

    def fdatasync(self, descriptor):
        self.sync(descriptor)

    def rename(self, old, new):
        super().rename(old, new)
        self.note("rename", self.name(old), self.name(new))

    def remove(self, path):
        super().remove(path)
        self.note("remove", self.name(path))

    def fsync_dir(self, path):
        if self.name(path) != self.left_out:
            self.note("sync_dir", self.name(path))


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


# --- the medium -----------------------------------------------------------------------------------


@dataclass
class Medium:
    """What is on the medium for certain, and what is still on its way."""

    data: dict = field(default_factory=dict)  # inode -> bytes
    data_coming: dict = field(default_factory=dict)  # inode -> operations
    names: dict = field(default_factory=dict)  # path -> inode, or "folder"
    names_coming: list = field(default_factory=list)  # (folders, names taken away, names given)

    def apply(self, operation):
        kind, *what = operation
        parent = os.path.dirname
        if kind == "create":
            name, inode = what
            self.data[inode], self.data_coming[inode] = b"", []
            self.names_coming.append(({parent(name)}, [], {name: inode}))
        elif kind == "mkdir":
            self.names_coming.append(({parent(what[0])}, [], {what[0]: "folder"}))
        elif kind in ("write", "truncate"):
            self.data_coming[what[0]].append((kind, what[1]))
        elif kind == "sync":
            self.data[what[0]] = self.content(what[0], "all")
            self.data_coming[what[0]] = []
        elif kind == "remove":
            self.names_coming.append(({parent(what[0])}, [what[0]], {}))
        elif kind == "rename":
            old, new = what
            inode = self.tree(len(self.names_coming))[old]
            if parent(old) == parent(new):
                self.names_coming.append(({parent(old)}, [old], {new: inode}))
            else:  # between folders the two names reach the medium separately
                self.names_coming.append(({parent(new)}, [], {new: inode}))
                self.names_coming.append(({parent(old)}, [old], {}))
        elif kind == "sync_dir":
            folder = "" if what[0] == "." else what[0]
            arrived = [change for change in self.names_coming if folder in change[0]]
            self.names_coming = [c for c in self.names_coming if folder not in c[0]]
            for change in arrived:
                self.rename_in(self.names, change)

    @staticmethod
    def rename_in(names, change):
        _, taken, given = change
        for name in taken:
            names.pop(name, None)
        names.update(given)

    def tree(self, arrived):
        """Return the names after the first ``arrived`` of those on their way."""
        names = dict(self.names)
        for change in self.names_coming[:arrived]:
            self.rename_in(names, change)
        return names

    def content(self, inode, fate):
        data = self.data[inode]
        if fate == "none":
            return data
        for kind, what in self.data_coming[inode]:
            data = data[:what] if kind == "truncate" else data + DATA_FATES[fate](what)
        return data

    def images(self):
        """Yield every state the medium may be found in: path -> bytes, None for a folder."""
        for arrived in range(len(self.names_coming) + 1):
            names = self.tree(arrived)
            for fate in DATA_FATES:
                image = {}
                for name in sorted(names):
                    above = os.path.dirname(name)
                    if above in ("", *image):  # a name in a folder that is lost is lost with it
                        inode = names[name]
                        image[name] = None if inode == "folder" else self.content(inode, fate)
                yield image


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


def lay_out(image, root):
    for name, content in image.items():
        if content is None:
            (root / name).mkdir()
        else:
            (root / name).write_bytes(content)


# --- the judgement --------------------------------------------------------------------------------


def judge(path, acknowledged, plan):
    """Return what became of a session after a crash: ok, lost, corrupt or refused."""
    frames = acknowledged - {"created", "closed"}  # and the scan
    try:
        if "created" not in acknowledged and not (path / "session.json").exists():
            create(path, plan, LoggedFrom(path.parent)).release()  # over whatever debris there is
        try:
            session = Session.resume(path, disk=LoggedFrom(path.parent))
        except SessionError as exc:
            if "closed" not in str(exc):
                raise
            session = Session.open(path)
            return outcome(session, frames, plan)
        if "closed" in acknowledged:
            return "lost"
        with session:
            found = outcome(session, frames, plan)
            for step, _ in session.pending_frames():
                commit(session, step.id)
            if not session.attachments():
                session.attach("scan.ply", SCAN)
            session.close()
    except SessionError:
        return "refused"
    return found if found != "ok" else "ok" if verify(path).ok else "corrupt"


def outcome(session, frames, plan):
    records = {record.step_id: record for record in session.frames()}
    if not frames <= set(records) | set(session.attachments()):
        return "lost"
    for name in session.attachments():
        try:
            if session.attachment(name) != SCAN:
                return "corrupt"
        except SessionError:
            return "corrupt"
    for step_id, record in records.items():
        try:
            right = set(np.unique(session.read(record).cfa)) == {600 + int(step_id[1:])}
        except (SessionError, raw.RawError):
            right = False
        if not right:
            return "corrupt"
    return "ok" if session.plan == plan else "corrupt"


class LoggedFrom(LoggedDisk):
    """A logged disk that finds files which it did not make."""

    def open_append(self, path):
        descriptor = Disk.open_append(self, path)
        inode = self.known[os.fstat(descriptor).st_ino] = next(self.inodes)
        self.open[descriptor] = (self.name(path), inode)
        return descriptor


def create(path, plan, disk):
    words = {"devices": {}, "subject": SubjectRecord("P1"), "source": "simulated"}
    return Session.create(path, plan=plan, rig=RIG, session_id="model", disk=disk, **words)


def record(root, disk, plan):
    """Capture a whole session on ``disk``, noting what was acknowledged and when."""
    session = create(root / "s", plan, disk)
    disk.note("acknowledged", "created")
    for number, (step, _) in enumerate(session.pending_frames()):
        commit(session, step.id)
        disk.note("acknowledged", step.id)
        if number == 0:
            session.attach("scan.ply", SCAN)
            disk.note("acknowledged", "scan.ply")
    session.close()
    disk.note("acknowledged", "closed")
    return disk.log


def outcomes(tmp_path, disk_kind, frames):
    (tmp_path / "real").mkdir()
    plan = plan_of(frames)
    log = record(tmp_path / "real", disk_kind(tmp_path / "real"), plan)
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
    counts = outcomes(tmp_path, LoggedDisk, frames)
    print(f"{sum(counts.values())} crash images: {dict(counts)}")
    assert set(counts) == {"ok"}
    assert counts["ok"] > 15 * frames


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
def test_omitted_sync_is_detected(tmp_path, mutant, crime):
    counts = outcomes(tmp_path, mutant, 2)
    print(f"{mutant.__name__}: {dict(counts)}")
    assert crime & set(counts)


def test_second_power_cut_while_resuming_keeps_acknowledged_data(tmp_path):
    """Cut the power at every instant of a capture, and again at every instant of the recovery."""
    plan = plan_of(2)
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


class Inheriting(LoggedDisk):
    """A logged disk that begins with an image, all of it on the medium."""

    def __init__(self, root, image):
        super().__init__(root)
        for name in sorted(image):
            if image[name] is None:
                self.note("mkdir", name)
            else:
                inode = self.known[(root / name).stat().st_ino] = next(self.inodes)
                self.note("create", name, inode)
                self.note("write", inode, image[name])
                self.note("sync", inode)
        for folder in [".", *(n for n in image if image[n] is None)]:
            self.note("sync_dir", folder)
        # the instants before the image was whole are no instants of this story
        self.log = [("whole", tuple(self.log))]
