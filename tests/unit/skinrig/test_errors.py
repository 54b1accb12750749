import pytest

from skinrig import errors


class DeviceError(Exception):
    __module__ = "capture.devices.port"


class StoreError(ValueError):
    __module__ = "model.store"


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (KeyboardInterrupt(), errors.INTERRUPTED),
        (DeviceError("box silent"), errors.DEVICE_FAILED),
        (StoreError("bad hash"), errors.BAD_INPUT),
        (FileNotFoundError(2, "No such file", "x"), errors.BAD_INPUT),
        (errors.MissingExtra("this", "usd"), errors.EXTRA_MISSING),
        (ZeroDivisionError("division by zero"), errors.BUG),
    ],
)
def test_each_kind_of_failure_has_its_exit_code(error, code):
    assert errors.exit_code(error) == code


def test_a_fault_of_ours_is_owned_up_to_in_one_line():
    text = errors.sentence(ZeroDivisionError("division by zero"))
    assert "fault of skinrig" in text
    assert "\n" not in text
