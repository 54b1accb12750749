import pytest

from skinrig import errors


class DeviceError(Exception):
    __module__ = "capture.devices.port"


class StoreError(ValueError):
    __module__ = "model.store"


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (KeyboardInterrupt(), errors.EXIT_INTERRUPTED),
        (DeviceError("box silent"), errors.EXIT_DEVICE_FAILED),
        (StoreError("bad hash"), errors.EXIT_BAD_INPUT),
        (FileNotFoundError(2, "No such file", "x"), errors.EXIT_BAD_INPUT),
        (errors.MissingExtra("this", "usd"), errors.EXIT_EXTRA_MISSING),
        (ZeroDivisionError("division by zero"), errors.EXIT_BUG),
    ],
)
def test_each_kind_of_failure_has_its_exit_code(error, code):
    assert errors.exit_code(error) == code


def test_internal_fault_is_admitted_in_single_line():
    text = errors.format_error(ZeroDivisionError("division by zero"))
    assert "defect of skinrig" in text
    assert "\n" not in text


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (FileNotFoundError(2, "No such file or directory", "a.ply"), "check the name"),
        (FileExistsError(17, "File exists", "out"), "name another"),
        (NotADirectoryError(20, "Not a directory", "file/out"), "expected a folder"),
        (IsADirectoryError(21, "Is a directory", "out"), "expected a file"),
        (PermissionError(13, "Permission denied", "out"), "permission"),
        (OSError(30, "Read-only file system", "out"), "name another"),
        (OSError(28, "No space left on device", "out"), "free space"),
    ],
)
def test_system_refusal_is_reported_with_file_and_remedy(error, words):
    text = errors.format_error(error)
    assert text.startswith(f"{error.filename}: {error.strerror}")
    assert words in text


def test_non_text_file_is_reported_without_codec_terms():
    with pytest.raises(UnicodeDecodeError) as caught:
        b"ok\xff".decode()
    assert errors.format_error(caught.value) == (
        "text file: got byte 0xff at 2, expected UTF-8; check that it is the right file "
        "[SR-CLI-009]"
    )


def test_full_disk_without_file_is_reported_without_errno():
    text = errors.format_error(OSError(28, "No space left on device"))
    assert text.startswith("No space left on device; free space")


def test_wrapped_error_has_one_code_at_end():
    inner = ValueError("left: no file; name another [SR-IMP-000]")
    assert errors.format_error(ValueError(f"views: {inner}; repair it")) == (
        "views: left: no file; name another; repair it [SR-IMP-000]"
    )
    both = errors.format_error(ValueError(f"views: {inner}; repair it [SR-REC-000]"))
    assert both == "views: left: no file; name another; repair it [SR-REC-000]"
    assert errors.message_code(both) == "SR-REC-000"


def test_message_code_is_none_without_code_at_end():
    assert errors.message_code("left: no file; name another") is None
    assert errors.message_code("[SR-IMP-000] left: no file") is None
