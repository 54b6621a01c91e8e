"""The operating system: regular files, arrays on disk, threads, and the process's address space."""
