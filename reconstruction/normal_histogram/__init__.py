"""Normal histograms: counts, distances and their standard errors."""

from reconstruction.normal_histogram.counting import (
    check_buckets,
    count_normals,
    distance,
    from_normals,
    from_slopes,
    halved_distance,
    histogram,
    noise_floor,
    normalize_counts,
)
from reconstruction.normal_histogram.relief_slopes import HistogramError

__all__ = [
    "HistogramError",
    "check_buckets",
    "count_normals",
    "distance",
    "from_normals",
    "from_slopes",
    "halved_distance",
    "histogram",
    "noise_floor",
    "normalize_counts",
]
