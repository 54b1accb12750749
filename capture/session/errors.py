"""Exceptions of sessions."""

from capture.documents import InputError


class SessionError(InputError):
    """Raised when a session cannot be used in the requested way."""


class NotASession(SessionError):
    """Raised for a folder that is not a session."""


class SessionDamage(SessionError):
    """Raised for a session whose files differ from what was written."""


class SessionLocked(SessionError):
    """Raised for a session that another process is writing."""


class ConsentError(SessionError):
    """Raised for a use of the data that its subject has not agreed to."""


class SessionDiskError(SessionError, OSError):
    """Raised when the disk refused an operation; what was acknowledged before is safe."""
