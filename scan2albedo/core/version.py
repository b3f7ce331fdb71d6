"""The version of the package, which results and files name."""

VERSION = "0.4.0"
