"""A session is its owner's alone, and its consent does not grow by an edit."""

import json
import os
import stat

import numpy as np
import pytest

from capture import raw
from capture.plan import flash_plan
from capture.rig import load_rig
from capture.session import Session, SessionDamage, SubjectRecord, reopen_copy, verify
from capture.session.manifest import seal
from skinrig.cli import main

RIG = load_rig("flash").resized(16)


@pytest.fixture
def session(tmp_path):
    """A closed session with an attachment, whose subject agreed to research."""
    words = {"devices": {}, "subject": SubjectRecord("P042", ("research",)), "source": "measured"}
    with Session.create(tmp_path / "s", plan=flash_plan(RIG, darks=1), rig=RIG, **words) as made:
        for step, camera in made.pending_frames():
            values = np.full((10, 16), 600, np.uint16)
            words = {"pattern": "RGGB", "black": 512, "white": 16383}
            blob = raw.encode_dng(values, **words, step_id=step.id, session_id=made.id)
            made.commit(step.id, camera, blob, settings={}, actual={}, t_host_s=0.0)
        made.attach("scan.ply", b"ply")
        made.close()
    return tmp_path / "s"


@pytest.mark.parametrize("umask", [0o000, 0o022])
def test_session_is_readable_by_its_owner_alone(tmp_path, umask, request):
    before = os.umask(umask)
    try:
        made = request.getfixturevalue("session")
        copy, _ = reopen_copy(made, tmp_path / "copy")
        copy.release()
    finally:
        os.umask(before)
    for folder in (made, tmp_path / "copy"):
        for path in (folder, *folder.rglob("*")):
            wanted = 0o700 if path.is_dir() else 0o600
            assert stat.S_IMODE(path.stat().st_mode) == wanted, path


def widen(path, *, reseal):
    """Add a use to the consent of a session, and seal it again when asked."""
    file = path / "session.json"
    document = json.loads(file.read_bytes())
    document["subject"]["consent_scope"] = ["research", "publication"]
    if reseal:
        del document["seal"]
        file.write_bytes(seal(document)[0])
    else:
        file.write_text(json.dumps(document, sort_keys=True, indent=1) + "\n")


@pytest.mark.parametrize("reseal", [False, True])
def test_edited_consent_widens_nothing(session, tmp_path, reseal, capsys):
    argv = ["export", str(session), "--to", "frames", "--use", "publication"]
    assert main([*argv, "--out", str(tmp_path / "before")]) == 3
    assert "has not agreed" in capsys.readouterr().err
    widen(session, reseal=reseal)
    assert main([*argv, "--out", str(tmp_path / "after")]) == 3
    assert "is damaged" in capsys.readouterr().err
    assert not (tmp_path / "after").exists()
    assert not verify(session).ok
    with pytest.raises(SessionDamage):
        Session.open(session)


def test_consent_of_emptied_journal_widens_nothing(session, tmp_path, capsys):
    widen(session, reseal=True)
    (session / "journal.jsonl").write_bytes(b"")
    argv = ["export", str(session), "--to", "mhl", "--use", "publication"]
    assert main([*argv, "--out", str(tmp_path / "out")]) == 3
    assert not (tmp_path / "out").exists()
