"""Normal histograms: counts, distances and their standard errors."""

from reconstruction.normal_histogram.counting import (
    HistogramError,
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
