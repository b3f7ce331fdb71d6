"""What `process` makes of a scan without its light: the scan itself, a template, maps, eyes and mouth."""
