"""Print capture/rigs/gradient.toml: a sphere of polarized LEDs, a macro camera and a caliper.

An icosahedron whose edges are cut in four has 162 vertices on a sphere. The center of one of its
faces is turned towards the camera, so that the lens looks between the LEDs; vertices behind the
subject's head carry none. Nagano et al. 2015, section 4 (doi 10.1145/2766894), give a sphere of
polarized LEDs without coordinates; these are this project's choice.

Each LED's polarizer is rotated so that a facet's mirror reflection into the camera is polarized
along the analyzer's axis at reading 0, and extinguished at 90 (the choice of Ma et al. 2007, doi
10.2312/EGWR/EGSR07/183-194, for one point of view). Fresnel's amplitudes along and across the plane
of incidence differ; the axis of the LED's polarizer compensates for this.

    python tools/make_gradient_rig.py > capture/rigs/gradient.toml
"""

from __future__ import annotations

import numpy as np
import trimesh

LIGHTS_MM = 600.0
BEHIND = -0.6  # cosine to +z; the subject's head and shoulders are below it
ETA = 1.4
ANALYZER_DEG = 90.0


def led_directions() -> np.ndarray:
    sphere = trimesh.creation.icosphere(subdivisions=2)
    places = sphere.vertices / np.linalg.norm(sphere.vertices, axis=1)[:, None]
    corners = trimesh.creation.icosahedron()
    front = corners.vertices[corners.faces[0]].mean(axis=0)
    front /= np.linalg.norm(front)
    side = corners.vertices[corners.faces[0][0]]
    top = side - (side @ front) * front
    top /= np.linalg.norm(top)
    # a third of the net's own angle: keeps every LED off the vertical through the subject
    turn = np.radians(7.0)
    right = np.cross(top, front)
    axes = np.stack(
        [
            np.cos(turn) * right + np.sin(turn) * top,
            np.cos(turn) * top - np.sin(turn) * right,
            front,
        ]
    )
    places = places @ axes.T
    places = places[places[:, 2] > BEHIND]
    azimuth = np.degrees(np.arctan2(places[:, 1], places[:, 0])).round(3)
    return places[np.lexsort((azimuth, -places[:, 2].round(4)))]


def polarizer_axis_deg(to_light: np.ndarray) -> float:
    """Return the polarizer axis, degrees, whose mirror reflection is along the analyzer's axis."""
    to_camera = np.array([0.0, 0.0, 1.0])
    angle = np.radians(ANALYZER_DEG)
    wanted = np.array([np.cos(angle), np.sin(angle), 0.0])
    facet = to_light + to_camera
    facet /= np.linalg.norm(facet)
    cosine = float(facet @ to_light)
    inside = np.sqrt(1.0 - (1.0 - cosine**2) / ETA**2)
    across = (cosine - ETA * inside) / (cosine + ETA * inside)
    along = (ETA * cosine - inside) / (ETA * cosine + inside)
    s = np.cross(facet, to_light)
    s /= np.linalg.norm(s)
    p_in, p_out = np.cross(-to_light, s), np.cross(to_camera, s)
    field = (wanted @ s) / across * s + (wanted @ p_out) / along * p_in
    # capture.rig.Light: from the horizontal towards up, for a light next to the camera
    right = np.cross([0.0, 1.0, 0.0], to_light)
    right /= np.linalg.norm(right)
    up = np.cross(to_light, right)
    return float(np.degrees(np.arctan2(field @ up, field @ right)) % 180.0)


HEAD = """\
# A sphere of polarized LEDs, a macro camera and a stretching caliper, after Nagano et al. 2015,
# section 4 (doi 10.1145/2766894). Made by tools/make_gradient_rig.py. Frame: mm, origin at the
# middle of the skin patch, +x right, +y up, +z towards the camera.
name = "gradient"
boxes = ["gradient_sphere", "caliper"]
recycle_s = 0.0              # no light is a flash
polarizer_move_s = 0.15      # analyzer from parallel to crossed

[leds]                       # nominal, see capture.rig.LedLimits; measure an assembled sphere
max_on_s = 0.5
max_duty = 0.25              # mean level over duty_window_s
duty_window_s = 1.0
thermal_tau_s = 4.0
thermal_trip = 0.6
dose_ws = 50.0
max_at_once = {count}
max_flashes_per_s = 3.0
max_flicker_rms = 0.25
overlap_s = 0.0001
settle_s = 0.001
max_rows = 64

[caliper]                    # the force limit has no default: who captures must give one
aperture_mm = 8.0            # distance of the jaws at step 0
step_mm = 0.8
first_step = -4
last_step = 8
angles_deg = [0.0, 45.0, 90.0, 135.0]
speed_mm_per_s = 2.0

[[views]]
name = "cam"
camera_model = "skinrig macro camera"
serial = "SG-0001"
position_mm = [0.0, 0.0, 300.0]
target_mm = [0.0, 0.0, 0.0]
up = [0.0, 1.0, 0.0]
focal_mm = 275.0             # distance of the sensor: 6 um of skin a pixel, 12.3 mm of field
pixel_um = 5.5
width_px = 2048
height_px = 2048
f_number = 16.0
readout_s = 0.011
bit_depth = 12
cfa = "MONO"
black_level = 64
white_level = 4095
spectral_sensitivity = "Nikon 5100 (NPL)"
analyzer_axis_deg = {analyzer:.1f}     # axis at rotator reading 0, the parallel state
full_well_e = 13500.0
read_noise_e = 13.0
"""
LIGHT = """
[[lights]]
name = "G{number:03d}"
position_mm = {place}
illuminant = "LED-B3"
polarizer_axis_deg = {axis:.2f}
power_w = 1.0
half_intensity_deg = 40.0
radius_mm = 6.0
"""


def main() -> None:
    directions = led_directions()
    print(HEAD.format(count=len(directions), analyzer=ANALYZER_DEG), end="")
    for number, direction in enumerate(directions):
        place = (direction * LIGHTS_MM).round(1) + 0.0
        axis = polarizer_axis_deg(place / np.linalg.norm(place)) % 180.0
        axis = 0.0 if round(axis, 2) >= 180.0 else axis
        print(LIGHT.format(number=number, place=place.tolist(), axis=axis), end="")


if __name__ == "__main__":
    main()
