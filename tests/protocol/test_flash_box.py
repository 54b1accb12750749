"""The protocol that all boxes share, and the flash box in time, beyond its manual's rows."""

import itertools
import json

import numpy as np
import pytest
from fixtures.box_manuals import FLASH

from capture.devices import wire
from capture.devices.wire import Code, Event
from rigsim.boxes.controller import MAX_CACHED_REPLIES, MAX_QUEUED_ERRORS

RIG = FLASH.rig


@pytest.fixture
def bench():
    return FLASH.bench()


@pytest.mark.parametrize("line", ["SAFE", "ABOR", "abor\r"])
def test_anybody_may_put_the_light_out(bench, line):
    bench.ask("SYST:ARM")
    bench.ask("FLAS:LAMP ON,500")
    bench.bare(line)
    assert not bench.unit.lit
    assert bench.ask("SYST:ARM?") == "0"


def test_an_unknown_header_is_undefined_framed_or_bare(bench):
    assert bench.code("FLAS:EXPLODE") == Code.UNDEFINED_HEADER
    bench.bare("FLAS:EXPLODE")
    bench.bare("caf\xe9?")
    assert [bench.bare("SYST:ERR?")[:5] for _ in range(4)] == [b"-113,"] * 3 + [b'0,"No']


def test_settings_are_read_back(bench):
    for text, query, payload in [
        ("FLAS:POL CROS", "FLAS:POL?", "CROS"),
        ("FLAS:POL CROS", "FLAS:POL:ANG?", "90.000"),
        ("FLAS:POL:ANG 30", "FLAS:POL:ANG?", "30.000"),
        ("FLAS:POW 0.5", "FLAS:POW?", "0.50000000"),
        ("FLAS:SYNC 12500", "FLAS:SYNC?", "12500"),
        ("*RST", "FLAS:SYNC?", "0"),
        ("SYST:WDOG 500", "SYST:WDOG?", "500"),
        ("SYST:ARM", "SYST:ARM?", "1"),
        ("SYST:ARM", "STAT?", "49"),
        ("*RST", "FLAS:POW?", "1.00000000"),
    ]:
        bench.ask(text)
        assert bench.ask(query) == payload, text


def test_the_data_dictionary_carries_its_own_checksum(bench):
    payload = bench.ask("SYST:CAP?")
    limits = json.loads(wire.unseal(payload))
    assert limits["kind"] == "flash"
    assert limits["recycle_s"] == RIG.recycle_s
    assert limits["pops_per_min"] == RIG.max_pops_per_min
    assert (limits["lease_min_ms"], limits["lease_max_ms"]) == (300, 5000)
    assert (limits["sync_min_us"], limits["sync_max_us"]) == (0, 50_000)


# protocol -------------------------------------------------------------------------------------


def test_repeated_frame_is_answered_again_without_repeating_action(bench):
    bench.ask("SYST:ARM")
    frame = bench.frame("FLAS:FIRE a1")
    assert bench.raw(frame) == bench.raw(frame) == bench.raw(b"\n" + frame)
    assert bench.unit.count == 1


def test_the_last_eight_answers_are_remembered(bench):
    bench.ask("SYST:ARM")
    fire = bench.frame("FLAS:FIRE a1")
    first = bench.raw(fire)
    for _ in range(MAX_CACHED_REPLIES - 1):
        bench.ask("SYST:PING?")
    assert bench.raw(fire) == first
    assert bench.unit.count == 1


def test_a_number_with_another_text_is_refused(bench):
    bench.ask("SYST:ARM")
    assert bench.reply("FLAS:POW 0.5", seq=bench.seq).code == Code.SEQ_REUSED
    assert bench.unit.power == 1.0


def test_old_line_does_nothing_whatever_its_number(bench):
    hello = bench.frame("SYST:HELLO?", boot=0)
    bench.raw(hello)
    old = [bench.frame("SYST:ARM"), bench.frame("FLAS:POW 0.5"), bench.frame("FLAS:FIRE a1")]
    for line in old:
        bench.raw(line)
    for _ in range(2 * MAX_CACHED_REPLIES):
        bench.wait(0.2)
    bench.say(["FLAS:POW 1", "SAFE"])
    for line in [hello, *old, hello, *reversed(old)]:
        answer = wire.decode(bench.raw(line).rstrip())
        assert answer.code == (Code.OK if line == hello else Code.SEQ_REUSED)
    assert (bench.unit.power, bench.unit.count, bench.box.armed) == (1.0, 1, False)
    bench.ask("SYST:ARM")


def test_number_counts_on_after_two_to_the_32(bench):
    bench.seq = wire.MAX_SEQ - 1
    bench.ask("SYST:ARM")
    bench.seq = -1
    assert bench.code("SYST:PING?") == Code.OK
    assert bench.reply("FLAS:POW 0.5", seq=wire.MAX_SEQ - 9).code == Code.SEQ_REUSED


def test_hello_of_another_host_begins_its_numbers(bench):
    bench.seq = 2**31
    bench.ask("SYST:ARM")
    assert bench.reply("SYST:PING?", seq=5).code == Code.SEQ_REUSED
    assert bench.reply("SYST:HELLO?", seq=4, boot=0).code == Code.OK
    assert bench.reply("SYST:PING?", seq=5).code == Code.OK


def test_repeated_lines_do_not_renew_the_lease(bench):
    old = bench.frame("SYST:PING?")
    bench.raw(old)
    for _ in range(2 * MAX_CACHED_REPLIES):
        bench.ask("SYST:PING?")
    arm = bench.frame("SYST:ARM")
    bench.raw(arm)
    armed_s = bench.now
    for number in range(1, 6):
        bench.now = armed_s + 0.199 * number
        bench.raw(arm if number % 2 else old)
    assert bench.box.armed
    bench.now = armed_s + 1.0
    bench.raw(arm)
    assert not bench.box.armed


def test_safe_acts_whatever_its_number(bench):
    bench.seq = 500
    bench.ask("SYST:ARM")
    bench.ask("FLAS:LAMP ON,500")
    assert bench.reply("FLAS:LAMP ON,400", seq=3).code == Code.SEQ_REUSED
    assert bench.reply("SAFE", seq=3).code == Code.OK
    assert not bench.box.armed
    bench.ask("SYST:ARM")
    assert bench.reply("SAFE", seq=bench.seq - 1).code == Code.OK
    assert not bench.box.armed


def test_number_of_hello_is_used_up(bench):
    assert bench.reply("SYST:HELLO?", seq=2**31 + 5, boot=0).code == Code.OK
    assert bench.reply("SYST:ARM", seq=2**31 + 5).code == Code.SEQ_REUSED
    assert not bench.box.armed


def test_long_answer_displaces_no_kept_answer(bench):
    long = bench.frame("SYST:CAP?")
    bench.raw(long)
    ping = bench.frame("SYST:PING?")
    first = bench.raw(ping)
    for _ in range(2 * MAX_CACHED_REPLIES):
        bench.now += 0.01
        bench.raw(long)
    bench.now += 0.01
    assert bench.raw(ping) == first  # of the time before


def test_repeated_long_answer_does_not_renew_lease(bench):
    bench.ask("SYST:ARM")
    asked_s = bench.now
    long = bench.frame("SYST:CAP?")
    first = bench.raw(long)
    for number in range(1, 6):
        bench.now = asked_s + 0.199 * number
        assert bench.raw(long) == first  # too long to be kept, so made again
    bench.now = asked_s + 1.0
    bench.raw(long)
    assert not bench.box.armed


def test_a_refusal_is_repeated_too(bench):
    frame = bench.frame("FLAS:FIRE a1")
    first = bench.raw(frame)
    bench.ask("SYST:ARM")
    assert bench.raw(frame) == first
    assert bench.unit.count == 0


def test_frame_of_old_epoch_is_refused_with_new(bench):
    reply = bench.reply("FLAS:POW 0.5", boot=bench.box.boot ^ 1)
    assert (reply.code, reply.boot) == (Code.BOOT_CHANGED, bench.box.boot)
    assert bench.unit.power == 1.0


def test_hello_alone_needs_no_epoch(bench):
    assert bench.reply("SYST:HELLO?", boot=0).code == Code.OK
    assert bench.reply("*IDN?", boot=0).code == Code.BOOT_CHANGED


@pytest.mark.parametrize("damage", [b"@9", b"=1:0001 0*0000", b"FLAS:FIRE a*0000", b"@" * 600])
def test_damaged_frame_is_answered_by_unnumbered_event(bench, damage):
    event = wire.decode(bench.raw(damage + b"\n").rstrip())
    assert isinstance(event, Event)
    assert (event.name, event.payload) == ("NAK", "204")
    assert bench.ask("SYST:ERR?") == '0,"No error"'


def test_overlong_lines_are_dropped_without_an_answer(bench):
    assert bench.raw(b"@" + b"x" * 5000) == b""
    assert bench.raw(b"\n") == b""
    assert bench.ask("STAT?") == "0"


def test_errors_queue_up_to_sixteen_and_then_overflow(bench):
    for _ in range(MAX_QUEUED_ERRORS + 4):
        bench.code("NONSENSE")
    codes = [int(bench.ask("SYST:ERR?").split(",")[0]) for _ in range(MAX_QUEUED_ERRORS + 1)]
    assert codes == [Code.UNDEFINED_HEADER] * 15 + [Code.QUEUE_OVERFLOW, 0]


def test_cls_empties_queue_and_status_shows_empty(bench):
    bench.code("NONSENSE")
    assert bench.ask("STAT?") == "4"
    bench.ask("*CLS")
    assert bench.ask("STAT?") == "0"


# arming and lease -----------------------------------------------------------------------------


def test_silence_for_a_lease_makes_dark_and_disarms(bench):
    bench.ask("SYST:WDOG 300")
    bench.ask("SYST:ARM")
    bench.ask("FLAS:LAMP ON,500")
    assert bench.box.advance(1.2999) == b""
    assert bench.unit.lit
    event = wire.decode(bench.box.advance(1.3).rstrip())
    assert (event.name, event.payload) == ("WDOG:TRIP", "300")
    assert not bench.unit.lit
    assert bench.unit.lamp_times[-1] == pytest.approx((1.0, 1.3))
    bench.now = 1.4
    assert bench.code("FLAS:FIRE a") == Code.WATCHDOG_TRIPPED
    assert int(bench.ask("STAT?")) & 3 == 2
    bench.ask("SYST:ARM")
    bench.ask("FLAS:FIRE a")


@pytest.mark.parametrize("line", [b"STAT?\n", b"@1:9999 STAT?*0000\n", b"x" * 50 + b"\n", b""])
def test_only_valid_frames_renew_the_lease(bench, line):
    bench.ask("SYST:ARM")
    bench.now = 1.9
    bench.raw(line)
    bench.now = 2.1
    assert bench.ask("SYST:ARM?") == "0"


def test_valid_frames_renew_the_lease(bench):
    bench.ask("SYST:ARM")
    for k in range(1, 9):
        bench.now = 1.0 + 0.9 * k
        bench.ask("SYST:PING?")
    assert bench.ask("SYST:ARM?") == "1"


# flash ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("power", [1.0, 0.5, 0.125])
def test_tube_recycle_time_is_proportional_to_last_power(bench, power):
    bench.ask("SYST:ARM")
    bench.ask(f"FLAS:POW {power}")
    bench.ask("FLAS:FIRE a")
    bench.now = 1.0 + 1.5 * power - 0.001
    bench.ask("SYST:ARM")
    assert bench.code("FLAS:FIRE b") == Code.RECYCLE
    bench.now = 1.0 + 1.5 * power
    assert bench.code("FLAS:FIRE c") == Code.OK


def test_pops_per_minute_never_exceed_limit(bench):
    bench.ask("FLAS:POW 0.01")
    pops = []
    while bench.now < 130.0:
        bench.ask("SYST:ARM")
        code = bench.code("FLAS:FIRE a")
        assert code in (Code.OK, Code.DUTY)
        pops += [bench.now] if code == Code.OK else []
        bench.now += 0.5
    windows = [sum(start <= t < start + 60.0 for t in pops) for start in pops]
    assert max(windows) == RIG.max_pops_per_min


def test_charge_falls_by_power_recovers_within_recycle_time(bench):
    bench.ask("SYST:ARM")
    bench.ask("FLAS:POW 0.4")
    bench.ask("FLAS:FIRE a")
    assert bench.unit.charge(bench.now) == pytest.approx(0.6)
    rising = [bench.unit.charge(bench.now + t) for t in np.linspace(0.0, 1.5, 50)]
    assert all(b >= a for a, b in itertools.pairwise(rising))
    assert rising[-1] == 1.0


def test_charge_answer_reports_time_to_next_pop(bench):
    bench.ask("SYST:ARM")
    bench.ask("FLAS:FIRE a")
    _, ready, wait_ms = bench.ask("FLAS:CHAR?").split(",")
    assert (ready, wait_ms) == ("0", "1500")
    bench.now += int(wait_ms) / 1e3
    assert bench.ask("FLAS:CHAR?") == "1.0000,1,0"
    bench.ask("SYST:ARM")
    bench.ask("FLAS:FIRE b")


def test_slow_charger_delays_pop_beyond_recycle_time():
    bench = FLASH.bench(slow_charge=4.0)
    bench.ask("SYST:ARM")
    bench.ask("FLAS:FIRE a")
    bench.now += 2.0
    bench.ask("SYST:ARM")
    assert bench.code("FLAS:FIRE b") == Code.IGNORED
    bench.now += 4.0
    bench.ask("SYST:ARM")
    assert bench.code("FLAS:FIRE c") == Code.OK


def test_pop_is_ignored_while_analyzer_rotates(bench):
    bench.ask("SYST:ARM")
    bench.ask("FLAS:POL CROS")
    assert bench.ask("*OPC?") == "0"
    assert int(bench.ask("STAT?")) & 16
    assert bench.code("FLAS:FIRE a") == Code.IGNORED
    bench.now += RIG.polarizer_move_s
    assert bench.ask("*OPC?") == "1"
    assert bench.ask("FLAS:FIRE b").split(",")[3:5] == ["CROS", "90.000"]


def test_turning_time_is_in_proportion_to_the_angle(bench):
    bench.ask("FLAS:POL:ANG 45")
    bench.now += 0.5 * RIG.polarizer_move_s - 0.001
    assert bench.ask("*OPC?") == "0"
    bench.now += 0.002
    assert bench.ask("*OPC?") == "1"


def test_pop_informs_world_as_controller_reports(bench):
    bench.ask("SYST:ARM")
    bench.ask("FLAS:POL:ANG 30")
    bench.ask("FLAS:POW 0.25")
    bench.now = 1.5
    report = bench.ask("FLAS:FIRE n.7")
    assert report == "n.7,1500000,0.25000000,PAR,30.000,1"
    assert bench.ask("FLAS:LAST?") == report
    (pop,) = bench.world.pops
    assert (pop.token, pop.t_s, pop.power, pop.analyzer_deg) == ("n.7", 1.5, 0.25, 30.0)
    assert pop.polarizer == "parallel"


def test_misfire_is_hardware_error_without_light(bench):
    bench = FLASH.bench(misfire=1.0)
    bench.ask("SYST:ARM")
    assert bench.code("FLAS:FIRE a") == Code.HARDWARE
    assert (bench.world.pops, bench.unit.count) == ([], 0)


def test_an_open_emergency_stop_forbids_light():
    bench = FLASH.bench(interlock=True)
    bench.ask("SYST:ARM")
    assert bench.code("FLAS:FIRE a") == Code.INTERLOCK
    assert bench.code("FLAS:LAMP ON,10") == Code.INTERLOCK
    assert int(bench.ask("STAT?")) & 256


# X-sync ---------------------------------------------------------------------------------------


@pytest.fixture
def edges(bench):
    """Times of the pulses on the camera line."""
    seen = []
    bench.unit._on_trigger = seen.append
    return seen


def later(bench, text, seconds):
    """Send a command and return all that the box says up to `seconds` later."""
    said = bench.raw(bench.frame(text))
    bench.now += seconds
    return [wire.decode(line) for line in (said + bench.box.advance(bench.now)).splitlines()]


@pytest.mark.parametrize("delay_us", [1, 12_500, 50_000])
def test_pop_follows_camera_line_by_set_time(bench, edges, delay_us):
    bench.ask(f"FLAS:SYNC {delay_us}")
    bench.ask("SYST:ARM")
    assert bench.raw(bench.frame("FLAS:FIRE a")) == b""
    assert bench.box.advance(1.0 + 0.999e-6 * delay_us) == b""
    assert (edges, bench.world.pops) == ([1.0], [])
    reply = wire.decode(bench.box.advance(1.0 + 1e-6 * delay_us).rstrip())
    assert reply.payload == f"a,{1_000_000 + delay_us},1.00000000,PAR,0.000,1"
    assert [pop.t_s for pop in bench.world.pops] == [pytest.approx(1.0 + 1e-6 * delay_us)]


def test_retry_before_delayed_pop_is_answered_once_after(bench, edges):
    bench.ask("FLAS:SYNC 40000")
    bench.ask("SYST:ARM")
    frame = bench.frame("FLAS:FIRE a")
    assert bench.raw(frame) == bench.raw(b"\n" + frame) == b""
    assert bench.reply("FLAS:POW 0.5", seq=bench.seq).code == Code.SEQ_REUSED
    bench.now = 1.05
    (answer,) = bench.box.advance(bench.now).splitlines()
    assert bench.raw(frame).rstrip() == answer
    assert (edges, bench.unit.count) == ([1.0], 1)


@pytest.mark.parametrize("word", ["SAFE", "*RST"])
def test_dark_command_prevents_delayed_pop(bench, edges, word):
    bench.ask("FLAS:SYNC 40000")
    bench.ask("SYST:ARM")
    fire = bench.frame("FLAS:FIRE a")
    bench.raw(fire)
    bench.now = 1.02
    bench.ask(word)
    bench.now = 1.2
    reply = wire.decode(bench.box.advance(bench.now).rstrip())
    assert reply.code == Code.HARDWARE
    assert (edges, bench.world.pops, bench.unit.count) == ([1.0], [], 0)
    assert wire.decode(bench.raw(fire).rstrip()) == reply


def test_second_pop_is_ignored_while_first_is_pending(bench, edges):
    bench.ask("FLAS:SYNC 40000")
    bench.ask("SYST:ARM")
    bench.raw(bench.frame("FLAS:FIRE a"))
    bench.now = 1.01
    assert bench.code("FLAS:FIRE b") == Code.IGNORED
    ready, wait_ms = bench.ask("FLAS:CHAR?").split(",")[1:]
    assert (ready, int(wait_ms) - 30 in (0, 1)) == ("0", True)  # rounded up
    assert edges == [1.0]


def test_delayed_misfire_is_reported_when_detected():
    bench = FLASH.bench(misfire=1.0)
    bench.ask("FLAS:SYNC 30000")
    bench.ask("SYST:ARM")
    (reply,) = later(bench, "FLAS:FIRE a", 0.03)
    assert (reply.code, bench.world.pops) == (Code.HARDWARE, [])


def test_lamp_lit_before_delayed_pop_is_out_then(bench):
    bench.ask("FLAS:SYNC 40000")
    bench.ask("SYST:ARM")
    bench.raw(bench.frame("FLAS:FIRE a"))
    bench.now = 1.01
    bench.ask("FLAS:LAMP ON,500")
    bench.now = 1.1
    bench.box.advance(bench.now)
    assert bench.unit.lamp_times[-1] == pytest.approx((1.01, 1.04))
    assert bench.unit.count == 1


# lamps ----------------------------------------------------------------------------------------


def test_a_lamp_carries_its_own_end(bench):
    bench.ask("SYST:ARM")
    bench.ask("FLAS:LAMP ON,200")
    bench.box.advance(1.1999)
    assert bench.unit.lit
    bench.box.advance(1.2)
    assert not bench.unit.lit


def test_lamp_renews_switches_off_and_ends_before_pop(bench):
    bench.ask("SYST:ARM")
    bench.ask("FLAS:LAMP ON,200")
    bench.now = 1.1
    bench.ask("FLAS:LAMP ON,200")
    bench.box.advance(1.25)
    bench.now = 1.25
    assert bench.ask("FLAS:LAMP?") == "1"
    bench.ask("FLAS:LAMP OFF")
    assert bench.ask("FLAS:LAMP?") == "0"
    bench.ask("FLAS:LAMP ON,200")
    bench.ask("FLAS:FIRE a")
    assert bench.ask("FLAS:LAMP?") == "0"


def test_lamp_kept_on_trips_on_heat_and_recovers(bench):
    bench.ask("SYST:ARM")
    start = bench.now
    while bench.code("FLAS:LAMP ON,500") == Code.OK:
        bench.now += 0.4
        bench.box.advance(bench.now)
    # 0.8 of the final temperature: tau ln 5 = 32.2 s
    assert bench.now - start == pytest.approx(32.2, abs=0.5)
    assert bench.code("FLAS:LAMP ON,500") == Code.THERMAL
    assert int(bench.ask("STAT?")) & 128
    # down to 0.5: tau ln(0.8 / 0.5) = 9.4 s
    bench.now += 9.5
    bench.ask("SYST:ARM")
    assert bench.code("FLAS:LAMP ON,500") == Code.OK


@pytest.mark.parametrize(
    ("fault", "code"), [({"lamp_dead": True}, Code.HARDWARE), ({"heat": 0.9}, Code.THERMAL)]
)
def test_a_dead_or_hot_lamp_is_named(fault, code):
    bench = FLASH.bench(**fault)
    bench.ask("SYST:ARM")
    assert bench.code("FLAS:LAMP ON,100") == code
    assert not bench.unit.lit


# power ----------------------------------------------------------------------------------------


def test_reset_changes_epoch_clears_settings_and_keeps_count(bench):
    bench.ask("SYST:ARM")
    bench.ask("FLAS:FIRE a")
    bench.ask("FLAS:POW 0.5")
    before = bench.box.boot
    bench.box.power_cycle(bench.now, boot_s=0.8, announce=False)
    assert bench.bare("*IDN?") == b""
    bench.now += 0.8
    assert bench.box.boot not in (before, 0)
    assert [bench.ask(q) for q in ("FLAS:POW?", "SYST:ARM?", "FLAS:COUN?", "FLAS:LAST?")] == [
        "1.00000000",
        "0",
        "1",
        "NONE",
    ]
    assert bench.ask("SYST:PING?") == "800000"


def test_announced_reset_prints_banner_and_event(bench):
    bench.box.power_cycle(bench.now, boot_s=0.8, announce=True)
    banner, line = bench.box.advance(1.8).splitlines()
    assert banner == b"FLASH2 1.0 ready"
    assert wire.decode(line) == Event(0, bench.box.boot, "BOOT", "POWER")


def test_a_reset_does_not_charge_or_cool_anything(bench):
    bench.ask("SYST:ARM")
    bench.ask("FLAS:FIRE a")
    bench.box.power_cycle(bench.now, boot_s=0.1, announce=False)
    bench.now += 0.2
    bench.ask("SYST:ARM")
    assert bench.code("FLAS:FIRE b") == Code.RECYCLE


def test_led_lights_next_pop_only(bench):
    bench.ask("SYST:ARM")
    bench.ask("FLAS:LED 590,20")
    assert bench.ask("FLAS:LED?") == "LED-590-20"
    assert bench.ask("FLAS:FIRE a").split(",")[-1] == "LED-590-20"
    bench.now += 60.0 / RIG.max_pops_per_min
    bench.ask("SYST:ARM")
    assert bench.ask("FLAS:LED?") == "TUBE"
    assert len(bench.ask("FLAS:FIRE b").split(",")) == 6
    assert [pop.led for pop in bench.world.pops] == ["LED-590-20", ""]


def test_dark_returns_to_tube(bench):
    bench.ask("FLAS:LED 450,12")
    bench.ask("SAFE")
    assert bench.ask("FLAS:LED?") == "TUBE"
