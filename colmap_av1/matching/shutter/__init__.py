"""Estimate the read-out time of a rolling shutter from tracks, and correct tracks for it."""
