"""Triangle meshes, transforms, subdivision, rays and rasters: what every stage stands on."""
