"""`write_report`: processed scans as one HTML page that needs no network."""
