"""Compiled functions: arrays in, arrays out; no package types, no hidden randomness."""

import os

from numba.core import config

# OpenMP is thread-safe (pairs may be registered from several threads) and Open3D needs libgomp anyway.
config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]  # pyright: ignore[reportAttributeAccessIssue]
# Threads that spin at the end of each short loop hold up one another wherever anything else runs beside them.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
