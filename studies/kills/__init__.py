"""Kills commands and gives them again; `python -m studies kills` does so at many moments."""
