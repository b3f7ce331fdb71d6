"""Pictures: what a camera sees of a mesh, the light on it with its shadows, exposure."""
