"""From names, parameters and the metadata of a sequence to components."""
