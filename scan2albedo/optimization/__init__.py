"""Search for the least cost: simulated annealing and damped least squares."""
