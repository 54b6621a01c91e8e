"""Synthetic sequences: shapes on a table, their motion, and a depth camera."""
