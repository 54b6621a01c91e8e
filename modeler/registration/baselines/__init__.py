"""Methods of others: ICP, GICP, FPFH with RANSAC, and the paper's sampler as published."""
