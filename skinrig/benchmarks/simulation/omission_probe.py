"""The probe's pictures with and without what its needs speak of."""

import dataclasses
import time
from collections.abc import Iterator

import numpy as np

from capture.rig import load_rig
from rigsim.fiber.probe_tissue import HomogeneousTissue
from rigsim.needs.probe import COLOR_EFFECT, CROSSTALK_EFFECT, DARK_CURRENT_EFFECT, WINGS_EFFECT
from rigsim.scenes.probe.scene import MAX_USUAL_EXPOSURE_S, ProbeScene
from rigsim.world.suction import HeadState
from skinrig.arrays import Float32Array
from skinrig.benchmarks.simulation.omission_cases import ComparedScene, Omission


def gray_tissue() -> Iterator[Omission]:
    """Take a gray medium as one color, and as 31 of which bands are made, of the same photons."""
    rig = load_rig("probe")
    gray = HomogeneousTissue(0.05, 1.5)
    bands = tuple(float(nm) for nm in range(400, 701, 10))
    colored = dataclasses.replace(gray, sigma_a_per_mm=(0.05,) * len(bands), wavelength_nm=bands)
    head = HeadState("forehead", 0.0, True, 0.0, 5.0)
    images, seconds = [], []
    for tissue in (colored, gray):
        begin = time.process_time()
        made = ProbeScene(rig, tissue)
        profile = made.profile(head)
        seconds.append(time.process_time() - begin)
        if profile is None:
            raise ValueError("gray tissue: the head touches nothing")
        images.append(made.image(made.through_fibres(profile.reflectance_per_mm2)))
    brightest = np.float32(images[0].max())
    scene = ProbeScene(rig, gray)
    compared = ComparedScene("probe", "gray medium", scene)
    have, lack = (part / brightest for part in images)  # of stored photons: the same for both
    yield compared.changed(scene.needs[COLOR_EFFECT], have, lack, (seconds[0], seconds[1]))
    yield from _probe_build(compared, head)


def _probe_build(compared: ComparedScene, head: HeadState) -> Iterator[Omission]:
    """Compare the probe as built with one without cross-talk, wings, or dark current."""
    scene = compared.scene
    profile, build = scene.profile(head), scene.build

    def timed(made: ProbeScene) -> tuple[Float32Array, float]:
        begin = time.process_time()
        light = made.image(made.through_fibres(profile.reflectance_per_mm2))
        return light, time.process_time() - begin

    have, with_s = timed(scene)
    unit = np.float32(have.max())
    plain = {
        CROSSTALK_EFFECT: dataclasses.replace(build, crosstalk=np.eye(len(build.crosstalk))),
        WINGS_EFFECT: dataclasses.replace(build, wings=0.0),
    }
    for name, without in plain.items():
        lack, spent = timed(ProbeScene(scene.rig, scene.tissue, build=without))
        yield compared.changed(scene.needs[name], have / unit, lack / unit, (with_s, spent))
    sensor = scene.sensor()
    full_e = sensor.gain_e_per_dn * (sensor.white - sensor.black)
    begin = time.process_time()
    hot = np.asarray(scene.hot_e_per_s * MAX_USUAL_EXPOSURE_S / full_e, np.float32)
    middle = time.process_time()
    none = np.zeros_like(hot)
    spent_s = middle - begin, time.process_time() - middle
    yield compared.changed(scene.needs[DARK_CURRENT_EFFECT], hot, none, spent_s)
