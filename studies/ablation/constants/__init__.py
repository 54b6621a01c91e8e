"""The named numbers of the package: how many there are, and what changing each of them changes."""
