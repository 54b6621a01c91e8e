"""Cost of a batch: per sequence, compared with single builds, and per task of an engine."""
