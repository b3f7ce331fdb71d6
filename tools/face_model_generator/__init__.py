"""How the default face model is made: measurements, key points, layout, control mesh, annotation."""
