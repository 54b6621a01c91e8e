"""Baselines: ICP, GICP, FPFH with RANSAC, KISS-Matcher, and the paper's sampler as published."""
