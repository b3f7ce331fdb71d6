"""Files of key points, labels, cameras, masks, and of results."""
