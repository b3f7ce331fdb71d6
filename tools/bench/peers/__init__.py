"""Others' methods that benches run beside ours."""
