"""Compiled functions: arrays in, arrays out; no package types, no hidden randomness."""

from numba.core import config

# OpenMP is thread-safe (pairs may be registered from several threads) and Open3D needs libgomp anyway.
config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]  # pyright: ignore[reportAttributeAccessIssue]
