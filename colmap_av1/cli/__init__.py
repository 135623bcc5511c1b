"""The command line: words to options, reports to rows."""

from colmap_av1.cli.program import main

__all__ = ["main"]
