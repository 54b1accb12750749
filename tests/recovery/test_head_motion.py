"""The simulated dome's own tracking frames: where the head was, and when its mouth twitched."""

import numpy as np
import pytest

from reconstruction.registration import head_motion
from skinrig.benchmarks.dome.motion import simulate_drifting_capture


@pytest.mark.long
@pytest.mark.render
@pytest.mark.timeout(600)
def test_drift_is_tracked_and_twitch_is_discarded():
    seen = simulate_drifting_capture(
        width_px=650, views=2, drift_mm=1.5, times_s=(0.0, 2.5, 5.0, 10.0, 12.5), twitch=True
    )
    found = head_motion.estimate(
        seen.frames, seen.cameras, seen.points_mm, seen.normals, seen.times_s
    )
    assert found.usable.tolist() == (seen.twitch < 0.5).tolist()
    # a pixel is 1 mm at the face; a tenth of it, and much less than the head moved
    assert seen.point_errors_mm(found).max() < 0.1
    assert seen.true_motion_mm().max() > 0.5
    assert np.median(seen.point_errors_mm(found) / seen.true_motion_mm()) < 0.1
