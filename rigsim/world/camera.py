"""Simulated cameras: a body that lives in the world, and the handle that a driver's user holds.

A body opens its shutter when it is fired, or on the edge that the flash box puts on the camera
line. It sees the light that pops while the shutter is open, is busy until the frame is read out,
and misses edges meanwhile. Its pixels are made when somebody asks for the frame.
"""

from capture.devices import camera
from capture.rig import RigError
from rigsim.world.camera_body import EXPOSURE_RANGE_S, ISO, CameraBody
from rigsim.world.world import get_by_name_or_box

__all__ = ["CameraBody", "SimCamera", "open_camera"]


def open_camera(rest: str) -> camera.Camera:
    """Open ``sim://WORLD/VIEW``; the world must be registered, or its box be open.

    WORLD is the name of ``sim://BOX?world=NAME``, or BOX itself where no name was given.
    """
    name, slash, view_name = rest.partition("/")
    if not (name and slash and view_name):
        raise camera.CameraUrlError(f"sim://{rest}: got {rest!r}, expected WORLD/VIEW")
    try:
        return SimCamera(get_by_name_or_box(name).camera(view_name))
    except (KeyError, RigError) as exc:
        raise camera.CameraUrlError(
            f"sim://{rest}: {exc.args[0]}; open its box first, by "
            "sim://BOX?world=NAME, and its cameras by sim://NAME/VIEW"
        ) from exc


class SimCamera:
    """A handle on a simulated camera; see `capture.devices.camera.Camera`.

    Parameters
    ----------
    body
        The camera that it is a handle on.
    """

    def __init__(self, body: CameraBody) -> None:
        self.body = body
        view = body.view
        self._info = camera.CameraInfo(
            serial=view.serial,
            model=view.camera_model,
            width_px=view.width_px,
            height_px=view.height_px,
            pattern=view.cfa,
            black=(float(view.black_level),) * (1 if view.cfa == "MONO" else 4),
            white=view.white_level,
            triggers=(camera.Trigger.SOFTWARE, camera.Trigger.EDGE),
        )

    @property
    def info(self) -> camera.CameraInfo:
        """What it is."""
        return self._info

    def clock_s(self) -> float:
        """Return the time on the clock that stamps its frames, s."""
        return self.body.clock_s()

    def configure(self, want: camera.Exposure) -> camera.Exposure:
        """Set an exposure within what the camera can do, and return it."""
        set_to = camera.Exposure(
            min(max(want.exposure_s, EXPOSURE_RANGE_S[0]), EXPOSURE_RANGE_S[1]),
            min(max(want.iso, ISO[0]), ISO[1]),
        )
        self.body.exposure = set_to
        return set_to

    def arm(self, count: int, trigger: camera.Trigger) -> None:
        """Make ready for `count` frames; frames waiting from before are dropped."""
        if count < 1:
            raise camera.CameraError(f"count: got {count}, expected 1 or more")
        if trigger not in self._info.triggers:
            raise camera.CameraError(f"camera {self._info.serial}: knows no {trigger} trigger")
        self.body.arm(count, trigger)

    def fire(self) -> None:
        """Start one exposure."""
        self.body.fire()

    def frame(self, timeout_s: float) -> camera.Frame:
        """Return the next frame, or raise `FrameTimeout`."""
        return self.body.develop(self.body.next_shot(timeout_s))

    def abort(self) -> None:
        """Give up what was armed."""
        self.body.disarm()

    def close(self) -> None:
        """Let go of the camera."""
        self.body.disarm()
