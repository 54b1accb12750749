"""What can be wrong with a session."""

from capture.documents import InputError


class SessionError(InputError):
    """A session that cannot be used in the way asked."""


class NotASession(SessionError):
    """A folder that holds no session."""


class SessionDamage(SessionError):
    """A session whose files are not what was written."""


class SessionLocked(SessionError):
    """A session that another process is writing."""


class ConsentError(SessionError):
    """A use of the data that its subject has not agreed to."""


class SessionDiskError(SessionError, OSError):
    """The disk refused an operation; what was acknowledged before is safe."""
