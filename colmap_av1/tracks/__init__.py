"""Motion chained into tracks, corrected and chosen."""
