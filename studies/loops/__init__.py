"""Whole sequences, rendered and real: what closing loops takes off the error of the chain, and what a frame costs."""
