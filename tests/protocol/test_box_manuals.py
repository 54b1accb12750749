"""Every row of each box's manual, on the box itself: bytes and time in, bytes out."""

import json

import pytest
from fixtures.box_manuals import ANY, BOXES, SHARED_ANSWERS, SHARED_REFUSALS

from capture.devices import wire
from capture.devices.wire import Code
from rigsim.boxes.command import on_clock

IN_OPERATION = {
    "flash": ("SYST:ARM", "FLAS:LAMP ON,500"),
    "dome": ("SYST:ARM", "SAFE:EYES CLOSED", "LED:ON 3,400,300"),
    "gradient_sphere": ("SYST:ARM", "SAFE:EYES CLOSED", "PATT X,400,300"),
    "caliper": (*BOXES["caliper"].ready, "CAL:ATT"),
    "probe": ("SYST:ARM", "HEAD:SITE cheek,0", "PUMP ON,5000,60"),
    "scanner": ("SYST:ARM", "SAFE:EYES CLOSED", "TRIG a1,500"),
}
"""By box, what lights, sucks or holds for longer than until the emergency stop has closed again."""
STOP_S = 0.2
HARMLESS = ("SAFE", "ABOR", "*CLS")
"""What every box obeys without a frame."""
ROWS = [
    pytest.param(manual, header, id=f"{name}-{header}")
    for name, manual in BOXES.items()
    for header in manual.all_answers
]
each_box = pytest.mark.parametrize("manual", BOXES.values(), ids=BOXES)


def rows(keep):
    return pytest.mark.parametrize(("manual", "header"), [row for row in ROWS if keep(*row.values)])


@each_box
def test_the_manual_is_complete(manual):
    commands = manual.bench().box.commands
    assert manual.all_answers.keys() == commands.keys()
    assert all(command.manual for command in commands.values())


@rows(lambda manual, header: header not in manual.late)
def test_framed_command_is_answered_as_in_manual(manual, header):
    text, before, expected = manual.all_answers[header]
    bench = manual.bench()
    bench.say(before)
    payload = bench.ask(text)
    assert expected is ANY or payload == expected


@rows(lambda manual, header: header.endswith("?"))
def test_a_bare_query_is_answered_plainly(manual, header):
    text, _, expected = manual.all_answers[header]
    answer = manual.bench().bare(text).decode()
    assert answer.endswith("\n")
    assert answer.count("\n") == 1
    assert expected is ANY or answer == f"{expected}\n"


@rows(
    lambda manual, header: (
        not header.endswith("?")
        and manual.all_answers[header][0] not in (*HARMLESS, *manual.unframed)
    )
)
def test_a_bare_command_is_refused_and_changes_nothing(manual, header):
    text, before, _ = manual.all_answers[header]
    bench = manual.bench()
    bench.ask("SYST:ARM")
    bench.say(before)
    was = manual.state(bench)
    assert bench.bare(text) == b""
    assert bench.bare("SYST:ERR?") == b'203,"Unframed command"\n'
    bench.wait(0.5)
    assert manual.state(bench) == was
    assert bench.ask("SYST:ARM?") == "1"


@pytest.mark.parametrize(
    ("manual", "text"),
    [
        pytest.param(manual, text, id=f"{name}-{text}")
        for name, manual in BOXES.items()
        for text in (*HARMLESS, *manual.unframed)
    ],
)
def test_safety_commands_need_neither_frame_nor_arming(manual, text):
    bench = manual.bench()
    assert bench.code(text) == Code.OK
    bench.bare(text)
    assert bench.bare("SYST:ERR?") == b'0,"No error"\n'
    assert manual.idle(bench.unit)


@pytest.mark.long
@pytest.mark.parametrize(
    ("manual", "text"),
    [
        pytest.param(manual, header + ("" if " " in text else " 1"), id=f"{name}-{header}")
        for name, manual in BOXES.items()
        for header, (text, _, _) in manual.all_answers.items()
    ],
)
def test_missing_or_surplus_arguments_are_a_syntax_error(manual, text):
    bench = manual.bench()
    bench.say(manual.ready)
    was = manual.state(bench)
    assert bench.code(text) == Code.SYNTAX
    assert manual.state(bench) == was


@pytest.mark.parametrize(
    ("manual", "text", "code"),
    [
        pytest.param(manual, text, code, id=f"{name}-{text}")
        for name, manual in BOXES.items()
        for text, code in (*SHARED_REFUSALS, *manual.refusals)
    ],
)
def test_invalid_command_is_refused_and_changes_nothing(manual, text, code):
    bench = manual.bench()
    bench.say(manual.ready)
    was = manual.state(bench)
    assert bench.code(text) == code
    assert manual.state(bench) == was
    assert manual.idle(bench.unit)


@pytest.mark.parametrize(
    ("manual", "text"),
    [
        pytest.param(manual, text, id=f"{name}-{text}")
        for name, manual in BOXES.items()
        for text in manual.acts
    ],
)
def test_nothing_lights_or_moves_unless_armed(manual, text):
    bench = manual.bench()
    bench.say((*manual.ready, "SAFE"))
    was = manual.state(bench)
    assert bench.code(text) == Code.NOT_ARMED
    bench.wait(1.0)
    assert manual.state(bench) == was
    bench.ask("SYST:ARM")
    bench.silence(1.5)
    assert bench.code(text) == Code.WATCHDOG_TRIPPED
    assert manual.idle(bench.unit)


@each_box
def test_controller_reports_its_identity(manual):
    bench = manual.bench()
    _, _, serial, firmware = manual.identity.split(",")
    assert bench.ask("*IDN?") == manual.identity
    assert bench.ask("SYST:HELLO?") == f"1,{manual.name},{serial},{firmware}"


@each_box
def test_the_data_dictionary_carries_its_own_checksum(manual):
    limits = json.loads(wire.unseal(manual.bench().ask("SYST:CAP?")))
    assert limits["kind"] == manual.name
    assert (limits["lease_min_ms"], limits["lease_max_ms"]) == (300, 5000)


@each_box
def test_data_dictionary_parts_join_into_whole_short_lines(manual):
    bench = manual.bench()
    parts, last = [], "0"
    while last == "0":
        line = bench.raw(bench.frame(f"SYST:CAP:PART? {len(parts)}")).rstrip()
        assert len(line) < 80
        last, _, part = wire.decode(line).payload.partition(",")
        parts.append(part)
    assert "".join(parts) == bench.ask("SYST:CAP?")
    assert len(parts) > 3


def test_manuals_list_common_commands_only_once():
    for manual in BOXES.values():
        assert not SHARED_ANSWERS.keys() & manual.answers.keys()


@each_box
def test_stop_in_operation_ends_it_for_good(manual):
    bench = manual.bench()
    *before, act = IN_OPERATION[manual.name]
    bench.say(before)
    bench.raw(bench.frame(act))
    bench.silence(0.1)
    assert not manual.idle(bench.unit)
    opens_s = on_clock(bench.now + 0.05)
    bench.unit.stop_changes_s = [opens_s, on_clock(opens_s + STOP_S)]
    bench.silence(0.1)
    assert manual.idle(bench.unit)
    assert int(bench.ask("STAT?")) & 256
    assert bench.code(act) == Code.INTERLOCK
    bench.silence(STOP_S)
    assert not int(bench.ask("STAT?")) & 256
    assert manual.idle(bench.unit)
