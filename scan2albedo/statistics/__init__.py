"""What several stages take from statistics: linear models of what people differ by, and their fits."""
