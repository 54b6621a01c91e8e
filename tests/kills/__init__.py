"""Kills commands and gives them again; `python -m kills` does so at many moments."""
