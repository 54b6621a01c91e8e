"""Damaged inputs by the hundred thousand; `python -m fuzz` runs them."""
