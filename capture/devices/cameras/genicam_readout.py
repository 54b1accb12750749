"""Configure an industrial camera for raw values with known levels, trigger and clock.

The values of a configured camera depend on light, exposure time and gain alone. Cameras without a
raw format, known levels, a trigger or a readable clock are rejected, because none of their frames
could be accepted.
"""

import math
from dataclasses import dataclass
from urllib.parse import parse_qsl

from capture.devices.camera import CameraError, CameraInfo, CameraUrlError, Trigger
from capture.devices.cameras import pixel_format
from capture.devices.cameras.genicam_producer import Features
from capture.devices.cameras.pixel_format import PixelFormat

BASE_ISO = 100
"""ISO value of a gain of 0 dB when the address gives none."""


@dataclass(frozen=True, slots=True)
class Address:
    """Parsed form of ``genicam:SERIAL?NAME=VALUE&...``.

    Attributes
    ----------
    serial
        Serial number of the camera.
    producer
        File or folder of the GenTL producer; empty: from GENICAM_GENTL64_PATH.
    pixel_format
        Camera's name of the format; empty: the raw format with the most bits.
    line
        Trigger input; empty: the present setting of the camera, or its first input.
    iso
        ISO value of a gain of 0 dB, above 0.
    black
        Level without light, DN; None: from the camera's BlackLevel.
    """

    serial: str
    producer: str = ""
    pixel_format: str = ""
    line: str = ""
    iso: int = BASE_ISO
    black: float | None = None

    @property
    def url(self) -> str:
        """The address without its query."""
        return f"genicam:{self.serial}"


def parse_address(rest: str) -> Address:
    """Parse the part of an address after ``genicam:``.

    Raises
    ------
    CameraUrlError

    Examples
    --------
    >>> parse_address("40012345?format=BayerRG12&line=Line1&black=64").pixel_format
    'BayerRG12'
    """
    serial, _, query = rest.partition("?")
    expected = (
        f"genicam:{rest}: expected genicam:SERIAL, then optionally ?producer=FILE.cti, "
        "format=NAME, line=NAME, iso=NUMBER, black=DN, joined by &"
    )
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query))
        words = dict(pairs)
        iso, black = int(words.pop("iso", BASE_ISO)), words.pop("black", None)
        address = Address(
            serial,
            producer=words.pop("producer", ""),
            pixel_format=words.pop("format", ""),
            line=words.pop("line", ""),
            iso=iso,
            black=None if black is None else float(black),
        )
    except ValueError as error:
        raise CameraUrlError(f"{expected}; got {query!r}") from error
    black_good = address.black is None or (math.isfinite(address.black) and address.black >= 0)
    twice = len({name for name, _ in pairs}) < len(pairs)
    if not serial or words or twice or "" in dict(pairs).values() or iso <= 0 or not black_good:
        raise CameraUrlError(f"{expected}; got {rest!r}")
    if address.pixel_format and pixel_format.parse_pixel_format(address.pixel_format) is None:
        raise CameraUrlError(
            f"{expected}; format: got {address.pixel_format!r}, expected a raw one such as "
            "BayerRG12, BayerRG12p or Mono16"
        )
    return address


_DN_UNITS = ("dn", "lsb", "adu", "count", "counts", "digital number")

# features that would make values or times depend on anything else, where a camera has them
_RAW_SETTINGS = (
    ("TriggerSelector", "FrameStart"),
    ("AcquisitionMode", "Continuous"),
    ("AcquisitionFrameRateEnable", False),
    ("ExposureMode", "Timed"),
    ("ExposureAuto", "Off"),
    ("GainAuto", "Off"),
    ("BlackLevelAuto", "Off"),
    ("BalanceWhiteAuto", "Off"),
    ("GammaEnable", False),
    ("LUTEnable", False),
)


@dataclass(frozen=True, slots=True)
class Readout:
    """Settings of a camera that do not change, and the names of its features.

    Attributes
    ----------
    info
        Identity and properties of the camera.
    pixel_format, format_number
        Format of its frames; its number in a buffer.
    exposure_feature
        Name of the exposure time, microseconds.
    latch, latched, tick_s
        Command that latches the clock, feature with the latched value, and its unit, s.
    line
        Trigger input; empty when there is none.
    """

    info: CameraInfo
    pixel_format: PixelFormat
    format_number: int
    exposure_feature: str
    latch: str
    latched: str
    tick_s: float
    line: str


def prepare_readout(features: Features, address: Address, model: str) -> Readout:
    """Set a camera to raw values and return its readout settings.

    Parameters
    ----------
    features
        Features of the camera, which is not streaming.
    address
        Requested settings.
    model
        Name to use for a camera that reports none.

    Raises
    ------
    CameraError
        When it lacks a feature that acceptance of frames needs, or cannot be set to raw values.
    """
    where = address.url
    for name, value in _RAW_SETTINGS:
        features.set_if_present(name, value)
    _level_colors(features, where)
    exposure_feature = next(
        (name for name in ("ExposureTime", "ExposureTimeAbs") if features.has(name)), ""
    )
    if not exposure_feature:
        raise CameraError(
            f"{where}: has no feature ExposureTime; use a camera whose exposure time can be set"
        )
    latch, latched, tick_s = _clock_features(features, where)
    chosen = _choose_format(features, where, address.pixel_format)
    line = _choose_line(features, where, address.line)
    info = _describe(features, address, model, chosen, line)
    number = features.enum_number("PixelFormat")
    return Readout(info, chosen, number, exposure_feature, latch, latched, tick_s, line)


def _level_colors(features: Features, where: str) -> None:
    """Set white balance to 1 on a camera that multiplies it into the values."""
    for color in features.choices("BalanceRatioSelector"):
        features.set("BalanceRatioSelector", color)
        if features.has("BalanceRatio"):
            got = features.set_nearest("BalanceRatio", 1.0)
            if abs(got - 1.0) > 1e-2:
                raise CameraError(
                    f"{where}: BalanceRatio of {color}: got {got:g}, expected 1; its values are "
                    "not raw"
                )


def _clock_features(features: Features, where: str) -> tuple[str, str, float]:
    if features.has("TimestampLatch", "TimestampLatchValue"):
        return "TimestampLatch", "TimestampLatchValue", 1e-9
    if features.has("GevTimestampControlLatch", "GevTimestampValue"):
        # names of GigE Vision 1, which counts the camera's own ticks
        ticks_hz = float(features.read("GevTimestampTickFrequency"))
        return "GevTimestampControlLatch", "GevTimestampValue", 1.0 / ticks_hz
    raise CameraError(
        f"{where}: has no readable clock (TimestampLatch), so that older frames cannot be "
        "recognized; use another camera"
    )


def _choose_format(features: Features, where: str, requested: str) -> PixelFormat:
    offered = features.choices("PixelFormat")
    chosen = (
        pixel_format.parse_pixel_format(requested)
        if requested
        else pixel_format.choose_deepest_format(offered)
    )
    if chosen is None or chosen.name not in offered:
        raise CameraError(
            f"{where}: pixel format: got {requested or 'no raw one'}, expected a raw one of "
            f"those that the camera has: {', '.join(offered) or 'none'}"
        )
    features.set("PixelFormat", chosen.name)
    return chosen


def _choose_line(features: Features, where: str, requested: str) -> str:
    sources = features.choices("TriggerSource")
    lines = [name for name in sources if name.startswith("Line")]
    if requested:
        if requested not in sources:
            raise CameraUrlError(
                f"{where}: line: got {requested!r}, expected one of {', '.join(sources) or 'none'}"
            )
        return requested
    now = str(features.read("TriggerSource")) if lines else ""
    return now if now in lines else next(iter(lines), "")


def _describe(
    features: Features, address: Address, model: str, chosen: PixelFormat, line: str
) -> CameraInfo:
    where = address.url
    sources = features.choices("TriggerSource")
    triggers = [Trigger.SOFTWARE] if "Software" in sources else []
    triggers += [Trigger.EDGE] if line else []
    if not triggers:
        raise CameraError(
            f"{where}: has no trigger (TriggerSource: {', '.join(sources) or 'missing'}); use "
            "another camera"
        )
    white = 2**chosen.bits - 1
    if features.has("PixelDynamicRangeMax"):
        # a converter of 12 bits in 16-bit numbers saturates below 65535
        white = min(int(features.read("PixelDynamicRangeMax")) or white, white)
    width, height = int(features.read("Width")), int(features.read("Height"))
    _check_size(where, chosen, width, height)
    if features.has("DeviceModelName"):
        model = str(features.read("DeviceModelName"))
    cells = 1 if chosen.pattern == "MONO" else 4
    return CameraInfo(
        serial=address.serial,
        model=model.encode("ascii", "replace").decode(),
        width_px=width,
        height_px=height,
        pattern=chosen.pattern,
        black=(_black(features, address, chosen, white),) * cells,
        white=white,
        triggers=tuple(triggers),
    )


def _check_size(where: str, chosen: PixelFormat, width: int, height: int) -> None:
    if chosen.pattern != "MONO" and (width % 2 or height % 2):
        raise CameraError(
            f"{where}: got {width} x {height} pixels, expected even numbers for a color filter "
            "array; set the camera's Width and Height"
        )
    try:
        chosen.line_bytes(width)
    except ValueError as error:
        raise CameraError(f"{where}: {error}") from error


def _black(features: Features, address: Address, chosen: PixelFormat, white: int) -> float:
    """Return the level without light, DN.

    The unit of BlackLevel is up to the manufacturer, percent among others: its value is used only
    when the unit is DN.
    """
    black = address.black
    if black is None and features.has("BlackLevel"):
        if features.unit("BlackLevel").strip().lower() in _DN_UNITS:
            black = float(features.read("BlackLevel"))
    if black is None:
        raise CameraError(
            f"{address.url}: does not report its black level in DN; put the lens cap on, read "
            f"the median of a {chosen.name} frame in the manufacturer's viewer, and add "
            "black=DN to the address [SR-CAP-024]"
        )
    if not 0 <= black < white:
        raise CameraError(
            f"{address.url}: black: got {black:g} DN, expected 0 to below {white} for {chosen.name}"
        )
    return black
