"""Print capture/rigs/probe.toml: a source fiber, 28 detection fibers, suction, a cooled camera.

Weyrich et al. 2006, section 8 (doi 10.1145/1141911.1141987), give a linear array of a source fiber
and 28 detection fibers, 23 exposures 2/3 stop apart in about 88 s, suction and air cooling; the
dimensions are this project's choice. Fibers of 0.2 mm core are a quarter of a millimeter apart,
from 0.3 to 7.05 mm: close enough for the steep part of blue profiles, far enough for red tails. The
camera images their ends in the same order, so that stray light of a spot falls first on spots that
are nearly as bright.

    python tools/make_probe_rig.py > capture/rigs/probe.toml
"""

from __future__ import annotations

FIBERS = 28
FIRST_MM, PITCH_MM = 0.3, 0.25
SPOT_PITCH_PX, FIRST_SPOT_PX, ROW_PX = 42.0, 33.0, 63.5

HEAD = """\
# A contact probe of one source fiber and 28 detection fibers, after Weyrich et al. 2006, section 8
# (doi 10.1145/1141911.1141987). Made by tools/make_probe_rig.py. Frame: mm, origin at the source
# fiber's face, +x along the line of fibers, +z out of the skin. The camera looks at the fibers'
# other ends in a box of its own: its place is not of that frame.
name = "probe"
boxes = ["probe"]
recycle_s = 0.0              # no light is a flash

[leds]                       # the white LED behind the source fiber
max_on_s = 30.0
max_duty = 1.0
dose_ws = 10.0

[probe]
source_core_mm = 0.2
source_numerical_aperture = 0.22
suction_mbar = 60.0          # holds the head on the skin
suction_tolerance_mbar = 6.0
max_suction_mbar = 150.0
max_suction_s = 60.0         # then the skin has a rest
rest_s = 5.0
settle_s = 1.0
max_open_s = 30.0
camera_c = 5.0               # cooled by air
camera_tolerance_c = 2.0

[[lights]]
name = "source"
position_mm = [0.0, 0.0, 1.0]
illuminant = "LED-B3"
power_w = 0.001              # out of the fiber
radius_mm = 0.1

[[views]]
name = "cam"
camera_model = "skinrig fiber camera"
serial = "SP-0001"
position_mm = [0.0, 0.0, 100.0]
target_mm = [0.0, 0.0, 0.0]
up = [0.0, 1.0, 0.0]
focal_mm = 50.0
pixel_um = 6.45
width_px = 1200
height_px = 128
f_number = 2.8
readout_s = 0.3
bit_depth = 12
cfa = "RGGB"
black_level = 64
white_level = 4095
spectral_sensitivity = "Nikon 5100 (NPL)"
full_well_e = 18000.0
read_noise_e = 7.0
"""


def fiber(number: int) -> str:
    return f"""
[[probe.fibers]]
name = "F{number + 1:02d}"
position_mm = [{FIRST_MM + PITCH_MM * number:.2f}, 0.0]
core_mm = 0.2
numerical_aperture = 0.22
spot_px = [{FIRST_SPOT_PX + SPOT_PITCH_PX * number:.1f}, {ROW_PX:.1f}]
"""


if __name__ == "__main__":
    print(HEAD + "".join(fiber(number) for number in range(FIBERS)), end="")
