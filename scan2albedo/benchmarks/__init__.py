"""Error against run time of every stage, on synthetic scenes whose truth is known, beside other methods.

Only the command line and the tools import this package: `scan2albedo benchmark`, `tools/error_vs_time.py`.
"""
