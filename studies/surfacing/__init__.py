"""Surfaces from the same frames and poses by several programs: how near the truth, how fast, how much memory."""
