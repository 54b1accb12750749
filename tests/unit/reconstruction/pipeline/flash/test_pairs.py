"""Pairs are of one camera and both polarizers; their white is that of the frames read."""

from types import SimpleNamespace

import numpy as np
import pytest

from capture import raw
from reconstruction.pipeline.flash.mean_frames import make_image_reader
from reconstruction.pipeline.flash.pair_diagnosis import list_pairs

SIDE = 16


def make_record(camera, polarizer, repeat=0):
    return SimpleNamespace(
        camera=camera,
        index={"state": "neutral", "polarizer": polarizer, "repeat": repeat},
        settings={"polarizer": polarizer},
    )


def make_session(records):
    view = SimpleNamespace(cfa="RGGB", width_px=SIDE, height_px=SIDE)
    return SimpleNamespace(
        manifest=SimpleNamespace(extra={}, has_developed_images=False),
        rig=SimpleNamespace(view=lambda _: view),
        frames=lambda kind, **_: records if kind == "subject" else [],
    )


def test_each_camera_has_its_own_pair():
    records = [make_record(camera, light) for camera in "ab" for light in ("parallel", "crossed")]
    found = list_pairs(make_session(records))
    assert [(one.camera, other.camera) for one, other in found] == [("a", "a"), ("b", "b")]


@pytest.mark.parametrize("more", ["open", "dark"])
def test_other_polarizers_are_of_no_pair(more):
    records = [make_record("a", light) for light in ("parallel", "crossed", more)]
    (pair,) = list_pairs(make_session(records))
    assert [one.index["polarizer"] for one in pair] == ["parallel", "crossed"]
    assert list_pairs(make_session(records[1:])) == []


def test_white_is_that_of_the_frames_read():
    """No frame is read twice; the white is that of the first frame that is averaged."""
    records = [make_record("a", "parallel", repeat) for repeat in (1, 2)]
    read = []

    def read_frame(record):
        read.append(record)
        codes = np.full((SIDE, SIDE), 500, np.uint16)
        white = (0.5, 1.0, 0.25 * record.index["repeat"])
        return raw.RawFrame(
            cfa=codes, pattern="RGGB", black=(64.0,) * 4, white=4095, neutral=white,
            noise_profile=(1e-4, 1e-6),
        )  # fmt: skip

    session = make_session(records)
    session.read = read_frame
    found = make_image_reader(session, None)(records)
    assert found.neutral == (0.5, 1.0, 0.25)
    assert read == records
