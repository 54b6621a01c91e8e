"""Run folders and what is done with them: rules for their places, reopening, joining, presets of other programs."""
