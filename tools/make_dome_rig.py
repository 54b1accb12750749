"""Print capture/rigs/dome.toml: 150 LEDs on a geodesic sphere and 16 cameras around the face.

An icosahedron whose edges are cut in four has 162 vertices on a sphere; the twelve lowest, at the
subject's shoulders, carry no LED. Weyrich et al. 2005, section 5, give 150 LEDs on a geodesic dome
and 16 cameras but no coordinates; these are this project's choice, with every camera at least four
degrees away from the nearest LED.

    python tools/make_dome_rig.py > capture/rigs/dome.toml
"""

from __future__ import annotations

import numpy as np
import trimesh

LIGHTS_MM = 700.0
CAMERAS_MM = 760.0  # behind the struts, looking between the LEDs
ROWS_DEG = {
    -22.0: (-58, -29, 0, 29, 58),
    5.0: (-80, -51, -20, 20, 51, 80),
    40.0: (-60, -30, 0, 30, 60),
}


def led_positions() -> np.ndarray:
    sphere = trimesh.creation.icosphere(subdivisions=2)  # two halvings: 4 parts per edge
    places = sphere.vertices / np.linalg.norm(sphere.vertices, axis=1)[:, None]
    places = places[np.argsort(-places[:, 1], kind="stable")][:150]
    azimuth = np.degrees(np.arctan2(places[:, 0], places[:, 2])).round(3)
    height = (places[:, 1] * LIGHTS_MM).round(1)
    order = np.lexsort((azimuth, -height))
    return (places[order] * LIGHTS_MM).round(1) + 0.0


def camera_positions() -> list[np.ndarray]:
    out = []
    for elevation, azimuths in ROWS_DEG.items():
        for azimuth in azimuths:
            e, a = np.radians([elevation, azimuth])
            place = CAMERAS_MM * np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])
            out.append(place.round(1) + 0.0)
    return out


HEAD = """\
# 150 LEDs and 16 cameras around the face, after Weyrich et al. 2005, section 5.
# Made by tools/make_dome_rig.py. Frame: mm, origin at the subject's center, +x right, +y up,
# +z where the subject looks.
name = "dome"
boxes = ["dome"]
recycle_s = 0.0              # no light is a flash

[leds]                       # nominal, see capture.rig.LedLimits; measure an assembled dome
max_on_s = 0.5
max_duty = 0.25              # mean level over duty_window_s
duty_window_s = 1.0
thermal_tau_s = 4.0
thermal_trip = 0.6
dose_ws = 50.0               # of one LED to one subject: a twentieth of the blue-light bound
max_at_once = 24
max_flashes_per_s = 3.0
max_flicker_rms = 0.25
overlap_s = 0.0001
settle_s = 0.001
max_rows = 1024
"""
LIGHT = """
[[lights]]
name = "L{number:03d}"
position_mm = {place}
illuminant = "LED-B3"
power_w = 1.0
half_intensity_deg = 40.0
radius_mm = 10.0
"""
CAMERA = """
[[views]]
name = "C{number:02d}"
camera_model = "skinrig dome camera"
serial = "SD-{number:04d}"
position_mm = {place}
target_mm = [0.0, 0.0, 0.0]
up = [0.0, 1.0, 0.0]
focal_mm = 20.0              # field at the subject: 331 x 262 mm
pixel_um = 6.7
width_px = 1300
height_px = 1030
f_number = 8.0
readout_s = 0.02
bit_depth = 12
cfa = "RGGB"
black_level = 64
white_level = 4095
spectral_sensitivity = "Nikon 5100 (NPL)"
full_well_e = 22000.0
read_noise_e = 9.0
"""
SCANNER = """
# Scanner of the face: two projectors and four cameras, after Weyrich et al. 2005, figure 2.
# It is used with boxes = ["dome", "scanner"].
[scanner]
period_px = 32               # 10 mm on the face
phase_steps = 6
exposure_s = 0.02
settle_s = 0.02
max_show_s = 0.5
range_mm = [650.0, 1150.0]
"""
PROJECTOR = """
[[scanner.projectors]]
name = "P{number}"
model = "skinrig projector"
serial = "SP-{number:04d}"
position_mm = {place}
target_mm = [0.0, 0.0, -40.0]
up = [0.0, 1.0, 0.0]
focal_mm = 21.0              # field at the subject: 262 x 419 mm
pixel_um = 7.637
width_px = 800
height_px = 1280
f_number = 2.4
illuminant = "LED-B3"
power_w = 0.4
cameras = {cameras}
"""
SCANNER_CAMERA = """
[[scanner.views]]
name = "S{number}"
camera_model = "skinrig scanner camera"
serial = "SS-{number:04d}"
position_mm = {place}
target_mm = [0.0, 0.0, -40.0]
up = [0.0, 1.0, 0.0]
focal_mm = 17.0              # field at the subject: 287 x 359 mm
pixel_um = 5.3
width_px = 1024
height_px = 1280
f_number = 8.0
readout_s = 0.02
bit_depth = 12
cfa = "MONO"
black_level = 64
white_level = 4095
spectral_sensitivity = "Nikon 5100 (NPL)"
full_well_e = 10000.0
read_noise_e = 7.0
"""
SCANNER_MM = 900.0
POD_DEG = (-38.0, 38.0)  # azimuth of a projector
POD_CAMERAS_DEG = ((-18.0, 8.0), (18.0, -8.0))  # azimuth and elevation from its projector


def scanner_place(azimuth_deg: float, elevation_deg: float) -> list[float]:
    a, e = np.radians([azimuth_deg, elevation_deg])
    place = SCANNER_MM * np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])
    place[2] -= 40.0  # around the middle of a head
    return (place.round(1) + 0.0).tolist()


def main() -> None:
    print(HEAD, end="")
    for number, place in enumerate(led_positions()):
        print(LIGHT.format(number=number, place=place.tolist()), end="")
    for number, place in enumerate(camera_positions()):
        print(CAMERA.format(number=number, place=place.tolist()), end="")
    print(SCANNER, end="")
    count = len(POD_CAMERAS_DEG)
    for number, azimuth in enumerate(POD_DEG):
        cameras = [f"S{count * number + k}" for k in range(count)]
        place, names = scanner_place(azimuth, 0.0), str(cameras).replace("'", '"')
        print(PROJECTOR.format(number=number, place=place, cameras=names), end="")
    for number, azimuth in enumerate(POD_DEG):
        for k, (aside, up) in enumerate(POD_CAMERAS_DEG):
            place = scanner_place(azimuth + aside, up)
            print(SCANNER_CAMERA.format(number=count * number + k, place=place), end="")


if __name__ == "__main__":
    main()
