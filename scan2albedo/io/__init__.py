"""Reading and writing of scans, images, geometry images and results."""
