"""geometry_image"""
