"""A frame before it is committed."""

from collections.abc import Mapping
from dataclasses import dataclass

import xxhash

from capture.plan import Value
from capture.session.disk import Blob
from capture.session.journal import FrameLine, frame_path


@dataclass(frozen=True, slots=True, kw_only=True)
class NewFrame:
    """One frame of a step, and what its journal line contains."""

    camera: str
    """One of the step's cameras."""
    blob: Blob
    """A DNG of ours that names the step and the session."""
    settings: Mapping[str, Value]
    """Requested settings."""
    actual: Mapping[str, Value]
    """Settings that controller and camera report."""
    t_box_s: float | None = None
    """Time of the exposure on the controller's clock, s; None without a controller."""
    t_host_s: float
    """Time of arrival on the host's clock, s."""
    attempt: int = 1
    """1, or one more than the last attempt for a frame taken again."""

    def line(self, step_id: str) -> FrameLine:
        """Return the journal line of the frame."""
        return FrameLine(
            step=step_id,
            camera=self.camera,
            attempt=self.attempt,
            file=frame_path(step_id, self.camera, self.attempt),
            bytes=len(self.blob),
            xxh128=xxhash.xxh3_128_hexdigest(self.blob),
            settings=dict(self.settings),
            actual=dict(self.actual),
            t_box_s=None if self.t_box_s is None else float(self.t_box_s),
            t_host_s=float(self.t_host_s),
        )
