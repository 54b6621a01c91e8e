"""Visualisation of runs: the only package that imports Rerun."""
