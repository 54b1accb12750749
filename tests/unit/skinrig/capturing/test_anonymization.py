"""An anonymized copy hides eyes and landmarks, keeps the rest, and leaves the original alone."""

import json

import numpy as np
import pytest

from capture import raw
from capture.plan import flash_plan
from capture.rig import load_rig
from capture.session import Session, SubjectRecord, verify
from skinrig.capturing import anonymization
from skinrig.cli import main

RIG = load_rig("flash").resized(32)
VIEW = RIG.views[0]
SHAPE = (VIEW.height_px, VIEW.width_px)
EYES = {"left eye": (10.0, 6.0), "right eye": (22.0, 6.0)}
RADIUS = 0.1


@pytest.fixture
def session(tmp_path):
    """A closed session of drawn frames, with a scan."""
    rng = np.random.default_rng(5)
    subject = SubjectRecord("P042", ("research",))
    words = {"devices": {"flash": "x"}, "subject": subject, "source": "measured"}
    with Session.create(tmp_path / "s", plan=flash_plan(RIG, darks=1), rig=RIG, **words) as made:
        for number, (step, camera) in enumerate(made.pending_frames()):
            cfa = rng.integers(600, 16_000, SHAPE).astype(np.uint16)
            levels = {"pattern": "RGGB", "black": (512, 513, 514, 515), "white": 16_383}
            blob = raw.encode_dng(cfa, **levels, step_id=step.id, session_id=made.id, iso=100)
            actual = {"exposure_s": 0.01, "token": f"t{number}"}
            made.commit(step.id, camera, blob, settings=step.settings, actual=actual, t_host_s=1.0)
        made.attach("scan.ply", b"ply")
        made.close()
    return tmp_path / "s"


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "eyes.csv"
    rows = [f"{name},{x},{y}" for name, (x, y) in EYES.items()]
    path.write_text("\n".join(["name,x,y", *rows]), "utf-8")
    return path


def anonymize(session, *options):
    out = session.with_name("anonymous")
    return main(["session", "anonymize", str(session), "--out", str(out), *options]), out


def snapshot(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def is_hidden(shape):
    y, x = np.indices(shape)
    radius_px = RADIUS * shape[1]
    near = [(x - cx) ** 2 + (y - cy) ** 2 <= radius_px**2 for cx, cy in EYES.values()]
    return np.logical_or(*near)


def test_landmarks_are_black_and_rest_unchanged(session, table, capsys):
    before = snapshot(session)
    code, out = anonymize(
        session, "--landmarks", f"{VIEW.name}={table}", "--radius", str(RADIUS), "--json"
    )
    assert code == 0
    assert snapshot(session) == before
    old, new = Session.open(session), Session.open(out)
    hidden = is_hidden(SHAPE)
    assert 20 < hidden.sum() < 0.3 * hidden.size
    black = np.tile([[512, 513], [514, 515]], (SHAPE[0] // 2, SHAPE[1] // 2))
    for one, other in zip(old.frames(), new.frames(), strict=True):
        was, now = old.read(one).cfa, new.read(other).cfa
        expected = was if one.kind == "dark" else np.where(hidden, black, was)
        np.testing.assert_array_equal(now, expected)
        assert (other.settings, other.actual) == (one.settings, one.actual)
    document = json.loads(capsys.readouterr().out)
    assert document["removed"] == ["scan.ply"]
    assert any("nevi" in text for text in document["identifiable"])
    assert document["blackened"] == document["frames"] - 1


def test_copy_verifies_and_keeps_consent(session, table):
    _, out = anonymize(session, "--landmarks", f"{VIEW.name}={table}", "--pseudonym", "X1")
    old, new = Session.open(session), Session.open(out)
    report = verify(out)
    assert report.ok
    assert new.complete
    assert new.id != old.id
    assert new.subject == SubjectRecord("X1", ("research",))
    assert not new.is_export_allowed("publication")
    assert new.attachments() == ()
    assert old.id.encode() not in b"".join(snapshot(out).values())


def test_dropped_images_leave_plan_and_reason(session):
    code, out = anonymize(session, "--drop-images")
    assert code == 0
    new = Session.open(out)
    assert new.frames() == []
    assert new.closed
    assert new.plan == Session.open(session).plan
    report = verify(out)
    assert report.ok
    assert any("removed to anonymize" in warning for warning in report.warnings)


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        ((), 2, "got nothing"),
        (("--drop-images", "--landmarks", "cam=TABLE"), 2, "got landmarks and --drop-images"),
        (("--landmarks", "side=TABLE"), 2, "got the view 'side'"),
        (("--landmarks", "cam=TABLE", "--radius", "0"), 3, "--radius: got 0"),
    ],
)
def test_unclear_orders_are_refused(session, table, capsys, options, code, message):
    given = [text.replace("TABLE", str(table)) for text in options]
    ended, out = anonymize(session, *given)
    assert ended == code
    assert message in capsys.readouterr().err
    assert not out.exists()


def test_failed_anonymization_leaves_nothing(session, table, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(anonymization, "blacken_discs", fail)
    code, out = anonymize(session, "--landmarks", f"{VIEW.name}={table}")
    assert code == 3
    assert not out.exists()
