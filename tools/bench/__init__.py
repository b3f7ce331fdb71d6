"""Benches: cases, methods (ours and the peers), a score and bars; `python tools/bench` lists them."""
