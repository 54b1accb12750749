"""Exceptions of instrument drivers."""


class DeviceError(Exception):
    """Base class of the exceptions that drivers raise about an instrument."""


class PortUrlError(DeviceError, ValueError):
    """Raised for a URL that does not lead to an instrument."""


class LinkLost(DeviceError, ConnectionError):
    """Raised when the port cannot be opened or is lost; the last command may have been done."""


class PortBusy(LinkLost):
    """Raised when another program uses the port."""


class PortTimeout(DeviceError, TimeoutError):
    """Raised when no answer came despite retries; the command may have been executed."""


class BoxRebooted(DeviceError, ConnectionResetError):
    """Raised after a reboot of the controller: it is dark, disarmed and has lost its settings."""


class WrongDevice(DeviceError, ValueError):
    """Raised when the URL leads to another device, or to another protocol version."""


class BadAnswer(DeviceError, ValueError):
    """Raised for a well-framed answer whose content does not follow the protocol."""


class CommandRefused(DeviceError, RuntimeError):
    """Raised when the controller refused a command and did nothing.

    Attributes
    ----------
    code
        Reason, see `capture.devices.wire.Code`.
    text
        Command that was refused.
    """

    def __init__(self, text: str, code: int, reason: str) -> None:
        super().__init__(
            f"{text!r} was refused with {code}: {reason}; nothing was done: remove the cause of "
            f"{code} [SR-CAP-006]"
        )
        self.text = text
        self.code = code
