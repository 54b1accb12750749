"""Images that no single light made are named, others are not."""

import numpy as np
import pytest
from fixtures.faulty_stacks import dome, render

from reconstruction.stack_diagnosis.special_images import find_special_images


@pytest.mark.parametrize("level", [0.4, 1.0, 3.0])
@pytest.mark.parametrize("shape", ["head", "relief"])
def test_dark_and_full_bright_images_are_named(shape, level):
    rng = np.random.default_rng(8)
    lights = dome(20, rng, 60)
    images, inside = render(shape, lights, rng, side=64, gloss=0.3, noise=0.01)
    assert find_special_images(images, inside) == {}
    full = images.sum(axis=0)
    full = np.clip(level * full / np.quantile(full[inside], 0.99), 0.0, 1.0)
    stack = np.concatenate([[full], images[:9], [full, 0.01 * images[0]], images[9:]])
    assert find_special_images(stack, inside) == {0: "full-bright", 10: "full-bright", 11: "dark"}
