"""Rerun's only home: what a run shows while it runs."""
