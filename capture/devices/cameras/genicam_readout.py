"""How an industrial camera is read out: raw values and their levels, trigger, clock.

A camera is set so that its values depend on light, exposure time and gain alone. Without a raw
format, known levels, a trigger and a clock that can be read, no frame of it could be believed, so
it is refused.
"""

import math
from dataclasses import dataclass
from urllib.parse import parse_qsl

from capture.devices.camera import CameraError, CameraInfo, CameraUrlError, Trigger
from capture.devices.cameras import pixel_format
from capture.devices.cameras.genicam_producer import Features
from capture.devices.cameras.pixel_format import PixelFormat

BASE_ISO = 100
"""Sensitivity that a gain of 0 dB is called where the address does not say."""


@dataclass(frozen=True, slots=True)
class Address:
    """What ``genicam:SERIAL?NAME=VALUE&...`` says.

    Attributes
    ----------
    serial
        Serial number of the camera.
    producer
        File or folder of the GenTL producer; empty: as GENICAM_GENTL64_PATH says.
    pixel_format
        As the camera names it; empty: the deepest raw one.
    line
        Input of the trigger; empty: that which the camera is set to, else its first.
    iso
        What a gain of 0 dB is called, above 0.
    black
        Level of no light, DN; None: as the camera's BlackLevel says.
    """

    serial: str
    producer: str = ""
    pixel_format: str = ""
    line: str = ""
    iso: int = BASE_ISO
    black: float | None = None

    @property
    def url(self) -> str:
        """The address without what follows the serial number."""
        return f"genicam:{self.serial}"


def parse_address(rest: str) -> Address:
    """Return what an address says.

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
        f"genicam:{rest}: expected genicam:SERIAL, then at will ?producer=FILE.cti, "
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

# what would make values or times depend on something else, where a camera has it
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
    """What a camera was set to once, and the names of its features.

    Attributes
    ----------
    info
        What the camera is.
    pixel_format, format_number
        Of its frames; the number by which a buffer names it.
    exposure_feature
        Exposure time, microseconds.
    latch, latched, tick_s
        The command that holds the clock, the feature that then tells it, and its unit, s.
    line
        Input that triggers; empty where there is none.
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
    """Set a camera to raw values and return how it is read out.

    Parameters
    ----------
    features
        Of the camera, which is not streaming.
    address
        What it is asked to be.
    model
        Its name, for one that does not tell its own.

    Raises
    ------
    CameraError
        When it lacks what a frame needs to be believed, or cannot be set to raw values.
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
            f"{where}: has no feature ExposureTime; a camera is needed whose exposure can be set"
        )
    latch, latched, tick_s = _clock_features(features, where)
    chosen = _choose_format(features, where, address.pixel_format)
    line = _choose_line(features, where, address.line)
    info = _describe(features, address, model, chosen, line)
    number = features.enum_number("PixelFormat")
    return Readout(info, chosen, number, exposure_feature, latch, latched, tick_s, line)


def _level_colors(features: Features, where: str) -> None:
    """Take white balance out of the values, where a camera multiplies it in."""
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
        # names of GigE Vision 1, which counts ticks of the camera's own
        ticks_hz = float(features.read("GevTimestampTickFrequency"))
        return "GevTimestampControlLatch", "GevTimestampValue", 1.0 / ticks_hz
    raise CameraError(
        f"{where}: has no clock that can be read (TimestampLatch), so that its frames cannot be "
        "told from older ones"
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
            f"{where}: pixel format: got {requested or 'no raw one'}, expected a raw one of those"
            f" that "
            f"the camera has: {', '.join(offered) or 'none'}"
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
            f"{where}: has no trigger (TriggerSource: {', '.join(sources) or 'missing'})"
        )
    white = 2**chosen.bits - 1
    if features.has("PixelDynamicRangeMax"):
        # 12 bits of a converter in 16-bit numbers end below 65535
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
    """Return the level of no light, DN.

    BlackLevel is told in whatever unit the maker likes, per cent among them: it is taken only where
    it says that it counts DN.
    """
    black = address.black
    if black is None and features.has("BlackLevel"):
        if features.unit("BlackLevel").strip().lower() in _DN_UNITS:
            black = float(features.read("BlackLevel"))
    if black is None:
        raise CameraError(
            f"{address.url}: does not tell its black level in DN; put the lens cap on, read the "
            f"median of a {chosen.name} frame in the maker's viewer, and add black=DN to the "
            "address"
        )
    if not 0 <= black < white:
        raise CameraError(
            f"{address.url}: black: got {black:g} DN, expected 0 to below {white} for {chosen.name}"
        )
    return black
