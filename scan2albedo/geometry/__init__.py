"""Triangle meshes, transforms, subdivision, rays and rasters: the ground of every stage."""
