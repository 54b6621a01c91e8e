"""Synthetic sequences: shapes on a table, how they move, what a depth camera makes of them."""
