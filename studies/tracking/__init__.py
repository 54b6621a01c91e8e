"""Objects found in images with their model, rendered and real, beside a baseline."""
