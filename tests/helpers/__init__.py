"""What the tests of several packages make: one topic a file, each helper once."""
