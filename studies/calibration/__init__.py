"""The study of calibration: whether covariances match the errors. `make calibrate` runs it."""
