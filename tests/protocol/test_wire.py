"""The line format, byte by byte."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from capture.devices import wire
from capture.devices.wire import BadFrame, Code, Event, Reply, Request, decode, encode

FRAMES = [
    (Request(1, 0, "SYST:HELLO?"), b"@1:0000 SYST:HELLO?*9A6F\n"),
    (Request(17, 0x9F3A, "FLAS:FIRE a1"), b"@17:9f3a FLAS:FIRE a1*68AB\n"),
    (Request(0, 0xFFFF, "*IDN?"), b"@0:ffff *IDN?*9DF4\n"),
    (Reply(17, 0x9F3A, Code.OK), b"=17:9f3a 0*6853\n"),
    (Reply(17, 0x9F3A, Code.NOT_ARMED, "not armed"), b"=17:9f3a -203 not armed*DCBF\n"),
    (Reply(4294967295, 1, Code.RECYCLE, "600 ms"), b"=4294967295:0001 103 600 ms*DE43\n"),
    (Event(0, 0x9F3A, "WDOG:TRIP"), b"!0:9f3a WDOG:TRIP*CE95\n"),
    (Event(3, 0x9F3A, "NAK", "204"), b"!3:9f3a NAK 204*E936\n"),
]

printable = st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=200)
numbers = st.integers(0, 2**32 - 1)
epochs = st.integers(0, 0xFFFF)
frames = st.one_of(
    st.builds(Request, numbers, epochs, printable.filter(bool)),
    st.builds(Reply, numbers, epochs, st.integers(-9999, 9999), printable),
    st.builds(Event, numbers, epochs, st.from_regex(r"[A-Z][A-Z0-9:]{0,31}", fullmatch=True)),
)


@pytest.mark.parametrize(("frame", "line"), FRAMES)
def test_each_frame_has_its_bytes(frame, line):
    assert encode(frame) == line
    assert decode(line[:-1]) == frame


def test_checksum_is_ibm_3740_bit_by_bit():
    data = b"@17:9f3a SEQ:ARM 150"
    register = 0xFFFF
    for byte in data:
        register ^= byte << 8
        for _ in range(8):
            register = (register << 1) ^ 0x1021 if register & 0x8000 else register << 1
            register &= 0xFFFF
    assert wire.crc16(data) == register
    assert wire.crc16(b"123456789") == 0x29B1


@given(frames)
def test_decode_returns_encoded_frame(frame):
    assert decode(encode(frame)[:-1]) == frame


@given(st.binary(max_size=80))
def test_line_that_decodes_encodes_identically(line):
    try:
        frame = decode(line)
    except BadFrame:
        return
    assert encode(frame)[:-1] == line


@given(printable)
def test_sealed_line_that_decodes_encodes_identically(body):
    line = wire.seal(body).encode()
    try:
        frame = decode(line)
    except BadFrame:
        return
    assert encode(frame)[:-1] == line


@pytest.mark.parametrize(
    "body",
    [
        "17:9f3a FLAS:FIRE a1",  # no mark
        "@017:9f3a FLAS:FIRE a1",  # leading zero
        "@-1:9f3a FLAS:FIRE a1",
        "@4294967296:9f3a FLAS:FIRE a1",  # beyond 32 bits
        "@17:9F3A FLAS:FIRE a1",  # upper-case epoch
        "@17:9f3 FLAS:FIRE a1",
        "@17:9f3a",
        "@17:9f3a ",
        "=17:9f3a ok",
        "=17:9f3a -0",
        "=17:9f3a 0 ",  # second encoding of an empty payload
        "=17:9f3a 10000",
        "!1:9f3a nak",
        "!1:9f3a NAK ",
    ],
)
def test_a_second_spelling_of_a_frame_is_refused(body):
    with pytest.raises(BadFrame):
        decode(wire.seal(body).encode())


@pytest.mark.parametrize(("_frame", "line"), FRAMES)
def test_every_single_and_double_bit_flip_is_noticed(_frame, line):
    bits = np.unpackbits(np.frombuffer(line[:-1], np.uint8))
    pairs = [(i, j) for i in range(bits.size) for j in range(i, bits.size)]
    for i, j in pairs[:: max(1, len(pairs) // 3000)]:
        flipped = bits.copy()
        flipped[[i, j]] ^= 1
        with pytest.raises(BadFrame):
            decode(np.packbits(flipped).tobytes())


@pytest.mark.parametrize(("_frame", "line"), FRAMES)
def test_every_lost_byte_is_noticed(_frame, line):
    for i in range(len(line) - 1):
        with pytest.raises(BadFrame):
            decode(line[:i] + line[i + 1 : -1])


def test_a_lower_case_checksum_is_refused():
    with pytest.raises(BadFrame):
        decode(b"@17:9f3a FLAS:FIRE a1*68ab")


def test_longest_line_passes_and_longer_is_refused():
    room = wire.MAX_LINE_BYTES - len(encode(Request(1, 1, "x"))) + 1
    longest = encode(Request(1, 1, "x" * room))
    assert len(longest) == wire.MAX_LINE_BYTES
    assert wire.LineSplitter().feed(longest) == [longest[:-1]]
    assert decode(longest[:-1]) == Request(1, 1, "x" * room)
    with pytest.raises(ValueError, match="1025 bytes"):
        encode(Request(1, 1, "x" * (room + 1)))


@pytest.mark.parametrize("text", ["", "a\nb", "caf\xe9", "\x7f"])
def test_a_request_holds_printable_ascii_only(text):
    with pytest.raises(ValueError, match="text"):
        Request(1, 1, text)


@pytest.mark.parametrize(("seq", "boot"), [(-1, 1), (2**32, 1), (1, -1), (1, 0x10000)])
def test_numbers_out_of_their_field_are_refused(seq, boot):
    with pytest.raises(ValueError, match="expected 0 to"):
        Request(seq, boot, "*IDN?")


def test_the_sequence_number_starts_again_after_32_bits():
    assert wire.next_seq(2**32 - 1) == 0
    assert wire.next_seq(0) == 1


@given(st.lists(st.binary(max_size=12).map(lambda b: b.replace(b"\r", b"")), max_size=8))
def test_lines_are_independent_of_stream_splitting(pieces):
    whole = b"".join(pieces)
    splitter = wire.LineSplitter()
    in_pieces = [line for piece in pieces for line in splitter.feed(piece)]
    assert in_pieces == wire.LineSplitter().feed(whole)
    assert in_pieces == [line for line in whole.split(b"\n")[:-1] if line]


def test_overlong_garbage_is_dropped_up_to_newline():
    splitter = wire.LineSplitter()
    assert splitter.feed(b"x" * 1023) == []
    assert splitter.feed(b"x") == []
    assert splitter.feed(b"x" * 5000 + b"\n*IDN?\n") == [b"*IDN?"]
    assert splitter.overlong_lines == 1


def test_a_terminal_may_send_carriage_returns():
    assert wire.LineSplitter().feed(b"*IDN?\r\nSTAT?\n") == [b"*IDN?", b"STAT?"]


@pytest.mark.parametrize(
    ("line", "meant"),
    [(b"@17:9f3a FLAS", True), (b"7:9f3a FLAS:FIRE a*68AB", True), (b"*IDN?", False)],
)
def test_damaged_frame_differs_from_bare_line(line, meant):
    assert wire.is_frame_like(line) is meant


@pytest.mark.parametrize("code", [-10_000, 10_000])
def test_reply_code_outside_four_digits_is_refused(code):
    assert Reply(1, 0, 9999).code == -Reply(1, 0, -9999).code
    with pytest.raises(ValueError, match="-9999 to 9999"):
        Reply(1, 0, code)


@pytest.mark.parametrize("name", ["", "trip", "WDOG!"])
def test_event_name_is_upper_case(name):
    with pytest.raises(ValueError, match="upper-case words"):
        Event(1, 0, name)


def test_half_of_all_numbers_is_behind():
    """2^31 numbers are behind the latest one, and as many are not, itself among them."""
    for latest in (0, 5, 2**31, 2**32 - 1):
        for ahead in (0, 1, 2**31 - 1):
            assert not wire.is_behind((latest + ahead) % 2**32, latest)
        for behind in (1, 2**31 - 1, 2**31):
            assert wire.is_behind((latest - behind) % 2**32, latest)


@pytest.mark.parametrize(
    ("kind", "good"),
    [
        (Request, {"seq": 0, "boot": 0, "text": "STAT?"}),
        (Reply, {"seq": 2**32 - 1, "boot": 0xFFFF, "code": 0, "payload": "x"}),
        (Event, {"number": 0, "boot": 1, "name": "NAK", "payload": "x"}),
    ],
)
def test_each_frame_checks_each_field(kind, good):
    """Also frames that no line has brought, so that none is sent that decoding refuses."""
    frame = kind(**good)
    assert decode(encode(frame)[:-1]) == frame
    number, text = next(iter(good)), list(good)[-1]
    wrong = [(number, 2**32), (number, -1), ("boot", 0x10000), ("boot", -1)]
    for field, value in [*wrong, (text, "\x1f"), (text, "\x7f"), (text, "a\xe9")]:
        with pytest.raises(ValueError, match=f"^{field}: got "):
            kind(**good | {field: value})
    assert kind(**good | {text: " ~"})


def test_line_without_end_is_shorter_than_limit():
    """With its newline it has 1024 bytes; one byte more is refused before it is decoded."""
    for size, refused in ((wire.MAX_LINE_BYTES - 1, False), (wire.MAX_LINE_BYTES, True)):
        text = "@1:0001 "
        line = wire.seal(text + "x" * (size - len(text) - 5)).encode()
        assert len(line) == size
        if refused:
            with pytest.raises(BadFrame, match="line: got 1024 bytes, expected fewer than 1024"):
                decode(line)
        else:
            assert decode(line).seq == 1


@pytest.mark.parametrize("byte", [0x00, 0x0A, 0x1F, 0x7F, 0x80, 0xFF])
def test_byte_outside_ascii_is_named_before_checksum(byte):
    with pytest.raises(BadFrame, match="line: got a byte outside printable ASCII"):
        decode(b"@17:9f3a FLAS" + bytes([byte]) + b"*0000")


@pytest.mark.parametrize(
    ("sealed", "text"),
    [
        ("SAFE", "checksum: got 'SAFE' at the end, expected"),
        ("SAFE*12G4", r"checksum: got '\*12G4' at the end, expected"),
        ("*IDN?*0000", "checksum: got 0000, expected "),
        ("caf\xe9*0000", "checksum: got 0000, expected "),
    ],
)
def test_broken_seal_is_named(sealed, text):
    with pytest.raises(BadFrame, match=text):
        wire.unseal(sealed)
    assert wire.unseal(wire.seal("*IDN?")) == "*IDN?"


@pytest.mark.parametrize(("begun", "overlong"), [(b"*ID", 0), (b"x" * 2000, 1)])
def test_cleared_splitter_begins_a_line(begun, overlong):
    splitter = wire.LineSplitter()
    assert splitter.feed(begun) == []
    splitter.clear()
    assert splitter.feed(b"STAT?\n") == [b"STAT?"]
    assert splitter.overlong_lines == overlong


def test_overlong_lines_are_counted_one_by_one():
    splitter = wire.LineSplitter()
    assert splitter.overlong_lines == 0
    assert splitter.feed(b"x" * 1023 + b"\n" + b"x" * 1024 + b"\n*IDN?\n") == [
        b"x" * 1023,
        b"*IDN?",
    ]
    for _ in range(3):
        assert splitter.feed(b"y" * 700) == []
    assert splitter.feed(b"\n\r\n\nSTAT?\r\n") == [b"STAT?"]
    assert splitter.overlong_lines == 2


def test_frame_without_text_after_head_is_refused():
    for body in ("=1:0001 ", "!1:0001 ", "=1:0001 -", "!1:0001 9A", "=1:0001 5x"):
        with pytest.raises(BadFrame, match="after seq:boot, expected a code or a name"):
            decode(wire.seal(body).encode())
    with pytest.raises(BadFrame, match="expected '@', '=' or '!', seq:boot and a text"):
        decode(wire.seal("#1:0001 x").encode())
    with pytest.raises(BadFrame, match="text: got '', expected a command"):
        decode(wire.seal("@1:0001 ").encode())
