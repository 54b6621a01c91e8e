"""Real captures, each changed in the ways that people change theirs, with the whole capture as reference."""
