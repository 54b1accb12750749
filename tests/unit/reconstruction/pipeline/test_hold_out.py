"""Held-out parts: parsed, found in a session, or refused by name."""

import pytest

from reconstruction.pipeline.hold_out import HoldOut, HoldOutError

LIGHTS = tuple(f"L{k:03}" for k in range(12))
VIEWS = ("C00", "C03", "C07")


def test_names_and_positions_select_lights_and_views():
    held = HoldOut.parse("lights=L007, 2,L007,views=1").resolve(LIGHTS, VIEWS)
    assert held == HoldOut(("L002", "L007"), ("C03",))
    assert held.is_held_out("L007", "C00")
    assert held.is_held_out("L000", "C03")
    assert not held.is_held_out("L000", "C00")


def test_nothing_held_out_holds_no_frame():
    assert not HoldOut()
    assert not HoldOut().resolve(LIGHTS, VIEWS).is_held_out("L000", "C00")
    assert HoldOut.parse("views=C00")


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "lights=NAMES"),
        ("L007", "L007"),
        ("lamps=L007", "lamps"),
        ("lights=", "lights="),
        ("lights=L001,,L002", "L001,,L002"),
        ("lights=L001,lights=L002", "at most once"),
    ],
)
def test_ambiguous_hold_out_list_is_refused(text, named):
    with pytest.raises(HoldOutError, match=named):
        HoldOut.parse(text)


@pytest.mark.parametrize(
    ("text", "named"),
    [("lights=L012", "L012"), ("lights=12", "0 to 11"), ("views=C01", "C00, C03, C07")],
)
def test_hold_out_outside_session_is_refused_by_name(text, named):
    with pytest.raises(HoldOutError, match=named):
        HoldOut.parse(text).resolve(LIGHTS, VIEWS)
