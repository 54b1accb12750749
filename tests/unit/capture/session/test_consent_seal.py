"""A key of the lab: a person without it cannot widen a consent by any recomputation."""

import contextlib
import errno
import hashlib
import json
import os
import re
import shlex
import shutil
import stat
import subprocess
from collections import Counter

import numpy as np
import pytest

from capture import raw
from capture.plan import flash_plan
from capture.rig import load_rig
from capture.session import (
    Session,
    SessionDamage,
    SessionDiskError,
    SessionError,
    SubjectRecord,
    reopen_copy,
    verify,
)
from capture.session.consent_seal import (
    KEY_VARIABLE,
    REFUSED_STATE,
    SEAL_FILE,
    SEALED_STATE,
    UNCHECKED_STATE,
    UNSEALED_STATE,
    make_seal,
    read_key,
)
from capture.session.contents import read_contents
from capture.session.folder import seal_consent
from capture.session.journal import seal_line
from capture.session.manifest import seal
from skinrig.cli import main
from skinrig.soaking.host_life import HostKilled
from skinrig.soaking.storage import DISK_FAULTS, FaultyDisk

RIG = load_rig("flash").resized(16)


@pytest.fixture
def key(tmp_path, monkeypatch):
    """The file of a lab's key, which is set."""
    path = tmp_path / "consent.key"
    path.write_bytes(bytes(range(32)))
    path.chmod(0o600)
    monkeypatch.setenv(KEY_VARIABLE, str(path))
    return path


@pytest.fixture
def make_session(tmp_path):
    """Make a closed session whose subject agreed to research."""

    def make(name="s"):
        words = {"devices": {}, "subject": SubjectRecord("P042", ("research",))}
        path, plan = tmp_path / name, flash_plan(RIG, darks=1)
        with Session.create(path, plan=plan, rig=RIG, source="measured", **words) as made:
            for step, camera in made.pending_frames():
                values = np.full((10, 16), 600, np.uint16)
                words = {"pattern": "RGGB", "black": 512, "white": 16383}
                blob = raw.encode_dng(values, **words, step_id=step.id, session_id=made.id)
                made.commit(step.id, camera, blob, settings={}, actual={}, t_host_s=0.0)
            made.close()
        return path

    return make


def forge(path):
    """Widen a consent, and recompute the seal of the manifest and the chain of the journal."""
    lines = [line for _, line in read_contents(path, sealing=True).walk.lines]
    document = json.loads((path / "session.json").read_bytes())
    document["subject"]["consent_scope"] = ["research", "publication"]
    del document["seal"]
    data, head = seal(document)
    (path / "session.json").write_bytes(data)
    journal = b""
    for line in lines:
        text, head = seal_line(head, line)
        journal += text
    (path / "journal.jsonl").write_bytes(journal)


def export(path, out, form="mhl"):
    options = ["--to", form, "--use", "publication", "--out", str(out)]
    return main(["export", str(path), *options])


def test_forged_chain_widens_an_unsealed_consent(make_session, tmp_path, capsys):
    """The gap that the key closes; `verify` states that nothing was sealed."""
    path = make_session()
    assert export(path, tmp_path / "before") == 3
    forge(path)
    assert export(path, tmp_path / "after") == 0
    assert verify(path).consent_seal == UNSEALED_STATE
    capsys.readouterr()
    assert main(["verify", str(path)]) == 0
    assert "consent unsealed" in capsys.readouterr().out


@pytest.mark.parametrize("form", ["mhl", "frames", "event-model"])
def test_forged_chain_of_sealed_consent_is_refused(key, make_session, tmp_path, capsys, form):
    path = make_session()
    assert verify(path).consent_seal == SEALED_STATE
    forge(path)
    found = verify(path)
    assert not found.ok
    assert "differs from the sealed session.json" in found.problems[0]
    with pytest.raises(SessionDamage, match=r"differs from the sealed session\.json"):
        Session.open(path)
    assert main(["verify", str(path)]) == 3
    assert export(path, tmp_path / "out", form) == 3
    assert "[SR-SES-017]" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_forger_gains_nothing_by_other_seals(key, make_session, tmp_path, capsys):
    """A removed seal, and that of another session, of another key, a link or a long file."""
    path, other = make_session(), make_session("other")
    forge(path)
    (path / SEAL_FILE).unlink()
    assert export(path, tmp_path / "out") == 3
    assert "[SR-SES-016]" in capsys.readouterr().err
    for content in ((other / SEAL_FILE).read_bytes(), b"", b"0" * 64 + b"\n", bytes(1000)):
        (path / SEAL_FILE).write_bytes(content)
        assert not verify(path).ok
        assert export(path, tmp_path / "out") == 3
    (path / SEAL_FILE).unlink()
    (path / SEAL_FILE).symlink_to(other / SEAL_FILE)
    assert not verify(path).ok
    assert verify(other).ok


def test_sealed_consent_without_key_is_not_checked(key, make_session, monkeypatch, capsys):
    path = make_session()
    monkeypatch.delenv(KEY_VARIABLE)
    assert verify(path).ok
    assert verify(path).consent_seal == UNCHECKED_STATE
    assert main(["verify", str(path)]) == 0
    assert f"not checked without {KEY_VARIABLE}" in capsys.readouterr().out
    forge(path)
    assert verify(path).ok  # nobody can find it without the key


def test_another_key_does_not_open_a_session(key, make_session):
    path = make_session()
    key.write_bytes(bytes(32))
    assert not verify(path).ok


def test_seal_is_its_owners_and_without_key(key, make_session):
    path = make_session()
    assert stat.S_IMODE((path / SEAL_FILE).stat().st_mode) == 0o600
    sealed = (path / SEAL_FILE).read_bytes()
    for secret in (key.read_bytes(), key.read_bytes().hex().encode()):
        assert secret not in sealed
    assert verify(path).warnings == ()


def test_copies_of_sealed_session_are_sealed(key, make_session, tmp_path):
    path = make_session()
    copy, _ = reopen_copy(path, tmp_path / "copy")
    copy.release()
    assert verify(tmp_path / "copy").consent_seal == SEALED_STATE
    argv = ["export", str(path), "--to", "mhl", "--use", "research"]
    assert main([*argv, "--out", str(tmp_path / "out")]) == 0
    assert verify(tmp_path / "out").consent_seal == SEALED_STATE
    shutil.rmtree(path / "frames")
    assert not verify(path).ok


def test_command_seals_older_session_once(make_session, key, monkeypatch, capsys):
    monkeypatch.delenv(KEY_VARIABLE)
    path = make_session()
    assert main(["session", "seal", str(path)]) == 3
    assert KEY_VARIABLE in capsys.readouterr().err
    monkeypatch.setenv(KEY_VARIABLE, str(key))
    found = verify(path)
    assert not found.ok
    assert (len(found.problems), found.damage) == (1, ())
    assert "SR-SES-016" in found.refused_seal
    for _ in range(2):
        assert main(["session", "seal", str(path)]) == 0
        assert "P042: research" in capsys.readouterr().out
    assert verify(path).consent_seal == SEALED_STATE
    forge(path)
    assert main(["session", "seal", str(path)]) == 3
    assert not verify(path).ok


def test_command_seals_no_damaged_session(make_session, key, monkeypatch):
    monkeypatch.delenv(KEY_VARIABLE)
    path = make_session()
    journal = path / "journal.jsonl"
    journal.write_bytes(journal.read_bytes().replace(b"S000", b"S009"))
    monkeypatch.setenv(KEY_VARIABLE, str(key))
    assert main(["session", "seal", str(path)]) == 3
    assert not (path / SEAL_FILE).exists()


@pytest.mark.parametrize(
    ("size", "mode", "fault"),
    [(31, 0o600, "31 bytes"), (5000, 0o600, "5000 bytes"), (32, 0o640, "mode 640"), (None, 0, "")],
)
def test_unfit_key_is_refused_before_a_session(
    tmp_path, make_session, monkeypatch, size, mode, fault
):
    path = tmp_path / "key"
    if size is not None:
        path.write_bytes(bytes(size))
        path.chmod(mode)
    monkeypatch.setenv(KEY_VARIABLE, str(path))
    with pytest.raises(SessionError, match=fault or "No such file"):
        make_session()
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize("size", [31, 32, 4096, 4097])
def test_key_has_bytes_within_its_bounds(key, size):
    key.write_bytes(bytes(size))
    if size in (32, 4096):
        assert read_key() == bytes(size)
    else:
        fault = f"got {size} bytes, expected a file of 32 to 4096 bytes"
        with pytest.raises(SessionError, match=fault) as caught:
            read_key()
        assert "[SR-SES-015]" in str(caught.value)


@pytest.mark.parametrize("bit", range(9))
def test_key_is_open_to_its_owner_alone(key, bit):
    """Each permission of others refuses it; those of its owner do not."""
    mode = 0o400 | 1 << bit
    key.chmod(mode)
    if mode & 0o700 == mode:
        assert len(read_key()) == 32
    else:
        with pytest.raises(SessionError, match=f"got mode {mode:o}, expected mode 600"):
            read_key()


def test_seal_is_hash_of_key_and_manifest():
    """RFC 2104 by hand, for a key shorter than a block and one longer."""
    for key in (bytes(range(32)), bytes(range(200))):
        block = (key if len(key) <= 64 else hashlib.sha256(key).digest()).ljust(64, b"\0")
        inner, outer = (bytes(one ^ pad for one in block) for pad in (0x36, 0x5C))
        content = b"skinrig.consent-seal/1\n" + b"{}"
        code = hashlib.sha256(outer + hashlib.sha256(inner + content).digest()).hexdigest()
        assert make_seal(b"{}", key) == code.encode() + b"\n"


def test_key_command_is_quoted_and_for_missing_file(tmp_path, monkeypatch):
    """The printed command makes a key; nothing is printed that would write over a file."""
    path = tmp_path / "a lab's key; touch x"
    monkeypatch.setenv(KEY_VARIABLE, str(path))
    with pytest.raises(SessionError, match="Make one") as caught:
        read_key()
    command = re.search(r"Make one: (.*) \[", str(caught.value)).group(1)
    subprocess.run(["sh", "-c", command], check=True, cwd=tmp_path)
    assert len(read_key()) == 32
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
    path.chmod(0o640)
    with pytest.raises(SessionError, match=re.escape(f"chmod 600 {shlex.quote(str(path))}")):
        read_key()
    path.write_bytes(b"short")
    with pytest.raises(SessionError, match="5 bytes") as caught:
        read_key()
    assert "Make one" not in str(caught.value)
    monkeypatch.setenv(KEY_VARIABLE, str(tmp_path))
    with pytest.raises(SessionError, match="not a plain file"):
        read_key()


@pytest.mark.parametrize("code", [errno.EACCES, errno.EIO])
def test_unreadable_key_is_not_replaced(key, monkeypatch, code):
    def refuse(path):
        raise OSError(code, os.strerror(code), str(path))

    monkeypatch.setattr(type(key), "read_bytes", refuse)
    with pytest.raises(SessionError, match=os.strerror(code)) as caught:
        read_key()
    assert "Make one" not in str(caught.value)


@pytest.mark.parametrize("fault", DISK_FAULTS)
def test_fault_while_sealing_leaves_no_wrong_seal(make_session, key, tmp_path, monkeypatch, fault):
    """At each operation of `seal_consent`; the same command then seals."""
    monkeypatch.delenv(KEY_VARIABLE)
    made = make_session()
    monkeypatch.setenv(KEY_VARIABLE, str(key))
    struck = Counter()
    while True:
        path = tmp_path / f"s{struck.total()}"
        shutil.copytree(made, path)
        disk = FaultyDisk(tmp_path, strike=struck.total() + 1, fault=fault)
        with contextlib.suppress(SessionDiskError, HostKilled):
            seal_consent(path, disk=disk)
        disk.close_all()
        if not disk.struck:
            break
        struck[disk.struck] += 1
        if (path / SEAL_FILE).exists():
            assert verify(path).consent_seal == SEALED_STATE
        assert seal_consent(path).consent_seal == SEALED_STATE
        assert verify(path).warnings == ()  # no part of a seal is left
    assert {"create", "write", "fsync", "rename", "fsync_dir"} <= set(struck)


def test_seal_of_interrupted_creation_is_not_taken(make_session, key, tmp_path, monkeypatch):
    """A later session in the same folder, made without the key, is not sealed."""
    other = make_session("other")
    (tmp_path / "s").mkdir()
    shutil.copy(other / SEAL_FILE, tmp_path / "s")
    (tmp_path / "s" / f"{SEAL_FILE}.part").write_bytes(b"half")
    monkeypatch.delenv(KEY_VARIABLE)
    assert verify(make_session()).consent_seal == UNSEALED_STATE


@pytest.mark.parametrize("wrong", [False, True])
def test_verify_checks_files_despite_refused_seal(key, make_session, capsys, wrong):
    """A missing or wrong seal is not damage of frames, and hides none."""
    path = make_session()
    sound = verify(path)
    (path / SEAL_FILE).unlink()
    if wrong:
        (path / SEAL_FILE).write_bytes(b"0" * 64 + b"\n")
    found = verify(path)
    assert not found.ok
    assert found.damage == ()
    assert (found.frames, found.bytes) == (sound.frames, sound.bytes)
    assert found.frames > 0
    assert found.consent_seal == REFUSED_STATE
    assert main(["verify", str(path)]) == 3
    shown = capsys.readouterr().out
    assert f"SEAL REFUSED, {sound.frames} frames" in shown
    assert "DAMAGED" not in shown
    assert "damaged:" not in shown
    frame = next((path / "frames").iterdir())
    frame.write_bytes(frame.read_bytes()[:-1] + b"x")
    found = verify(path)
    assert found.frames == sound.frames - 1
    assert len(found.damage) == 1
    assert frame.name in found.damage[0]
    assert main(["verify", str(path)]) == 3
    assert "DAMAGED" in capsys.readouterr().out


@pytest.mark.parametrize("fault", ["mode", "missing"])
def test_unfit_key_is_not_damage(key, make_session, capsys, fault):
    path = make_session()
    if fault == "mode":
        key.chmod(0o644)
    else:
        key.unlink()
    with pytest.raises(SessionError, match="SR-SES-015"):
        verify(path)
    assert main(["verify", str(path)]) == 3
    shown = capsys.readouterr()
    assert "SR-SES-015" in shown.err
    assert "DAMAGED" not in shown.out + shown.err
