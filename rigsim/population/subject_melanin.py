"""The melanin of a subject that is given by name or file."""

import re

from rigsim.population.files import load_member_skin, load_subject


def subject_melanin(text: str, *, seed: int) -> float:
    """Return the volume fraction of melanosomes around which a subject's skin varies.

    Parameters
    ----------
    text
        A preset, a skin tone, a member of the population or a file.
    seed
        Seed of the variation between subjects.

    Examples
    --------
    >>> subject_melanin("IV", seed=0), round(subject_melanin("P07", seed=0), 4)
    (0.0395, 0.0148)
    """
    if re.fullmatch(r"P\d+", text):
        return load_member_skin(text).melanin
    return load_subject(text).skin(seed=seed).melanin
