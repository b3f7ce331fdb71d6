"""What every stage does in its named extremes, as a table: a module a stage, a row an extreme."""
