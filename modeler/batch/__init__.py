"""Many sequences to models: jobs, the engines that run them, and the list of the models."""
