"""Compiled functions: arrays in, arrays out; no package types, no hidden randomness."""

import numba

# OpenMP is thread-safe (pairs may be registered from several threads) and Open3D needs libgomp anyway.
numba.config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]
