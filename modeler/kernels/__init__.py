"""Compiled functions: arrays in, arrays out; no package types, no hidden randomness."""
