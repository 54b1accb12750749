"""Errors that devices raise."""


class DeviceError(Exception):
    """Root of what drivers raise about a device."""


class PortUrlError(DeviceError, ValueError):
    """The URL names no way to reach a device."""


class LinkLost(DeviceError, ConnectionError):
    """The port cannot be opened, or is gone; whether the last act was done is not known."""


class PortBusy(LinkLost):
    """Another program holds the port."""


class PortTimeout(DeviceError, TimeoutError):
    """No answer in spite of retries; whether the act was done is not known."""


class BoxRebooted(DeviceError, ConnectionResetError):
    """The box started again: it is dark, disarmed and has forgotten its settings."""


class WrongDevice(DeviceError, ValueError):
    """Behind the URL is another device, or one that speaks another version."""


class BadAnswer(DeviceError, ValueError):
    """A well-framed answer whose content is not what the manual says."""


class CommandRefused(DeviceError, RuntimeError):
    """The box refused and did nothing.

    Attributes
    ----------
    code
        Why, see `capture.devices.wire.Code`.
    text
        The command.
    """

    def __init__(self, text: str, code: int, reason: str) -> None:
        super().__init__(f"{text!r} was refused with {code}: {reason}; nothing was done")
        self.text = text
        self.code = code
