"""Damaged inputs by the hundred thousand; `python -m studies fuzz` runs them."""
