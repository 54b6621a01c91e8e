"""What a batch costs: per sequence, beside single builds, and per task of an engine."""
