"""Error against run time of every stage, on synthetic scenes whose truth is known, beside other methods."""
