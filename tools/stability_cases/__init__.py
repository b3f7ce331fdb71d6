"""The named extremes of every stage, one module a stage: for tests/stability and stability_report.py."""
