"""SESSION/ format: atomically written frames, a hash-chained journal, resume and verify."""

from capture.session.disk import Disk
from capture.session.errors import (
    ConsentError,
    NotASession,
    SessionDamage,
    SessionDiskError,
    SessionError,
    SessionLocked,
)
from capture.session.journal import AttachmentLine, FrameLine, NewFrame
from capture.session.manifest import SCHEMA, CalibrationRef, Manifest, SubjectRecord
from capture.session.reopening import reopen_copy, resume_unless_complete
from capture.session.store import Session
from capture.session.verification import VerifyReport, verify
from capture.session.view import FrameRecord

__all__ = [
    "SCHEMA",
    "AttachmentLine",
    "CalibrationRef",
    "ConsentError",
    "Disk",
    "FrameLine",
    "FrameRecord",
    "Manifest",
    "NewFrame",
    "NotASession",
    "Session",
    "SessionDamage",
    "SessionDiskError",
    "SessionError",
    "SessionLocked",
    "SubjectRecord",
    "VerifyReport",
    "reopen_copy",
    "resume_unless_complete",
    "verify",
]
