"""The images after a hang, a brown-out and a loss of power: dark, disarmed, with a new epoch."""

import contextlib
import shutil
import subprocess

import pytest
from fixtures.compiled.library import FIRMWARE
from fixtures.compiled.targets import run_mega2560, run_qemu, start_target

from capture.devices.checkup import CheckupPort
from capture.devices.port import BoxRebooted
from capture.devices.wire import encode

# pyserial leaves ports to the collector
pytestmark = [
    pytest.mark.long,
    pytest.mark.timeout(120),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]
HANGS = {
    "flash": ("boxes/flash.c", "COMMAND(get_flas_coun) {", "FLAS:COUN?"),
    "dome": ("boxes/led_sequencer.c", "COMMAND(get_safe_eyes) {", "SAFE:EYES?"),
}
"""By box, a query in which a planted hang begins."""
WATCHDOG_LEAST_S, WATCHDOG_S = 0.1, 0.14
"""The watchdog's 0.125 s, and its oscillator's 10 %."""
EPOCH_FACTOR, EPOCH_SHIFT = 40503, 0x9E37
STAGES = {
    "idle": ("SAFE",),
    "armed": ("SYST:ARM",),
    "lamp": ("SYST:ARM", "FLAS:LAMP ON,500"),
    "pop is coming": ("SYST:ARM", "FLAS:SYNC 50000", "FLAS:FIRE x"),
    "charging": ("SYST:ARM", "FLAS:SYNC 0", "FLAS:FIRE y"),
}


def hanging_image(folder, image):
    """Build an image that hangs in a query; skip by name as `start_target` does."""
    box = image.partition(".")[0].partition("-")[2]
    file, text, query = HANGS[box]
    root = folder / "firmware"
    shutil.copytree(FIRMWARE, root)
    path = root / file
    source = path.read_text("utf-8")
    assert source.count(text) == 1
    path.write_text(source.replace(text, text + "\n  for (;;) {\n  }"), "utf-8")
    made = folder / "images" / image
    subprocess.run(
        ["make", "-s", "-C", str(root), f"OUT={made.parent}", str(made)],
        check=True,
        capture_output=True,
    )
    return made, query


def starts_of(boot):
    """Return the EEPROM's count of starts, of which an epoch is made."""
    return (boot - EPOCH_SHIFT) * pow(EPOCH_FACTOR, -1, 2**16) % 2**16


def hang(port, query):
    """Ask what is never answered."""
    assert port.exchange_raw(port_frame(port, query), 0.0) == []


def port_frame(port, text):
    return encode(port.make_request(text))


def wait_for_hello(port):
    """Return the epoch once the box answers again."""
    return port.hello().boot


def light_pins(target):
    """Return the levels of the pins of the pop and of the lamp."""
    return [target.of_pin(pin)[-1].value for pin in ("A1", "A3")]


def test_watchdog_resets_hung_chip_into_darkness(tmp_path):
    start_target("mega2560", "flash").close()
    image, query = hanging_image(tmp_path, "mega2560-flash.elf")
    target = run_mega2560(image)
    with contextlib.closing(target), CheckupPort(target.url, timeout_s=0.5) as port:
        before = port.hello().boot
        port.ask("SYST:ARM")
        port.ask("FLAS:LAMP ON,500")
        hang(port, query)
        on = target.of_pin("A3", 1.0)[0]
        target.wait_for(lambda: target.of_pin("A3")[-1].value == 0.0)
        off = target.of_pin("A3")[-1]
        asked_s = 0.06  # between the lamp and the query
        assert WATCHDOG_LEAST_S < off.t_s - on.t_s < WATCHDOG_S + asked_s
        boot = wait_for_hello(port)
        assert starts_of(boot) == starts_of(before) + 1
        assert port.ask("SYST:ARM?") == "0"


def test_brown_out_at_each_stage_leaves_darkness():
    target = start_target("mega2560", "flash")
    with contextlib.closing(target), CheckupPort(target.url, timeout_s=0.5) as port:
        starts = starts_of(port.hello().boot)
        for stage, texts in STAGES.items():
            for text in texts[:-1]:
                port.ask(text)
            port.exchange_raw(port_frame(port, texts[-1]), 0.02)
            target.command("b")
            with pytest.raises(BoxRebooted):
                port.listen(1.0)
            made = len(target.of_pin("A1"))
            boot = wait_for_hello(port)
            assert starts_of(boot) == (starts := starts + 1), stage
            assert light_pins(target) == [0.0, 0.0], stage
            assert port.ask("SYST:ARM?") == "0"
            assert port.ask("FLAS:COUN?") == "0"
            port.listen(0.08)  # longer than a pop could still be coming
            assert len(target.of_pin("A1")) == made, stage


def test_epoch_rises_beyond_loss_of_power(tmp_path):
    starts = []
    for _ in range(3):
        target = start_target("mega2560", "flash", options=(tmp_path / "eeprom",))
        with contextlib.closing(target), CheckupPort(target.url, timeout_s=0.5) as port:
            starts.append(starts_of(port.hello().boot))
    assert starts == [starts[0], starts[0] + 1, starts[0] + 2]


CORTEX = {"mps2-an385": "m3-flash.elf", "mps2-an500": "m7-dome.elf"}


@pytest.mark.parametrize("machine", CORTEX)
def test_watchdog_resets_hung_cortex(machine, tmp_path):
    image = CORTEX[machine]
    start_target(machine, image[3:-4]).close()
    image, query = hanging_image(tmp_path, image)
    target = run_qemu(machine, image)
    with contextlib.closing(target), CheckupPort(target.url, timeout_s=0.5) as port:
        before = port.hello().boot
        port.ask("SYST:ARM")
        hang(port, query)
        target.wait_for(lambda: len(target.of_pin("start")) >= 2)
        assert wait_for_hello(port) != before
        assert port.ask("SYST:ARM?") == "0"


@pytest.mark.parametrize("machine", CORTEX)
def test_brown_out_of_cortex_is_not_modeled(machine):
    pytest.skip(f"brown-out on {machine}: QEMU models neither supply voltage nor pins in a reset")
