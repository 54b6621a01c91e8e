"""Programs that measure; see `python -m studies`."""
