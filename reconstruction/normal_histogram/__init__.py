"""Normal histograms: counts, distances and their standard errors."""

from reconstruction.normal_histogram.counting import (
    bucket_counts,
    check_buckets,
    distance,
    from_normals,
    from_slopes,
    halved_distance,
    histogram,
    noise_floor,
    shares_of,
)
from reconstruction.normal_histogram.relief_slopes import HistogramError

__all__ = [
    "HistogramError",
    "bucket_counts",
    "check_buckets",
    "distance",
    "from_normals",
    "from_slopes",
    "halved_distance",
    "histogram",
    "noise_floor",
    "shares_of",
]
