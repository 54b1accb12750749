"""An anonymized copy hides eyes and landmarks, keeps the rest, and leaves the original alone."""

import json

import cv2
import numpy as np
import pytest

from capture import raw
from capture.importers import import_photos
from capture.plan import flash_plan
from capture.rig import load_rig
from capture.session import Session, SubjectRecord, verify
from skinrig.capturing import anonymization
from skinrig.cli import main

RIG = load_rig("flash").resized(32)
VIEW = RIG.views[0]
SHAPE = (VIEW.height_px, VIEW.width_px)
EYES = {"left eye": (5.0, 3.0), "right eye": (11.0, 3.0)}
"""Pixels of the maps: half the sensor's."""
RADIUS = 0.1
PHOTOGRAPH_EYES = {"left": (60.0, 40.0), "right": (90.0, 40.0)}


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
            lit = {"token": f"run9.{number}", "power": 1.0}
            about = {"step_id": step.id, "session_id": made.id, "light": lit}
            blob = raw.encode_dng(cfa, **levels, **about, iso=100)
            actual = {"exposure_s": 0.01, "token": f"run9.{number}"}
            made.commit(step.id, camera, blob, settings=step.settings, actual=actual, t_host_s=1.0)
        made.attach("scan.ply", b"ply")
        made.close()
    return tmp_path / "s"


@pytest.fixture
def table(tmp_path):
    return write_table(tmp_path / "eyes.csv", EYES)


def write_table(path, landmarks):
    rows = [f"{name},{x},{y}" for name, (x, y) in landmarks.items()]
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
    near = [
        (x - 0.5 - 2 * cx) ** 2 + (y - 0.5 - 2 * cy) ** 2 <= radius_px**2
        for cx, cy in EYES.values()
    ]
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
        assert (other.settings, other.actual) == (one.settings, {"exposure_s": 0.01})
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
    content = b"".join(snapshot(out).values())
    assert old.id.encode() not in content
    assert b"run9" in b"".join(snapshot(session).values())
    assert b"run9" not in content


@pytest.fixture
def photographs(tmp_path):
    """A session of three photographs that are named after a person."""
    folder = tmp_path / "photos"
    folder.mkdir()
    image = np.random.default_rng(3).integers(60, 200, (100, 150, 3)).astype(np.uint8)
    for name, shown in (
        ("neutral", image),
        ("anna_mueller parallel", image[:, :, ::-1]),
        ("anna_mueller crossed", image[:, :80]),
    ):
        cv2.imwrite(str(folder / f"{name}.png"), shown)
    import_photos(folder, out=tmp_path / "s")
    return tmp_path / "s"


def test_photographs_are_black_at_their_own_pixels(photographs, tmp_path):
    narrow = write_table(tmp_path / "narrow.csv", {"left": PHOTOGRAPH_EYES["left"]})
    table = write_table(tmp_path / "eyes.csv", PHOTOGRAPH_EYES)
    options = ("--landmarks", f"cam={narrow}", "--landmarks", f"cam2={table}")
    code, out = anonymize(photographs, *options)
    assert code == 0
    old, new = Session.open(photographs), Session.open(out)
    was, now = (one.read(one.frames(state="neutral")[0]).cfa[::2, ::2] for one in (old, new))
    y, x = np.nonzero(was != now)
    for eye_x, eye_y in PHOTOGRAPH_EYES.values():
        near = np.abs(x - eye_x) < 12
        np.testing.assert_allclose((x[near].mean(), y[near].mean()), (eye_x, eye_y), atol=0.6)
        assert np.ptp(x[near]) == pytest.approx(2 * 0.05 * 150, abs=1.5)


def test_photographs_of_copy_lose_names_and_hashes(photographs):
    before = (photographs / "session.json").read_bytes()
    assert b"anna" in before
    assert before.count(b'"sha256"') == 3
    code, out = anonymize(photographs, "--drop-images", "--pseudonym", "X")
    assert code == 0
    content = b"".join(snapshot(out).values())
    assert b"anna" not in content
    assert b"mueller" not in content
    assert b'"sha256"' not in content
    states = [step.index["state"] for step in Session.open(out).plan.steps]
    assert sorted(states) == ["neutral", "state-1", "state-1"]
    assert verify(out).ok


@pytest.mark.parametrize(
    ("landmarks", "message"),
    [
        ({}, "eyes.csv: got no landmark"),
        (
            {"left eye": (16.0, 3.0)},
            "eyes.csv: 'left eye': got (16, 3), expected a point of the 16",
        ),
        ({"left eye": (5.0, -1.0)}, "got (5, -1)"),
    ],
)
def test_landmarks_outside_image_are_refused(session, tmp_path, capsys, landmarks, message):
    table = write_table(tmp_path / "eyes.csv", landmarks)
    code, out = anonymize(session, "--landmarks", f"{VIEW.name}={table}")
    assert code == 3
    assert message in capsys.readouterr().err
    assert not out.exists()


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

    monkeypatch.setattr(anonymization, "blacken_pixels", fail)
    code, out = anonymize(session, "--landmarks", f"{VIEW.name}={table}")
    assert code == 3
    assert not out.exists()
