"""Commands in hostile environments: settings, caches, folders, limits, sockets and signals."""
