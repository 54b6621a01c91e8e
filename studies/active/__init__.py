"""Whether suggestions keep what they promise, and whether following them is quicker than other habits."""
