"""Whole builds of captures that another renderer makes, every factor drawn at random together."""
