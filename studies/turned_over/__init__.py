"""The study of objects that are turned over within one recording: whether one model comes of it, and the right one."""
