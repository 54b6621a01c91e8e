"""Inputs as people have them, drawn at random: each is read right, or refused in a line that names the cause."""
