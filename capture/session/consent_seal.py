"""consent.seal: a code of session.json by a key of the lab, so that others cannot widen a consent.

A person who edits session.json can recompute its seal and the journal's chain, but not HMAC-SHA256
without the key. The variable SKINRIG_CONSENT_KEY names the file of the key. Where it is set, new
sessions are sealed, and sessions without a right seal are refused.
"""

import hmac
import os
import shlex
import stat
from pathlib import Path

from capture.documents import Fault
from capture.session.disk import read_file
from capture.session.errors import SessionDamage, SessionError

KEY_VARIABLE = "SKINRIG_CONSENT_KEY"
SEAL_FILE = "consent.seal"
UNSEALED_STATE = "unsealed"
UNCHECKED_STATE = f"sealed, not checked without {KEY_VARIABLE}"
SEALED_STATE = "sealed with the key"
REFUSED_STATE = "seal refused"
MIN_KEY_BYTES, MAX_KEY_BYTES = 32, 4096
MAX_SEAL_BYTES = 256
_PURPOSE = b"skinrig.consent-seal/1\n"


def read_key() -> bytes | None:
    """Return the lab's key; None when the variable names no file.

    Raises
    ------
    SessionError
        When the file cannot be read, is short, or is not its owner's alone.
    """
    name = os.environ.get(KEY_VARIABLE, "")
    if not name:
        return None
    path = Path(name)

    def key_error(got: str, expected: str, advice: str) -> SessionError:
        faults = [Fault(KEY_VARIABLE, got, expected)]
        return SessionError(
            "is not a key", where=name, faults=faults, advice=advice, code="SR-SES-015"
        )

    quoted = shlex.quote(name)
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
        key = path.read_bytes() if path.is_file() else b""
    except FileNotFoundError as error:
        make = f"Make one: (umask 077; head -c 32 /dev/urandom > {quoted})"
        raise key_error(str(error.strerror), "a file", make) from error
    except OSError as error:
        advice = "Log in as the owner of the key, or correct the permissions of file and folder."
        raise key_error(str(error.strerror), "a readable file", advice) from error
    if not MIN_KEY_BYTES <= len(key) <= MAX_KEY_BYTES:
        sizes = f"a file of {MIN_KEY_BYTES} to {MAX_KEY_BYTES} bytes"
        got = f"{len(key)} bytes" if path.is_file() else "not a plain file"
        raise key_error(got, sizes, f"Set {KEY_VARIABLE} to the file of the lab's key.")
    if mode & 0o077:
        raise key_error(f"mode {mode:o}", "mode 600", f"Run: chmod 600 {quoted}")
    return key


def make_seal(manifest: bytes, key: bytes) -> bytes:
    """Return the content of consent.seal for the bytes of a session.json.

    Examples
    --------
    >>> len(make_seal(b"{}", bytes(32)))
    65
    """
    return hmac.digest(key, _PURPOSE + manifest, "sha256").hex().encode("ascii") + b"\n"


def check_seal(folder: Path, manifest: bytes) -> str:
    """Return the state of a session's seal: `UNSEALED_STATE`, `UNCHECKED_STATE` or `SEALED_STATE`.

    Raises
    ------
    SessionError
        With a key: when the session is not sealed. With or without: see `read_key`.
    SessionDamage
        With a key: when the seal is not that of these bytes.
    """
    key, path = read_key(), folder / SEAL_FILE
    if not os.path.lexists(path):
        if key is None:
            return UNSEALED_STATE
        raise SessionError(
            "has no consent seal",
            where=str(folder),
            faults=[Fault(SEAL_FILE, "no file", f"a seal with the key of {KEY_VARIABLE}")],
            advice="Compare its consent with the signed form, then: "
            f"skinrig session seal {shlex.quote(str(folder))}",
            code="SR-SES-016",
        )
    if key is None:
        return UNCHECKED_STATE
    found = read_file(path, limit=MAX_SEAL_BYTES, label="consent seal")
    if hmac.compare_digest(found, make_seal(manifest, key)):
        return SEALED_STATE
    raise SessionDamage(
        "differs from the sealed session.json",
        where=str(folder / "session.json"),
        faults=[Fault(SEAL_FILE, "another code", f"that of session.json by {KEY_VARIABLE}")],
        advice="Restore session.json from a copy; or another key has sealed it: use that one.",
        code="SR-SES-017",
    )
