"""The study of calibration: whether posteriors know how far off they are. `make calibrate` runs it."""
