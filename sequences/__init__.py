"""Readers of depth-camera sequences, and the renderer that makes synthetic ones."""
