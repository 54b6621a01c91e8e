"""Recordings of the Azure Kinect."""
