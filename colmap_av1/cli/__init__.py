"""The command line: parses options, prints reports."""

from colmap_av1.cli.program import main

__all__ = ["main"]
