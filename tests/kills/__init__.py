"""Kills `modeler build` and resumes it; `python -m kills` does so at many moments."""
