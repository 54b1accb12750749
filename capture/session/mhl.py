"""ASC MHL: write the manifest by which film archives verify folders after a transfer.

A folder gets ``ascmhl/`` with its first generation: every file's size, date and XXH128, and a chain
file with the manifest's own C4 ID. Tools that know the format verify the folder and add theirs.

References
----------
ASC Media Hash List 2.0, American Society of Cinematographers, schemas urn:ASC:MHL:v2.0 and
urn:ASC:MHL:DIRECTORY:v2.0; C4 ID: SMPTE ST 2114:2017, doi 10.5594/SMPTE.ST2114.2017.
"""

import hashlib
import re
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from xml.etree import ElementTree

import xxhash

from capture.documents import Fault
from capture.session.errors import SessionError

MHL_FOLDER, CHAIN_FILE = "ascmhl", "ascmhl_chain.xml"
_LIST_NAMESPACE, _DIRECTORY_NAMESPACE = "urn:ASC:MHL:v2.0", "urn:ASC:MHL:DIRECTORY:v2.0"
_BASE58_ALPHABET = "123456789ABCDEFGHJKLMNPQRSTUVWXYZabcdefghijkmnopqrstuvwxyz"
_WITHHELD_HOST = "withheld"
"""Replaces the host's name, which the schema requires and which stays private."""


def c4_id(data: bytes) -> str:
    """Return the C4 ID of bytes: SHA-512 in base 58, 90 characters.

    Examples
    --------
    >>> c4_id(b"")[:24]
    'c459dsjfscH38cYeXXYogktx'
    """
    rest = int.from_bytes(hashlib.sha512(data).digest(), "big")
    digits = []
    while rest:
        rest, digit = divmod(rest, 58)
        digits.append(_BASE58_ALPHABET[digit])
    return "c4" + "".join(reversed(digits)).rjust(88, _BASE58_ALPHABET[0])


def write_first_generation(folder: str | Path, *, now: datetime, version: str) -> Path:
    """Write ``ascmhl/`` into a folder that has none, and return the manifest's path.

    Parameters
    ----------
    folder : str or Path
        All files in it are listed; symbolic links are refused.
    now : datetime
        Time of writing, with its zone.
    version : str
        Version of the program that transfers the folder.

    Raises
    ------
    SessionError
        When the folder has a history already, is empty, or contains a link.
    """
    place = Path(folder)
    moment = now.astimezone(UTC)
    files = sorted(path for path in place.rglob("*") if not path.is_dir() or path.is_symlink())
    link = next((path for path in files if path.is_symlink()), None)
    faults = []
    if link is not None:
        faults.append(Fault(str(link.relative_to(place)), "a symbolic link", "a file"))
    if (place / MHL_FOLDER).exists():
        faults.append(
            Fault(MHL_FOLDER, "a history", "none yet: other programs add their generations")
        )
    elif not files:
        faults.append(Fault("files", "none", "at least one"))
    if faults:
        raise SessionError("cannot be sealed", where=str(place), faults=faults)
    name = re.sub(r"[^A-Za-z0-9._-]", "_", place.resolve().name)
    manifest = place / MHL_FOLDER / f"0001_{name}_{moment:%Y-%m-%d_%H%M%SZ}.mhl"
    listed = _hash_list(place, files, moment.replace(microsecond=0), version)
    chain = ElementTree.Element("ascmhldirectory", xmlns=_DIRECTORY_NAMESPACE)
    entry = ElementTree.SubElement(chain, "hashlist", sequencenr="1")
    ElementTree.SubElement(entry, "path").text = manifest.name
    ElementTree.SubElement(entry, "c4").text = c4_id(listed)
    manifest.parent.mkdir()
    manifest.write_bytes(listed)
    (manifest.parent / CHAIN_FILE).write_bytes(_bytes(chain))
    return manifest


def _hash_list(place: Path, files: Iterable[Path], moment: datetime, version: str) -> bytes:
    root = ElementTree.Element("hashlist", version="2.0", xmlns=_LIST_NAMESPACE)
    creator = ElementTree.SubElement(root, "creatorinfo")
    ElementTree.SubElement(creator, "creationdate").text = moment.isoformat()
    ElementTree.SubElement(creator, "hostname").text = _WITHHELD_HOST
    ElementTree.SubElement(creator, "tool", version=version).text = "skinrig"
    process = ElementTree.SubElement(root, "processinfo")
    ElementTree.SubElement(process, "process").text = "transfer"
    hashes = ElementTree.SubElement(root, "hashes")
    for file in files:
        state = file.stat()
        changed = datetime.fromtimestamp(int(state.st_mtime), UTC).isoformat()
        entry = ElementTree.SubElement(hashes, "hash")
        path = ElementTree.SubElement(
            entry, "path", size=str(state.st_size), lastmodificationdate=changed
        )
        path.text = file.relative_to(place).as_posix()
        digest = ElementTree.SubElement(
            entry, "xxh128", action="original", hashdate=moment.isoformat()
        )
        digest.text = xxhash.xxh3_128_hexdigest(file.read_bytes())
    return _bytes(root)


def _bytes(root: ElementTree.Element) -> bytes:
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True) + b"\n"
