"""Folders of pictures with one camera for all: TUM RGB-D, Open3D and BundleSDF."""
