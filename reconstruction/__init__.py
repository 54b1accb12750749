"""Images to maps: one estimator a file, the pipeline on top."""
